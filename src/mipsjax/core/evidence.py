"""What says where one frame is, as rows of weighted residuals and their normal equations.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, sampling
from mipsjax.core.camera import Intrinsics
from mipsjax.core.equations import Points, Prior, Rows, System, precisions, robust_cost
from mipsjax.core.photometric import Shades, brightness_system
from mipsjax.core.rigid import transform, transform_back, turned
from mipsjax.core.views import PlaneErrors, Views, plane_errors

SATURATED = 0.95  # of the truncation: beyond it the field is flat and says nothing about direction
VIEW_REACH = 0.1  # metres; a point farther from a keyframe's surface does not belong to it


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


def map_rows(
    field: nf.Field,
    T: Float[Array, "4 4"],
    points: Points,
    part: nf.Part,
    cfg: Config,
    certainty: Float[Array, " P"] | None = None,
) -> Rows:
    """The points' distances in the map at a pose.

    Each counts by how certain the map is of it there, but costs the same, so that where the map knows nothing is no way
    out. With `certainty`, as it was at another pose (`certainties`), both go by that: weights and costs are of one
    problem then, as solvers expect that know nothing of weights.
    """

    def distance(p_sub):
        prediction = nf.tsdf(field, p_sub, cfg.field, part)
        return prediction.psi, prediction.entropy

    go, scale = cfg.track.go, cfg.track.go.robust
    psi, pull, entropy = jax.vjp(distance, transform(T, points.p_cam), has_aux=True)
    jacobian = _jacobian(T, points, pull(jnp.ones_like(psi))[0])
    precision = precisions(points, cfg)
    weight = precision * (jnp.abs(psi) < SATURATED * cfg.field.truncation) / (1 + (psi / scale) ** 2)
    cost = robust_cost(psi, scale) * precision
    if certainty is not None:
        return Rows(psi, jacobian, certainty * weight, certainty * cost)
    if go.uncertainty:
        weight *= losses.certainty(entropy, go.entropy_floor)
    return Rows(psi, jacobian, weight, cost)


def certainties(
    field: nf.Field, T: Float[Array, "4 4"], points: Points, part: nf.Part, cfg: Config
) -> Float[Array, " P"]:
    """What points at a pose count for by how certain the map is of them there; 1 where that is not asked for."""
    if not cfg.track.go.uncertainty:
        return jnp.ones(points.mask.shape)
    entropy = nf.tsdf(field, transform(T, points.p_cam), cfg.field, part).entropy
    return losses.certainty(entropy, cfg.track.go.entropy_floor)


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
    return by_twist(points.p_cam, turned(T[:3, :3].T, gradient))


def by_twist(p_cam: Float[Array, "P 3"], gradient: Float[Array, "P 3"]) -> Float[Array, "P 6"]:
    """How what has this gradient in the camera's frame changes with a twist."""
    return jnp.concatenate([gradient, jnp.cross(p_cam, gradient)], -1)
