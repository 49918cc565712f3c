"""The distance and the colour over any number of submaps (Eq. 1 of the paper).

`start`, then `add` for each submap in any order: after each the blend is that of the submaps so far. A submap's
parameters and pose are arguments like any other, so that one compilation serves any number of them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mipsjax.config.sections import Config, FieldConfig
from mipsjax.core import field as nf
from mipsjax.core import losses
from mipsjax.core.compiled import compiled
from mipsjax.core.rigid import transform


class Blended(NamedTuple):
    """What is known at N points from the submaps added so far: means, each submap weighted by its certainty."""

    psi: Float[Array, " N"]
    """Truncated signed distance, metres; the truncation (free space) where no submap reaches."""
    entropy: Float[Array, " N"]
    """Nats; that of an even distribution where no submap reaches."""
    color: Float[Array, "N 3"]
    """RGB in 0..1; black where no submap reaches."""
    weight: Float[Array, " N"]
    """Sum of the submaps' weights, each at most 1; 0 where no submap reaches."""


def start(points: int, cfg: FieldConfig) -> Blended:
    """`points` points before any submap: free space, of which nothing is known."""
    psi, entropy = jnp.full(points, cfg.truncation), jnp.full(points, np.log(cfg.classes), jnp.float32)
    return Blended(psi, entropy, jnp.zeros((points, 3)), jnp.zeros(points))


@compiled("cfg", "colored", reads=("field", "blend"))
def add(
    total: Blended,
    field: nf.Field,
    T_sub_world: Float[Array, "4 4"],
    trust: Float[Array, " N"],
    p_world: Float[Array, "N 3"],
    cfg: Config,
    colored: bool = True,
) -> Blended:
    """The blend with one more submap.

    Its weight is `trust` (0..1; 0 where it says nothing) times 1 / h^2, bounded as in tracking. The means are running
    ones: a submap alone gives its own values exactly. Points where a submap is not finite are left to the others.
    Without `colored` the colour stays as it is, for less work.
    """
    encoded = nf.encode(field, transform(T_sub_world, p_world), cfg.field)
    psi, entropy, _ = nf.decode_tsdf(field, encoded, cfg.field)
    weight = trust * losses.certainty(entropy, cfg.blend.entropy_floor)
    used = (weight > 0) & jnp.isfinite(psi)
    together = total.weight + jnp.where(used, weight, 0.0)
    # Guarded twice: the branch that is not taken must not divide by 0 either
    share = jnp.where(used, weight / jnp.where(used, together, 1.0), 0.0)

    def mean(old, new):
        by = share.reshape(-1, *[1] * (old.ndim - 1))
        # As a mean of both and not old + by (new - old): a submap alone then gives its own bits
        return jnp.where(by > 0, (1 - by) * old + by * new, old)

    color = mean(total.color, nf.decode_color(field, encoded)) if colored else total.color
    return Blended(mean(total.psi, psi), mean(total.entropy, entropy), color, together)
