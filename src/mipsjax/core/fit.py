"""How well points of a frame fit the map at a pose."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core import losses
from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, unproject
from mipsjax.core.equations import Points, robust_cost
from mipsjax.core.rigid import transform


class Fit(NamedTuple):
    """How well a frame fits the map at a pose."""

    residual: Float[Array, ""]
    """Root of the mean robust cost, metres."""
    known: Float[Array, ""]
    """Share of measured pixels within `keyframe.error` of the mapped surface."""
    confirmed: Float[Array, ""]
    """The same where the map is also certain: space that was never observed looks like surface, but not certainly."""


def draw_points(
    key: PRNGKeyArray,
    depth: Float[Array, "H W"],
    color: UInt8[Array, "H W 3"],
    pixels: int,
    camera: Intrinsics,
) -> Points:
    """Points of a stripe grid of about `pixels` cells, shifted by a random part of a cell."""
    height, width = depth.shape
    v, u = pixel_grid(*grid_shape(pixels, height, width), jax.random.uniform(key, (2,)), height, width)
    d = depth[v, u]
    return Points(unproject(v, u, d, camera), color[v, u].astype(jnp.float32) / 255, d > 0)


def measure_fit(field: nf.Field, T: Float[Array, "4 4"], points: Points, part: nf.Part, cfg: Config) -> Fit:
    """Residual and shares of known pixels at a pose."""
    prediction = nf.tsdf(field, transform(T, points.p_cam), cfg.field, part)
    cost = losses.masked_mean(robust_cost(prediction.psi, cfg.track.go.robust), points.mask)
    near = jnp.abs(prediction.psi) < cfg.keyframe.error
    certain = nf.is_certain(prediction.entropy, cfg.correspond.max_entropy, cfg.field)
    known, confirmed = (
        losses.masked_mean(m.astype(jnp.float32), points.mask) for m in (near, near & certain)
    )
    return Fit(jnp.sqrt(cost), known, confirmed)
