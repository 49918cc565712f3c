"""What moves a pose from a guess to where its frame fits: second-order steps, and Adam as in the paper.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

from collections.abc import Callable
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
from mipsjax.core.views import PlaneErrors, Views, plane_errors

SATURATED = 0.95  # of the truncation: beyond it the field is flat and says nothing about direction
DAMPING = 1e-3  # first Levenberg-Marquardt factor
DAMPING_DOWN, DAMPING_UP = 0.3, 4.0
VIEW_REACH = 0.1  # metres; a point farther from a keyframe's surface does not belong to it
SETTLED = 3e-4  # metres, or rad: what a step is shorter than after which no more are tried
PROBED = 3  # weakest directions along which it is measured how firmly a frame is held
PROBE = (
    0.08  # metres by which the frame is moved for that: past the pixels that each normal is of, within reach
)
SURE = 2.0  # standard errors of that measurement by which the frame may be held less
PROBE_REACH = 2.0  # metres from the camera at which a turn moves points by as much
FLOOR = 1e-3  # added to the 6 x 6 system, m^2 or rad^2: keeps an unobserved direction where it is


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
    axes: Float[Array, "N 2 2"]
    """What an error of that is multiplied by: rows are directions in the image, of length 1 where it is known as well
    as can be, 0 where it is not known at all."""
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


def mean_precision(points: Points, cfg: Config) -> Float[Array, ""]:
    """Of the measured points' depths, 1 close by: what `precisions` are relative to."""
    return losses.masked_mean(losses.precision(points.p_cam[:, 2], cfg.sensor), points.mask)


class System(NamedTuple):
    """Cost, and the normal equations of one second-order step."""

    cost: Float[Array, ""]
    hessian: Float[Array, "6 6"]
    slope: Float[Array, "6"]


class Rows(NamedTuple):
    """P residuals that are to vanish; what follows from them is summed over P."""

    residual: Float[Array, "*K P"]
    """Metres."""
    jacobian: Float[Array, "*K P 6"]
    """By a twist (v, omega) in the camera's frame."""
    weight: Float[Array, "*K P"]
    cost: Float[Array, "*K P"]

    def system(self) -> System:
        """Of all rows together."""
        rows = self.jacobian.reshape(-1, 6)
        weighted = rows.T * self.weight.reshape(-1)[None]
        return System(jnp.sum(self.cost), weighted @ rows, weighted @ self.residual.reshape(-1))


class Information(NamedTuple):
    """How firmly a frame is held: inverse covariances of its pose, for a twist (v, omega) in the camera's frame,
    1/m^2 and 1/rad^2, as if each point and corner erred alone."""

    surfaces: Float[Array, "6 6"]
    """By the map and the depth images of keyframes."""
    corners: Float[Array, "6 6"]
    """By corners of the image."""


class Prior(NamedTuple):
    """A pose that a frame has if nothing else says where it is."""

    T_sub_cam: Float[Array, "4 4"]
    weight: Float[Array, "6 6"]
    """Inverse covariance, relative to that of a point's distance: of a twist (v, omega) in the camera's frame."""


