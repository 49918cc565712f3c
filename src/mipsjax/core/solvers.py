"""What moves a pose from a guess to where its frame fits: second-order steps, and Adam as in the paper.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from mipsjax.config import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, sampling
from mipsjax.core.camera import Intrinsics, transform
from mipsjax.core.views import Views, plane_errors

SATURATED = 0.95  # of the truncation: beyond it the field is flat and says nothing about direction
DAMPING = 1e-3  # first Levenberg-Marquardt factor
DAMPING_DOWN, DAMPING_UP = 0.3, 4.0
VIEW_REACH = 0.1  # metres; a point farther from a keyframe's surface does not belong to it
PRIOR = 1e-3  # added to the 6 x 6 system, m^2 or rad^2: keeps an unobserved direction where it is


class Points(NamedTuple):
    """P measured points of one frame."""

    p_cam: Float[Array, "P 3"]
    color: Float[Array, "P 3"]
    mask: Bool[Array, " P"]
    """False where there is no measurement."""


class Landmarks(NamedTuple):
    """N points of earlier frames that were found again in this one's image."""

    p_sub: Float[Array, "N 3"]
    ray: Float[Array, "N 2"]
    """Where they are seen: image point at focal length 1."""
    mask: Bool[Array, " N"]
    """False fills up to a fixed number."""


def robust_cost(psi: Float[Array, " P"], scale: float) -> Float[Array, " P"]:
    """Cauchy cost, square metres; its weight is 1 / (1 + (psi / scale)^2)."""
    return scale**2 * jnp.log1p((psi / scale) ** 2)


def precisions(points: Points, cfg: Config) -> Float[Array, " P"]:
    """Inverse variances of the points' depths, 1 in the mean of the measured ones and 0 elsewhere."""
    inverse = losses.precision(points.p_cam[:, 2], cfg.sensor) * points.mask
    mean = losses.masked_mean(inverse, points.mask)
    return inverse / jnp.where(mean > 0, mean, 1)


class System(NamedTuple):
    """Cost, and the normal equations of one second-order step."""

    cost: Float[Array, ""]
    hessian: Float[Array, "6 6"]
    slope: Float[Array, "6"]


class Evidence(NamedTuple):
    """What says where one frame is."""

    points: Points
    views: Views | None = None
    """Depth images of keyframes, decimated by a whole factor."""
    landmarks: Landmarks | None = None
    expected: Float[Array, "4 4"] | None = None
    """Its pose by the motion prior."""


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
    image a third, and the motion prior a fourth, so weak that it counts only where nothing else holds the frame.
    """

    def system(T):
        terms = systems(field, T, seen, part, camera, cfg)
        if seen.expected is not None:
            terms = *terms, prior_system(T, seen.expected, cfg)
        return jax.tree.map(lambda *parts: sum(parts), *terms)

    def step(carry, _):
        here, damping = carry
        T, now = here
        damped = now.hessian + damping * jnp.diag(jnp.diag(now.hessian)) + PRIOR * jnp.eye(6)
        twist = -jnp.linalg.solve(damped, now.slope)
        T_new = T @ jaxlie.SE3.exp(twist).as_matrix()
        there = T_new, system(T_new)
        better = there[1].cost < now.cost
        here = jax.tree.map(partial(jnp.where, better), there, here)
        return (here, damping * jnp.where(better, DAMPING_DOWN, DAMPING_UP)), None

    start = ((T, system(T)), jnp.float32(DAMPING))
    ((T, _), _), _ = jax.lax.scan(step, start, None, length=steps)
    return T


def systems(
    field: nf.Field, T: Float[Array, "4 4"], seen: Evidence, part: nf.Part, camera: Intrinsics, cfg: Config
) -> tuple[System, System]:
    """Normal equations of surfaces (the field and depth images of keyframes), and of corners of the image.

    Of a twist (v, omega) in the camera's frame.
    """
    surfaces = map_system(field, T, seen.points, part, cfg)
    if seen.views is not None:
        views = view_systems(T, seen.points, seen.views, camera, cfg)
        surfaces = jax.tree.map(lambda a, b: a + jnp.sum(b, 0), surfaces, views)
    if seen.landmarks is None:
        return surfaces, jax.tree.map(jnp.zeros_like, surfaces)
    return surfaces, landmark_system(T, seen.landmarks, camera, cfg)


def view_systems(
    T: Float[Array, "4 4"], points: Points, views: Views, camera: Intrinsics, cfg: Config
) -> System:
    """Normal equations of the points' distances to the surface in each keyframe's depth image."""
    go, precision = cfg.track.go, precisions(points, cfg)
    small = camera.decimated(round(camera.width / views.depth.shape[2]))

    def one(errors):
        rows, narrow = _jacobian(T, points, errors.normal), go.view_robust
        weight = go.view_weight * precision * errors.mask / (1 + (errors.distance / narrow) ** 2)
        # A point that falls on nothing costs as much as one that is as far off as is allowed
        off = jnp.where(errors.mask, errors.distance, VIEW_REACH)
        return _system(errors.distance, rows, weight, go.view_weight * robust_cost(off, narrow) * precision)

    return jax.vmap(one)(plane_errors(views, transform(T, points.p_cam), small, VIEW_REACH))


def map_system(field: nf.Field, T: Float[Array, "4 4"], points: Points, part: nf.Part, cfg: Config) -> System:
    """Normal equations of the points' distances at a pose, for a twist (v, omega) in the camera's frame."""

    def distance(p_sub):
        prediction = nf.tsdf(field, p_sub, cfg.field, part)
        return prediction.psi, prediction.entropy

    go, scale = cfg.track.go, cfg.track.go.robust
    psi, pull, entropy = jax.vjp(distance, transform(T, points.p_cam), has_aux=True)
    rows = _jacobian(T, points, pull(jnp.ones_like(psi))[0])
    precision = precisions(points, cfg)
    weight = precision * (jnp.abs(psi) < SATURATED * cfg.field.truncation) / (1 + (psi / scale) ** 2)
    if go.uncertainty:
        weight *= losses.certainty(entropy, go.entropy_floor)
    return _system(psi, rows, weight, robust_cost(psi, scale) * precision)


def landmark_system(T: Float[Array, "4 4"], landmarks: Landmarks, camera: Intrinsics, cfg: Config) -> System:
    """Normal equations of where landmarks are seen, for a twist (v, omega) in the camera's frame.

    Errors in the image are scaled so that one standard deviation of a corner is one of a point's depth
    (`sensor.noise_floor`), metres, and both weigh alike.
    """
    corners = cfg.track.corners
    metres = cfg.sensor.noise_floor * camera.fx / corners.noise_px
    p_cam = (landmarks.p_sub - T[None, :3, 3]) @ T[:3, :3]
    in_front = p_cam[:, 2] > sampling.NEAR
    z = jnp.where(in_front, p_cam[:, 2], 1.0)
    aim = p_cam[:, :2] / z[:, None]
    error = metres * (aim - landmarks.ray)
    # T exp(xi) moves a point of the submap by -v - omega x p in the camera's frame
    zero, one = jnp.zeros_like(z), jnp.ones_like(z)
    gradient = jnp.stack(
        [jnp.stack([one, zero, -aim[:, 0]], -1), jnp.stack([zero, one, -aim[:, 1]], -1)], axis=1
    )
    gradient *= (metres / z)[:, None, None]
    rows = jnp.concatenate([-gradient, -jnp.cross(p_cam[:, None], gradient)], -1)
    scale = corners.robust * cfg.sensor.noise_floor
    squared = jnp.sum(error**2, -1)
    weight = corners.weight * (landmarks.mask & in_front) / (1 + squared / scale**2)
    cost = corners.weight * landmarks.mask * scale**2 * jnp.log1p(squared / scale**2)
    return _system(error.reshape(-1), rows.reshape(-1, 6), jnp.repeat(weight, 2), cost)


def prior_system(T: Float[Array, "4 4"], expected: Float[Array, "4 4"], cfg: Config) -> System:
    """Normal equations of the motion from where the frame was expected, for a twist in the camera's frame.

    Scaled as those of the points, whose standard deviation is `sensor.noise_floor`.
    """
    weight = (cfg.sensor.noise_floor / cfg.track.prior) ** 2
    off = jaxlie.SE3.from_matrix(jnp.linalg.inv(expected) @ T).log()
    # The derivative of the logarithm is the identity up to half of `off`, which is small where this counts
    return System(weight * jnp.sum(off**2), weight * jnp.eye(6), weight * off)


def _jacobian(T: Float[Array, "4 4"], points: Points, gradient: Float[Array, "P 3"]) -> Float[Array, "P 6"]:
    """Of distances with this gradient in the submap's frame."""
    gradient = gradient @ T[:3, :3]
    return jnp.concatenate([gradient, jnp.cross(points.p_cam, gradient)], -1)


