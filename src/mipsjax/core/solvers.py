"""What moves a pose from a guess to where its frame fits: second-order steps, and Adam as in the paper.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, sampling
from mipsjax.core.camera import Intrinsics
from mipsjax.core.equations import (
    Points,
    Prior,
    Rows,
    System,
    descend,
    mean_precision,
    precisions,
    prior_system,
    robust_cost,
)
from mipsjax.core.photometric import Shades, brightness_system
from mipsjax.core.rigid import perturbed, transform, transform_back
from mipsjax.core.views import PlaneErrors, Views, plane_errors

SATURATED = 0.95  # of the truncation: beyond it the field is flat and says nothing about direction
VIEW_REACH = 0.1  # metres; a point farther from a keyframe's surface does not belong to it
DOUBTED = 3  # weakest directions along which it is asked whether noise alone holds a frame
SURE = 3.0  # standard errors of what is found there by which the frame may be held less


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


class Information(NamedTuple):
    """How firmly a frame is held: inverse covariances of its pose, for a twist (v, omega) in the camera's frame,
    1/m^2 and 1/rad^2, each point, corner and pixel with its weight in the steps; `track.held` says how many of them err
    together."""

    surfaces: Float[Array, "6 6"]
    """By the map and the depth images of keyframes."""
    corners: Float[Array, "6 6"]
    """By corners of the image."""
    brightness: Float[Array, "6 6"]
    """By the brightness of all of it."""
    to_surfaces: Float[Array, "6"]
    """The twist from the pose to where surfaces alone would have it; not finite where these leave something open."""
    to_colour: Float[Array, "6"]
    """To where corners and brightness alone would; the same."""


class Evidence(NamedTuple):
    """What says where one frame is."""

    points: Points
    views: Views | None = None
    """Depth images of keyframes, decimated by a whole factor."""
    landmarks: Landmarks | None = None
    shades: Shades | None = None
    """Images of earlier frames, at one level of the pyramid."""
    trust: Float[Array, ""] | float = 1.0
    """What landmarks and shades count for, of what they would."""
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


def colour_systems(
    T: Float[Array, "4 4"],
    landmarks: Landmarks | None,
    shades: Shades | None,
    camera: Intrinsics,
    cfg: Config,
) -> tuple[System, System]:
    """Normal equations of corners and of brightness, zero where there are none."""
    corners = brightness = System(jnp.zeros(()), jnp.zeros((6, 6)), jnp.zeros(6))
    if landmarks is not None:
        corners = landmark_system(T, landmarks, camera, cfg)
    if shades is not None:
        brightness = brightness_system(T, shades, camera, cfg)
    return corners, brightness


def as_independent(corners: System, brightness: System, cfg: Config) -> System:
    """Both together, as if those that err together were one (`track.held`)."""
    held = cfg.track.held
    return jax.tree.map(lambda c, b: c / held.corners + b / held.brightness, corners, brightness)


def information(
    field: nf.Field,
    T: Float[Array, "4 4"],
    seen: Evidence,
    normals: Float[Array, "P 3"],
    camera: Intrinsics,
    cfg: Config,
) -> Information:
    """What holds a frame at the pose that was found. `normals` are those of its own depth image at the points, in the
    camera's frame (`views.own_normals`)."""
    points = seen.points
    parts = [map_rows(field, T, points, "whole", cfg)]
    if seen.views is not None:
        parts.append(view_rows(T, points, seen.views, camera, cfg))
    surfaces = mean_precision(points, cfg) * steady_hessian(parts, points, normals)
    close_by = 1 / cfg.sensor.noise_floor**2
    # Points weigh relative to each other, colour relative to points: here each by what it is worth
    corners, brightness = colour_systems(T, seen.landmarks, seen.shades, camera, cfg)
    return Information(
        close_by * surfaces,
        close_by * corners.hessian,
        close_by * brightness.hessian,
        _step(*(part.system() for part in parts)),
        _step(as_independent(corners, brightness, cfg)),
    )


def _step(*systems: System) -> Float[Array, "6"]:
    """The twist to where these alone would have the frame."""
    together = jax.tree.map(lambda *parts: sum(parts), *systems)
    return -jnp.linalg.solve(together.hessian, together.slope)


def steady_hessian(parts: list[Rows], points: Points, normals: Float[Array, "P 3"]) -> Float[Array, "6 6"]:
    """The Hessian of the points' distances to some surfaces, without what only noise makes of it.

    Normals are noisy, and surfaces that were learned have bumps: along a bare wall both seem to hold a frame that
    slides freely. Surfaces and the frame's own `normals` do not know of each other's noise, so that the Hessian of
    both has the right mean, of points that lie on a plane of the frame. Along the directions in which that is weakest
    only that counts, less its own noise.
    """
    hessian = sum(part.system().hessian for part in parts)
    own = by_twist(points.p_cam, normals)
    # A point's own noise is the same against each surface
    each = [(part.weight[..., None] * part.jacobian).reshape(-1, *own.shape) for part in parts]
    # Over all surfaces that a point was measured against
    weighted = jnp.sum(jnp.concatenate(each), 0)
    # Noise of the two factors is independent, so that the mean of their product is that without noise
    agreed = weighted.T @ own
    # Not those of the Hessian: by noise they lean towards what is held, which is a hundred times as firm
    strength, directions = jnp.linalg.eigh((agreed + agreed.T) / 2)
    weakest = directions[:, :DOUBTED]
    noise = jnp.linalg.norm((weighted @ weakest) * (own @ weakest), axis=0)
    steady = jnp.maximum(strength[:DOUBTED] - SURE * noise, 0)
    others = jnp.eye(6) - weakest @ weakest.T
    return others @ hessian @ others + (weakest * steady[None]) @ weakest.T


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
    p_cam = transform_back(T, landmarks.p_sub)
    in_front = p_cam[:, 2] > sampling.NEAR
    z = jnp.where(in_front, p_cam[:, 2], 1.0)
    # At focal length 1: errors of all corners have one unit, which `metres` turns into that of depth
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


def _jacobian(T: Float[Array, "4 4"], points: Points, gradient: Float[Array, "P 3"]) -> Float[Array, "P 6"]:
    """Of distances with this gradient in the submap's frame."""
    return by_twist(points.p_cam, gradient @ T[:3, :3])


def by_twist(p_cam: Float[Array, "P 3"], gradient: Float[Array, "P 3"]) -> Float[Array, "P 6"]:
    """How what has this gradient in the camera's frame changes with a twist."""
    return jnp.concatenate([gradient, jnp.cross(p_cam, gradient)], -1)


def adam(
    field: nf.Field, T: Float[Array, "4 4"], points: Points, key: PRNGKeyArray, cfg: Config
) -> Float[Array, "4 4"]:
    """First-order refinement of d2t + omega rgb (Eq. 17), as in the paper."""
    optimizer = optax.adam(cfg.track.go.learning_rate)

    def loss(twist):
        T_new = perturbed(T, twist)
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