class Evidence(NamedTuple):
    """What says where one frame is."""

    points: Points
    views: Views | None = None
    """Depth images of keyframes, decimated by a whole factor."""
    landmarks: Landmarks | None = None
    prior: Prior | None = None


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
    image a third, and a prior pose a fourth.
    """

    def system(T):
        terms = systems(field, T, seen, part, camera, cfg)
        if seen.prior is not None:
            terms = *terms, prior_system(T, seen.prior)
        return jax.tree.map(lambda *parts: sum(parts), *terms)

    return descend(system, T, steps)


class _Descent(NamedTuple):
    """Levenberg-Marquardt on its way."""

    T: Float[Array, "4 4"]
    here: System
    """At that pose."""
    damping: Float[Array, ""]
    settled: Bool[Array, ""]


def descend(
    system: Callable[[Float[Array, "4 4"]], System], T: Float[Array, "4 4"], steps: int
) -> Float[Array, "4 4"]:
    """Levenberg-Marquardt on the normal equations that `system` gives of a pose, for a twist in the camera's frame:
    at most so many steps, none after one that is shorter than `SETTLED`. Under `vmap` all are computed."""

    def step(now: _Descent) -> _Descent:
        hessian = now.here.hessian
        damped = hessian + now.damping * jnp.diag(jnp.diag(hessian)) + FLOOR * jnp.eye(6)
        twist = -jnp.linalg.solve(damped, now.here.slope)
        T_new = now.T @ jaxlie.SE3.exp(twist).as_matrix()
        there = system(T_new)
        better = there.cost < now.here.cost
        T, here = jax.tree.map(partial(jnp.where, better), (T_new, there), (now.T, now.here))
        damping = now.damping * jnp.where(better, DAMPING_DOWN, DAMPING_UP)
        return _Descent(T, here, damping, jnp.linalg.norm(twist) < SETTLED)

    def unless_settled(now: _Descent, _: None) -> tuple[_Descent, None]:
        return jax.lax.cond(now.settled, lambda ended: ended, step, now), None

    start = _Descent(T, system(T), jnp.float32(DAMPING), jnp.bool_(False))
    return jax.lax.scan(unless_settled, start, None, length=steps)[0].T


def systems(
    field: nf.Field, T: Float[Array, "4 4"], seen: Evidence, part: nf.Part, camera: Intrinsics, cfg: Config
) -> tuple[System, System]:
    """Normal equations of surfaces (the field and depth images of keyframes), and of corners of the image."""
    surfaces = map_rows(field, T, seen.points, part, cfg).system()
    if seen.views is not None:
        views = view_rows(T, seen.points, seen.views, camera, cfg).system()
        surfaces = jax.tree.map(jnp.add, surfaces, views)
    if seen.landmarks is None:
        return surfaces, jax.tree.map(jnp.zeros_like, surfaces)
    return surfaces, landmark_system(T, seen.landmarks, camera, cfg)


def information(
    field: nf.Field, T: Float[Array, "4 4"], seen: Evidence, camera: Intrinsics, cfg: Config
) -> Information:
    """What holds a frame at the pose that was found.

    Normals are noisy: along a bare wall they seem to hold a frame that slides freely. Along the directions in which
    the normal equations are weakest it is therefore measured how distances change when the frame is moved: the product
    of noisy normals and of a change that does not know of this noise has the right mean. Its own noise is taken off.
    """
    points = seen.points
    on_map = map_rows(field, T, points, "whole", cfg)
    on_views = None if seen.views is None else view_rows(T, points, seen.views, camera, cfg)
    parts = [on_map] if on_views is None else [on_map, on_views]

    def moved(twist):
        """Distances there, and where there are any."""
        T_moved = T @ jaxlie.SE3.exp(twist).as_matrix()
        psi = nf.tsdf(field, transform(T_moved, points.p_cam), cfg.field, "whole").psi
        there = [(psi, points.mask)]
        if seen.views is not None:
            errors = view_errors(T_moved, points, seen.views, camera, cfg)
            there.append((errors.distance, errors.mask))
        return there

    surfaces = mean_precision(points, cfg) * steady_hessian(parts, moved)
    close_by = 1 / cfg.sensor.noise_floor**2
    # Points weigh relative to each other, corners relative to points: here each by what it is worth
    if seen.landmarks is None:
        return Information(close_by * surfaces, jnp.zeros((6, 6)))
    corners = landmark_system(T, seen.landmarks, camera, cfg).hessian
    return Information(close_by * surfaces, close_by * corners)


Distances = list[tuple[Float[Array, "*K P"], Bool[Array, "*K P"]]]
"""For each part of the surfaces that points are measured against: of the points, and which of these are known."""


def steady_hessian(parts: list[Rows], moved: Callable[[Float[Array, "6"]], Distances]) -> Float[Array, "6 6"]:
    """The Hessian of these parts together, without what only the noise of normals makes of it; `moved` gives the
    distances after a twist."""
    hessian = sum(part.system().hessian for part in parts)
    strength, directions = jnp.linalg.eigh(hessian)

    def measured(direction):
        shift, turn = jnp.linalg.norm(direction[:3]), jnp.linalg.norm(direction[3:])
        size = PROBE / jnp.maximum(shift, PROBE_REACH * turn)
        forth, back = moved(size * direction), moved(-size * direction)
        each = []
        for part, (there, seen), (behind, seen_too) in zip(parts, forth, back, strict=True):
            change = (seen & seen_too) * (there - behind)
            each.append((part.weight * (part.jacobian @ direction) * change).reshape(-1))
        strengths = jnp.concatenate(each) / (2 * size)
        return jnp.sum(strengths) - SURE * jnp.linalg.norm(strengths)

    weakest = directions[:, :PROBED].T
    excess = strength[:PROBED] - jnp.maximum(jax.lax.map(measured, weakest), 0)
    return hessian - jnp.einsum("k,ki,kj->ij", excess, weakest, weakest)


def view_rows(T: Float[Array, "4 4"], points: Points, views: Views, camera: Intrinsics, cfg: Config) -> Rows:
    """The points' distances to the surface in the depth image of each of K keyframes."""
    go, precision = cfg.track.go, precisions(points, cfg)[None]
    errors = view_errors(T, points, views, camera, cfg)
    weight = go.view_weight * precision * errors.mask / (1 + (errors.distance / go.view_robust) ** 2)
    # A point that falls on nothing costs as much as one that is as far off as is allowed
    off = jnp.where(errors.mask, errors.distance, VIEW_REACH)
    cost = go.view_weight * robust_cost(off, go.view_robust) * precision
    jacobian = jax.vmap(partial(_jacobian, T, points))(errors.normal)
    return Rows(errors.distance, jacobian, weight, cost)


