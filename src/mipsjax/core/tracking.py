"""Tracking of one frame: randomized (RO), then gradient-based (GO) optimisation, as one compiled schedule.

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
from jaxtyping import Array, Bool, Float, PRNGKeyArray, UInt8

from mipsjax.config import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, particles, sampling
from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, rays, transform
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


class Fit(NamedTuple):
    """How well a frame fits the map at a pose."""

    residual: Float[Array, ""]
    """Root of the mean robust cost, metres."""
    known: Float[Array, ""]
    """Share of measured pixels within `keyframe.error` of the mapped surface."""
    confirmed: Float[Array, ""]
    """The same where the map is also certain: space that was never observed looks like surface, but not certainly."""


class TrackInfo(NamedTuple):
    """What happened to one frame."""

    before: Fit
    """At the candidate it starts from."""
    after: Fit
    searched: Bool[Array, ""]
    """RO was run."""
    ok: Bool[Array, ""]
    """Everything is finite; if not, the pose is the candidate."""


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
    return Points(rays(v, u, camera) * d[:, None], color[v, u].astype(jnp.float32) / 255, d > 0)


def robust_cost(psi: Float[Array, " P"], scale: float) -> Float[Array, " P"]:
    """Cauchy cost, square metres; its weight is 1 / (1 + (psi / scale)^2)."""
    return scale**2 * jnp.log1p((psi / scale) ** 2)


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


def levenberg_marquardt(
    field: nf.Field,
    T: Float[Array, "4 4"],
    points: Points,
    part: nf.Part,
    steps: int,
    cfg: Config,
    views: Views | None = None,
    view_camera: Intrinsics | None = None,
    landmarks: Landmarks | None = None,
    pixel: float = 1.0,
) -> Float[Array, "4 4"]:
    """Robust second-order refinement of d2t: residual psi, analytic gradient, Cauchy weight, closed 6 x 6 system.

    Points weigh by the noise of their depth: what is near says more, also of the rotation.
    Uncertain points weigh less, as in RO: what was learned a moment ago is noisier than the rest.
    Points where the field is saturated keep their cost but have no weight, so that a step that loses sight of
    the map is never an improvement. Depth images of keyframes are a second term where `views` are given, and corners
    of the image a third where `landmarks` are; a `pixel` is so wide at focal length 1.
    """
    go, precision = cfg.track.go, precisions(points, cfg)

    def from_view(T, errors):
        rows, narrow = _jacobian(T, points, errors.normal), go.view_robust
        weight = go.view_weight * precision * errors.mask / (1 + (errors.distance / narrow) ** 2)
        # A point that falls on nothing costs as much as one that is as far off as is allowed
        off = jnp.where(errors.mask, errors.distance, VIEW_REACH)
        return _system(errors.distance, rows, weight, go.view_weight * robust_cost(off, narrow) * precision)

    def system(T):
        total = map_system(field, T, points, part, cfg)
        if landmarks is not None:
            seen = landmark_system(T, landmarks, pixel, cfg)
            total = jax.tree.map(jnp.add, total, seen)
        if views is None or view_camera is None:
            return total
        errors = plane_errors(views, transform(T, points.p_cam), view_camera, VIEW_REACH)
        each = jax.vmap(from_view, (None, 0))(T, errors)
        return jax.tree.map(lambda a, b: a + jnp.sum(b, 0), total, each)

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


def landmark_system(T: Float[Array, "4 4"], landmarks: Landmarks, pixel: float, cfg: Config) -> System:
    """Normal equations of where landmarks are seen, for a twist (v, omega) in the camera's frame.

    Errors in the image are scaled so that one standard deviation of a corner is one of a point's depth
    (`sensor.noise_floor`), metres, and both weigh alike.
    """
    corners = cfg.track.corners
    metres = cfg.sensor.noise_floor / (corners.noise_px * pixel)
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


@partial(jax.jit, static_argnames=("camera", "cfg"))
def track(
    field: nf.Field,
    depth: Float[Array, "H W"],
    color: UInt8[Array, "H W 3"],
    candidates: Float[Array, "K 4 4"],
    widening: Float[Array, ""],
    key: PRNGKeyArray,
    camera: Intrinsics,
    cfg: Config,
    views: Views | None = None,
    converged: Float[Array, ""] | None = None,
    landmarks: Landmarks | None = None,
) -> tuple[Float[Array, "4 4"], TrackInfo]:
    """Pose of one frame in the submap, from a few candidates of the motion prior.

    `views` are depth images of keyframes, decimated by a whole factor, that the second-order steps on the fine
    field also align the frame to. `landmarks` are corners of earlier frames, which these steps keep where the frame
    shows them.

    The first candidate is the expected pose. It starts from that one, or from another whose residual on the smooth
    field is below `track.rest` times as much: where surfaces hardly hold a frame, all fit almost alike.

    With `track.ro.when = "always"` this is the paper's RO then GO. With "needed", GO comes first. Where that ends above
    the residual `converged` (metres, `track.ro.residual` if not given), GO by way of the smooth field follows, and
    where that does too, RO then GO; the better end is kept. `widening` is a factor on the swarm's first radii.
    """
    k_go, k_smooth, k_ro, k_adam = jax.random.split(key, 4)
    ro, go = cfg.track.ro, cfg.track.go
    points = draw_points(k_go, depth, color, go.pixels, camera)
    coarse = draw_points(k_smooth, depth, color, go.smooth_pixels, camera)
    search_cost = jax.vmap(lambda T: measure_fit(field, T, coarse, "search", cfg).residual)(candidates)
    start = candidates[jnp.argmin(search_cost.at[0].multiply(cfg.track.rest))]
    before = measure_fit(field, start, points, "whole", cfg)
    view_camera = None if views is None else camera.decimated(round(camera.width / views.depth.shape[2]))

    limit = ro.residual if converged is None else converged
    smooth = go.method == "lm" and cfg.field.encoding == "both"

    def near(T):
        if go.method == "adam":
            T = adam(field, T, points, k_adam, cfg)
        elif go.method == "lm":
            T = levenberg_marquardt(
                field, T, points, "whole", go.steps, cfg, views, view_camera, landmarks, 1 / camera.fx
            )
        return T, measure_fit(field, T, points, "whole", cfg)

    def far(T):
        if smooth:
            T = levenberg_marquardt(field, T, coarse, "search", go.smooth_steps, cfg)
        return near(T)

    def searched(T):
        return far(search(field, depth, color, T, widening, k_ro, camera, cfg))

    def tried(attempt, found):
        """The better of what was found and of another attempt, where the first has not converged; and whether."""
        fit = found[1]
        failed = (fit.residual > limit) | (fit.known < ro.inliers) | ~jnp.isfinite(fit.residual)

        def again():
            there = attempt(start)
            better = (there[1].residual < fit.residual) | ~jnp.isfinite(fit.residual)
            return jax.tree.map(partial(jnp.where, better), there, found)

        return jax.lax.cond(failed, again, lambda: found), failed

    used_ro = jnp.bool_(ro.when == "always")
    if ro.when == "always":
        T, after = searched(start)
    else:
        found = near(start)
        if smooth:
            found, _ = tried(far, found)
        if ro.when == "needed":
            found, used_ro = tried(searched, found)
        T, after = found
    ok = jnp.all(jnp.isfinite(T)) & jnp.isfinite(after.residual)
    return jnp.where(ok, T, start), TrackInfo(before, after, used_ro, ok)


@partial(jax.jit, static_argnames=("camera", "cfg"))
def align(
    field: nf.Field,
    depth: Float[Array, "F H W"],
    T: Float[Array, "F 4 4"],
    camera: Intrinsics,
    cfg: Config,
) -> Float[Array, "F 4 4"]:
    """Poses of F frames after a few second-order steps on every pixel of their (small) depth images.

    A frame that does not come out finite stays where it was.
    """
    v, u = jnp.mgrid[: camera.height, : camera.width].reshape(2, -1)
    ray = rays(v, u, camera)

    def one(d, T):
        d = d.reshape(-1)
        points = Points(ray * d[:, None], jnp.zeros_like(ray), d > 0)
        there = levenberg_marquardt(field, T, points, "whole", cfg.track.go.final_steps, cfg)
        return jnp.where(jnp.all(jnp.isfinite(there)), there, T)

    return jax.vmap(one)(depth, T)


class Registration(NamedTuple):
    """A frame in a submap that may or may not show what it sees."""

    T_sub_cam: Float[Array, "4 4"]
    overlap: Float[Array, ""]
    """Share of measured pixels where the submap is certain of its distance."""
    inliers: Float[Array, ""]
    """Share of those that are within `keyframe.error` of its surface."""
    held: Float[Array, ""]
    """How firmly the surface holds the pose in the direction where it holds it least: mean square, weighted as in
    tracking, of metres of distance for a metre, or a radian, of motion. Near 0 the frame slides or turns freely, as in
    a bare corridor, and the guess says where it is."""


@partial(jax.jit, static_argnames=("camera", "cfg"))
def register(
    field: nf.Field,
    depth: Float[Array, "H W"],
    T: Float[Array, "4 4"],
    camera: Intrinsics,
    cfg: Config,
) -> Registration:
    """Second-order steps from a guess `T`, and what speaks for where they end. `depth` is at mapping size."""
    color = jnp.zeros((*depth.shape, 3), jnp.uint8)
    points = draw_points(jax.random.key(0), depth, color, cfg.track.go.pixels, camera)
    if cfg.field.encoding == "both":
        T = levenberg_marquardt(field, T, points, "search", cfg.track.go.smooth_steps, cfg)
    T = levenberg_marquardt(field, T, points, "whole", cfg.track.go.steps, cfg)
    hessian = map_system(field, T, points, "whole", cfg).hessian
    held = jnp.linalg.eigvalsh(hessian)[0] / jnp.maximum(jnp.sum(points.mask), 1)
    prediction = nf.tsdf(field, transform(T, points.p_cam), cfg.field)
    certain = points.mask & nf.is_certain(prediction.entropy, cfg.correspond.max_entropy, cfg.field)
    near = (jnp.abs(prediction.psi) < cfg.keyframe.error).astype(jnp.float32)
    overlap = losses.masked_mean(certain.astype(jnp.float32), points.mask)
    return Registration(T, overlap, losses.masked_mean(near, certain), held)


def search(
    field: nf.Field,
    depth: Float[Array, "H W"],
    color: UInt8[Array, "H W 3"],
    T: Float[Array, "4 4"],
    widening: Float[Array, ""],
    key: PRNGKeyArray,
    camera: Intrinsics,
    cfg: Config,
) -> Float[Array, "4 4"]:
    """RO: the swarm's iterations by `lax.scan`, on another shift of the pixel grid each."""
    ro = cfg.track.ro
    swarm_template = jnp.asarray(particles.template(ro.particles))

    def step(swarm, k):
        points = draw_points(k, depth, color, ro.pixels, camera)
        return particles.step(swarm, swarm_template, field, points.p_cam, points.mask, cfg.field, ro), None

    radii = widening * jnp.array([ro.rotation] * 3 + [ro.translation] * 3)
    swarm = particles.Swarm(T, jnp.float32(jnp.inf), radii)
    return jax.lax.scan(step, swarm, jax.random.split(key, ro.steps))[0].T_sub_cam