def _system(
    residual: Float[Array, " P"],
    jacobian: Float[Array, "P 6"],
    weight: Float[Array, " P"],
    cost: Float[Array, " P"],
) -> System:
    weighted = jacobian.T * weight[None]
    return System(jnp.sum(cost), weighted @ jacobian, weighted @ residual)


def adam(
    field: nf.Field, T: Float[Array, "4 4"], points: Points, key: PRNGKeyArray, cfg: Config
) -> Float[Array, "4 4"]:
    """First-order refinement of d2t + omega rgb (Eq. 17), as in the paper."""
    optimizer = optax.adam(cfg.track.go.learning_rate)

    def loss(twist):
        T_new = T @ jaxlie.SE3.exp(twist).as_matrix()
        psi = nf.tsdf(field, transform(T_new, points.p_cam), cfg.field).psi
        total = losses.d2t(psi, points.mask)
        return (
            total + cfg.track.go.rgb * _rgb_loss(field, T_new, points, key, cfg)
            if cfg.track.go.rgb
            else total
        )

    def step(carry, _):
        twist, state = carry
        change, state = optimizer.update(jax.grad(loss)(twist), state)
        return (twist + change, state), None

    zero = jnp.zeros(6)
    (twist, _), _ = jax.lax.scan(step, (zero, optimizer.init(zero)), None, length=cfg.track.go.steps)
    return T @ jaxlie.SE3.exp(twist).as_matrix()


def _rgb_loss(field, T, points: Points, key, cfg: Config) -> Float[Array, ""]:
    tau = cfg.field.truncation
    measured = points.p_cam[:, 2]
    depth = sampling.stratified(
        key, jnp.maximum(measured - tau, sampling.NEAR), measured + tau, cfg.sample.truncation
    )
    ray = points.p_cam / jnp.maximum(measured, sampling.NEAR)[:, None]
    p_sub = transform(T, (ray[:, None] * depth[..., None]).reshape(-1, 3))
    psi = nf.tsdf(field, p_sub, cfg.field).psi.reshape(depth.shape)
    weights = losses.render_weights(psi, jnp.ones_like(psi, bool), tau)
    rgb = nf.color(field, p_sub, cfg.field).reshape(*depth.shape, 3)
    return losses.rgb(losses.render(weights, rgb), points.color, points.mask)
