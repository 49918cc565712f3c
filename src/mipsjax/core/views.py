"""Points against depth images of keyframes: the map as it was measured, for what the networks do not know yet."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mipsjax.core.camera import Intrinsics, project, unproject
from mipsjax.core.rigid import transform_back, turned

STEP = 2  # pixels between the neighbours from which a normal is taken: one is too noisy
STEADY = 64  # so many such steps make the image's width, where it matters more that a normal has little noise
JUMP = 0.05  # of the depth: neighbours farther apart are on different surfaces
BEND = 0.005  # metres from the middle of opposite neighbours to the pixel: beyond it there is no plane
REACH = 2  # pixels around where a point falls in which nothing near it was seen, if a view saw through it: poses err
SIDE = 2 * REACH + 1
ALLOWED = 3.0  # deviations of the depth that are no free space
HALF = 0.5  # share of those pixels that say anything, at least
NOISE = 2.0  # deviations of the depth by which that may be more: in the noise of 3 m no plane is that even


class Views(NamedTuple):
    """K posed depth images of one size; K may be 0."""

    depth: Float[Array, "K h w"]
    """Metres, 0 for no measurement."""
    T_sub_cam: Float[Array, "K 4 4"]


class Planes(NamedTuple):
    """The surface at P pixels of a depth image, camera frame."""

    point: Float[Array, "P 3"]
    """Metres."""
    normal: Float[Array, "P 3"]
    """Unit vectors towards the camera."""
    smooth: Bool[Array, " P"]
    """The four neighbours are on the same surface; elsewhere the normal means nothing."""
    flat: Bool[Array, " P"]
    """And it is a plane around the pixel."""


class PlaneErrors(NamedTuple):
    """P points against K views."""

    distance: Float[Array, "K P"]
    """Signed distance to the plane seen at the pixel where the point falls, metres; 0 where masked."""
    normal: Float[Array, "K P 3"]
    """Submap frame."""
    mask: Bool[Array, "K P"]


def plane_errors(
    views: Views, p_sub: Float[Array, "P 3"], camera: Intrinsics, reach: float, noise_growth: float
) -> PlaneErrors:
    """Projective point-to-plane distances (Blais and Levine 1995). `camera` is that of the views, `noise_growth` that
    of their depth (`SensorConfig`).

    Masked where the point is out of view, the image has no plane there, or the two are `reach` metres apart.
    """

    def one(depth, T_sub_cam):
        pixel = _pixels(p_sub, T_sub_cam, depth.shape, camera)
        planes = planes_at(depth, pixel.v, pixel.u, camera, noise_growth)
        distance = jnp.sum((pixel.p_cam - planes.point) * planes.normal, -1)
        mask = pixel.inside & planes.flat & (jnp.abs(distance) < reach)
        return PlaneErrors(jnp.where(mask, distance, 0.0), turned(T_sub_cam[:3, :3], planes.normal), mask)

    return jax.vmap(one)(views.depth, views.T_sub_cam)


def observed(
    views: Views, p_sub: Float[Array, "P 3"], camera: Intrinsics, margin: float
) -> Bool[Array, " P"]:
    """Which points lie where a view measured: not outside of all images, nor `margin` metres or more behind what they
    saw. What a map says elsewhere was never learned. `camera` is that of the views."""

    def one(depth, T_sub_cam):
        pixel = _pixels(p_sub, T_sub_cam, depth.shape, camera)
        d = depth[pixel.v, pixel.u]
        # In front of what was seen is free space, which was observed as well
        return pixel.inside & (d > 0) & (pixel.p_cam[:, 2] < d + margin)

    return jnp.any(jax.vmap(one)(views.depth, views.T_sub_cam), 0)


def seen_through(
    views: Views, p_sub: Float[Array, "P 3"], camera: Intrinsics, margin: float, noise_growth: float
) -> Bool[Array, " P"]:
    """Which points lie where a view looked through free space: `margin` metres, and what noise makes, before all that
    it saw in a small square around where they fall. `camera` is that of the views."""

    def one(depth, T_sub_cam):
        pixel = _pixels(p_sub, T_sub_cam, depth.shape, camera)
        nearest, measured = _square(depth)
        free_to = nearest - margin - ALLOWED * noise_growth * nearest**2
        free_to = jnp.where(measured > HALF, free_to, -jnp.inf)
        return pixel.inside & (pixel.p_cam[:, 2] < free_to[pixel.v, pixel.u])

    return jnp.any(jax.vmap(one)(views.depth, views.T_sub_cam), 0)


def _square(depth: Float[Array, "h w"]) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """The nearest depth around each pixel, infinite where there is none, and the share of pixels with depth there."""
    exists = depth > 0
    nearest = _around(jnp.where(exists, depth, jnp.inf), jnp.inf, jnp.minimum)
    return nearest, _around(exists.astype(jnp.float32), 0.0, jnp.add) / SIDE**2


def _around(
    image: Float[Array, "h w"], beyond: float, both: Callable[[jax.Array, jax.Array], jax.Array]
) -> Float[Array, "h w"]:
    """All of a square around each pixel as one. Shifted images, along one axis after the other: XLA is slow on a CPU
    where it reduces windows."""
    for axis in (0, 1):
        margins = [(REACH, REACH) if axis == each else (0, 0) for each in (0, 1)]
        padded = jnp.pad(image, margins, constant_values=beyond)
        shifted = [jax.lax.slice_in_dim(padded, i, i + image.shape[axis], axis=axis) for i in range(SIDE)]
        image = reduce(both, shifted)
    return image


def own_normals(
    depth: Float[Array, "h w"], p_cam: Float[Array, "P 3"], camera: Intrinsics, noise_growth: float
) -> Float[Array, "P 3"]:
    """Unit normals, camera frame, of the surface that a depth image shows where its own points are, with as little
    noise as its extent allows; 0 where it is no plane."""
    height, width = depth.shape
    pixel = _pixels(p_cam, jnp.eye(4), (height, width), camera)
    normal = jnp.zeros_like(p_cam)
    for step in (STEP, max(STEP, width // STEADY)):
        planes = planes_at(depth, pixel.v, pixel.u, camera, noise_growth, step)
        normal = jnp.where((planes.flat & pixel.inside)[:, None], planes.normal, normal)
    return normal


class _Pixels(NamedTuple):
    """Where P points fall in one image."""

    p_cam: Float[Array, "P 3"]
    v: Int[Array, " P"]
    u: Int[Array, " P"]
    """Within the image, whatever the point."""
    inside: Bool[Array, " P"]


def _pixels(
    p_sub: Float[Array, "P 3"], T_sub_cam: Float[Array, "4 4"], size: tuple[int, int], camera: Intrinsics
) -> _Pixels:
    height, width = size
    p_cam = transform_back(T_sub_cam, p_sub)
    u, v = jnp.round(project(p_cam, camera)).T
    # Before clipping: a pixel outside of the image is no pixel on its border
    inside = (p_cam[:, 2] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    v, u = jnp.clip(v, 0, height - 1).astype(jnp.int32), jnp.clip(u, 0, width - 1).astype(jnp.int32)
    return _Pixels(p_cam, v, u, inside)


def planes_at(
    depth: Float[Array, "h w"],
    v: Int[Array, " P"],
    u: Int[Array, " P"],
    camera: Intrinsics,
    noise_growth: float,
    step: int = STEP,
) -> Planes:
    """Points and normals at some pixels, from central differences of the depth image over so many pixels to each side.
    `noise_growth` is that of its depth (`SensorConfig`)."""
    height, width = depth.shape

    def point(dv, du):
        vv, uu = jnp.clip(v + dv, 0, height - 1), jnp.clip(u + du, 0, width - 1)
        return unproject(vv, uu, depth[vv, uu], camera)

    here = point(0, 0)
    right, left, down, up = point(0, step), point(0, -step), point(step, 0), point(-step, 0)
    # In this order it points towards the camera: x is right, y down, z forward
    normal = jnp.cross(down - up, right - left)
    squared = jnp.sum(normal**2, -1)
    # Beside missing depth the differences may be parallel, or nothing
    exists = squared > 1e-18
    normal = normal * jax.lax.rsqrt(jnp.where(exists, squared, 1.0))[:, None]
    jumps = [jnp.abs(p[:, 2] - here[:, 2]) < JUMP * here[:, 2] for p in (right, left, down, up)]
    smooth = jnp.stack(jumps).all(0) & exists
    off = [jnp.abs(jnp.sum(((a + b) / 2 - here) * normal, -1)) for a, b in ((right, left), (down, up))]
    # Noise of depth grows with its square (structured light and stereo)
    even = BEND + NOISE * noise_growth * here[:, 2] ** 2
    return Planes(here, normal, smooth, smooth & (jnp.maximum(*off) < even))