def view_errors(
    T: Float[Array, "4 4"], points: Points, views: Views, camera: Intrinsics, cfg: Config
) -> PlaneErrors:
    """The points at a pose against the views, of which `camera` is that before they were decimated."""
    small = camera.decimated(round(camera.width / views.depth.shape[2]))
    return plane_errors(views, transform(T, points.p_cam), small, VIEW_REACH, cfg.sensor.noise_growth)


def map_rows(field: nf.Field, T: Float[Array, "4 4"], points: Points, part: nf.Part, cfg: Config) -> Rows:
    """The points' distances in the map at a pose."""

    def distance(p_sub):
        prediction = nf.tsdf(field, p_sub, cfg.field, part)
        return prediction.psi, prediction.entropy

    go, scale = cfg.track.go, cfg.track.go.robust
    psi, pull, entropy = jax.vjp(distance, transform(T, points.p_cam), has_aux=True)
    jacobian = _jacobian(T, points, pull(jnp.ones_like(psi))[0])
    precision = precisions(points, cfg)
    weight = precision * (jnp.abs(psi) < SATURATED * cfg.field.truncation) / (1 + (psi / scale) ** 2)
    if go.uncertainty:
        weight *= losses.certainty(entropy, go.entropy_floor)
    return Rows(psi, jacobian, weight, robust_cost(psi, scale) * precision)


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
    error = metres * jnp.einsum("nij,nj->ni", landmarks.axes, aim - landmarks.ray)
    # T exp(xi) moves a point of the submap by -v - omega x p in the camera's frame
    zero, one = jnp.zeros_like(z), jnp.ones_like(z)
    gradient = jnp.stack(
        [jnp.stack([one, zero, -aim[:, 0]], -1), jnp.stack([zero, one, -aim[:, 1]], -1)], axis=1
    )
    gradient = landmarks.axes @ gradient * (metres / z)[:, None, None]
    rows = jnp.concatenate([-gradient, -jnp.cross(p_cam[:, None], gradient)], -1)
    scale = corners.robust * cfg.sensor.noise_floor
    squared = jnp.sum(error**2, -1)
    weight = corners.weight * (landmarks.mask & in_front) / (1 + squared / scale**2)
    cost = corners.weight * landmarks.mask * scale**2 * jnp.log1p(squared / scale**2)
    return Rows(error, rows, jnp.repeat(weight[:, None], 2, 1), cost).system()


def prior_system(T: Float[Array, "4 4"], prior: Prior) -> System:
    """Normal equations of how far a pose is from the prior one, for a twist in the camera's frame."""
    off = jaxlie.SE3.from_matrix(jnp.linalg.inv(prior.T_sub_cam) @ T).log()
    # The derivative of the logarithm is the identity up to half of `off`, which is small where this counts
    slope = prior.weight @ off
    return System(off @ slope, prior.weight, slope)


def _jacobian(T: Float[Array, "4 4"], points: Points, gradient: Float[Array, "P 3"]) -> Float[Array, "P 6"]:
    """Of distances with this gradient in the submap's frame."""
    gradient = gradient @ T[:3, :3]
    return jnp.concatenate([gradient, jnp.cross(points.p_cam, gradient)], -1)


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
