"""What moves a pose from a guess to where its frame fits: second-order steps, and Adam as in the paper.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, sampling
from mipsjax.core.camera import Intrinsics
from mipsjax.core.equations import Points, System, descend, prior_system
from mipsjax.core.evidence import Evidence, colour_systems, map_rows, view_rows
from mipsjax.core.rigid import perturbed, transform


def levenberg_marquardt(
    field: nf.Field,
    T: Float[Array, "4 4"],
    seen: Evidence,
    part: nf.Part,
    steps: int,
    camera: Intrinsics,
    cfg: Config,
) -> Float[Array, "4 4"]:
    """Robust second-order refinement of d2t: residual psi, analytic gradient, Cauchy weight, closed 6 x 6 system.

    Points weigh by the noise of their depth: what is near says more, also of the rotation.
    Uncertain points weigh less, as in RO: what was learned a moment ago is noisier than the rest.
    Points where the field is saturated keep their cost but have no weight, so that a step that loses sight of
    the map is never an improvement. Depth images of keyframes are a second term where there are any, corners of the
    image a third, its brightness a fourth, and a prior pose a fifth.
    """

    def system(T):
        on_map = map_rows(field, T, seen.points, part, cfg).system()
        return jax.tree.map(lambda *parts: sum(parts), on_map, *_without_map(T, seen, camera, cfg))

    return descend(system, T, steps)


def approach(
    T: Float[Array, "4 4"], seen: Evidence, steps: int, camera: Intrinsics, cfg: Config
) -> Float[Array, "4 4"]:
    """The same steps by all that needs no map: cheap, at a coarse level of the pyramid from farther off."""

    def system(T):
        return jax.tree.map(lambda *parts: sum(parts), *_without_map(T, seen, camera, cfg))

    return descend(system, T, steps)


def _without_map(T: Float[Array, "4 4"], seen: Evidence, camera: Intrinsics, cfg: Config) -> list[System]:
    """Normal equations of all that there is beside the map."""
    colour = jax.tree.map(
        lambda *parts: seen.trust * sum(parts), *colour_systems(T, seen.landmarks, seen.shades, camera, cfg)
    )
    found = [colour]
    if seen.views is not None:
        found.append(view_rows(T, seen.points, seen.views, camera, cfg).system())
    if seen.prior is not None:
        found.append(prior_system(T, seen.prior))
    return found


def adam(
    field: nf.Field,
    T: Float[Array, "4 4"],
    points: Points,
    trust: Float[Array, ""] | float,
    key: PRNGKeyArray,
    cfg: Config,
) -> Float[Array, "4 4"]:
    """First-order refinement of d2t + omega rgb (Eq. 17), as in the paper. `trust` is what colour counts for: a frame
    without an image has none."""
    optimizer = optax.adam(cfg.track.go.learning_rate)

    def loss(twist):
        T_new = perturbed(T, twist)
        psi = nf.tsdf(field, transform(T_new, points.p_cam), cfg.field).psi
        total = losses.d2t(psi, points.mask)
        if not cfg.track.go.rgb:
            return total
        return total + trust * cfg.track.go.rgb * _rgb_loss(field, T_new, points, key, cfg)

    def step(carry, _):
        twist, state = carry
        change, state = optimizer.update(jax.grad(loss)(twist), state)
        return (twist + change, state), None

    zero = jnp.zeros(6)
    (twist, _), _ = jax.lax.scan(step, (zero, optimizer.init(zero)), None, length=cfg.track.go.steps)
    return perturbed(T, twist)


def _rgb_loss(field, T, points: Points, key, cfg: Config) -> Float[Array, ""]:
    tau = cfg.field.truncation
    measured = points.p_cam[:, 2]
    # Only about the surface: free space has no colour to render
    depth = sampling.stratified(
        key, jnp.maximum(measured - tau, sampling.NEAR), measured + tau, cfg.sample.truncation
    )
    ray = points.p_cam / jnp.maximum(measured, sampling.NEAR)[:, None]
    p_sub = transform(T, (ray[:, None] * depth[..., None]).reshape(-1, 3))
    psi = nf.tsdf(field, p_sub, cfg.field).psi.reshape(depth.shape)
    weights = losses.render_weights(psi, jnp.ones_like(psi, bool), tau)
    rgb = nf.color(field, p_sub, cfg.field).reshape(*depth.shape, 3)
    return losses.rgb(losses.render(weights, rgb), points.color, points.mask)
