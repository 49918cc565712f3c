"""Brightness of a frame's points against images of earlier frames: one surface is as bright in both, up to a gain and
an offset that are the image's own (Steinbrücker, Sturm and Cremers 2011; Kerl, Sturm and Cremers 2013).

Corners are few and look for themselves; here every pixel with a gradient says a little, and depth says where it goes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from mipsjax.config.sections import Config
from mipsjax.core import losses
from mipsjax.core.camera import Intrinsics, grid_shape, project, unproject
from mipsjax.core.equations import Rows, System
from mipsjax.core.rigid import transform, transform_back, turned
from mipsjax.core.sampling import NEAR
from mipsjax.core.views import JUMP

LEVELS = 3
"""Of the pyramid: images themselves, then half as wide each time."""
STEEP = 0.012
"""Change of brightness from one pixel to the next, of all that there is, below which it may be an image's noise."""
HIDDEN_M, HIDDEN = 0.05, 0.02
"""Metres, and share of the depth, by which a point may lie off the surface that an image shows in its place; farther
off it is hidden there, or hides that surface."""
REACH_PX = 2
"""Pixels, about, from which a smoothed gradient is taken along each direction."""
EDGE_PX, EDGE = 8, 0.1
"""Pixels on both sides of one within which no edge of depth may be, and the relative change of inverse depth that is
one."""
LOST = 3.0
"""Scales of the robust cost by which an error costs most: as much as a point that an image does not show. So no step
gains by losing sight of it."""
FEWEST = 50
"""Steep points that an image shows, below which it says nothing."""
DEVIATION = 1.48
"""Standard deviation for a median of absolute errors."""


class Images(NamedTuple):
    """K frames of known pose, as they looked."""

    grey: UInt8[Array, "K H W"]
    depth: Float[Array, "K h w"]
    """Decimated by a whole factor; metres, 0 for no measurement. That of `Corners` has none: holes are filled."""
    T_sub_cam: Float[Array, "K 4 4"]
    mask: Bool[Array, " K"]
    """False fills up to a fixed number."""


class Shades(NamedTuple):
    """Points of a frame, and the images in which they are looked for, at one level of the pyramid: P others in each
    image, for a point says little more in a second one."""

    p_cam: Float[Array, "K P 3"]
    measured: Bool[Array, "K P"]
    """False where a part of the frame has no point."""
    brightness: Float[Array, "K P"]
    """In their own frame: 0 to 1."""
    texture: Float[Array, "K h w 3"]
    """Brightness of the images, and its change from pixel to pixel along u and v."""
    images: Images
    noise: Float[Array, " K"]
    """Standard deviation of the difference."""


def pyramid(
    images: Images,
    grey: Float[Array, "H W"],
    depth: Float[Array, "h w"],
    levels: int,
    camera: Intrinsics,
    cfg: Config,
) -> list[Shades]:
    """The levels, the finest first, of a frame of this brightness, 0 to 255, and depth, metres, decimated by a whole
    factor. The noise is the least that there is."""
    count = len(images.mask)
    own = [_texture(grey, level) for level in range(levels)]
    pixel, p_cam, measured = _steepest(own[0], depth, cfg.track.brightness.pixels, camera)
    each = -(-len(measured) // count)

    def shared_out(values):
        """Every K-th for the first of K images, the next ones for the second, and so on; filled up with nothing."""
        filled = jnp.pad(values, [(0, each * count - len(values)), *[(0, 0)] * (values.ndim - 1)])
        return filled.reshape(each, count, *values.shape[1:]).swapaxes(0, 1)

    p_cam, measured = shared_out(p_cam), shared_out(measured)
    noise, found = jnp.full(count, cfg.track.brightness.noise), []
    for level, texture in enumerate(own):
        size = 2**level
        # A pixel of a coarser level is the mean of so many times so many, and lies between them
        brightness = shared_out(_between(texture[..., :1], (pixel + 0.5) / size - 0.5)[:, 0])
        others = jax.vmap(lambda image, level=level: _texture(image.astype(jnp.float32), level))(images.grey)
        found.append(Shades(p_cam, measured, brightness, others, images, noise))
    return found


def _steepest(
    texture: Float[Array, "H W 3"], depth: Float[Array, "h w"], pixels: int, camera: Intrinsics
) -> tuple[Float[Array, "P 2"], Float[Array, "P 3"], Bool[Array, " P"]]:
    """Of each cell of a stripe grid the pixel where brightness changes most, among those that lie on one surface:
    where it is in the image (u, v), the point that it shows, and whether there is one that is steep."""
    every = round(camera.width / depth.shape[1])
    steepness = jnp.sum(texture[::every, ::every, 1:] ** 2, -1)
    alone = _on_one_surface(depth, -(-REACH_PX // every)) & ~_beside_an_edge(depth, -(-EDGE_PX // every))
    steep = alone & (steepness > STEEP**2)
    steepness = jnp.where(steep, steepness, 0)
    (height, width), (rows, columns) = depth.shape, grid_shape(pixels, *depth.shape)
    high, wide = -(-height // rows), -(-width // columns)
    rows, columns = -(-height // high), -(-width // wide)
    # Cells are whole: the last ones reach beyond the image, where nothing is steep
    whole = jnp.pad(steepness, ((0, rows * high - height), (0, columns * wide - width)))
    cells = whole.reshape(rows, high, columns, wide).swapaxes(1, 2).reshape(rows * columns, high * wide)
    best, cell = jnp.argmax(cells, -1), jnp.arange(rows * columns)
    v, u = cell // columns * high + best // wide, cell % columns * wide + best % wide
    p_cam = unproject(v, u, depth[v, u], camera.decimated(every))
    pixel = every * jnp.stack([u, v], -1).astype(jnp.float32)
    return pixel, p_cam, jnp.max(cells, -1) > 0


def _on_one_surface(depth: Float[Array, "h w"], reach: int) -> Bool[Array, "h w"]:
    """Pixels whose neighbours, up to so many away, were measured and are about as far off: beside an edge of depth, one
    does not know which side a change of brightness belongs to."""
    padded, there = jnp.pad(depth, reach), depth > 0
    for off in (*range(-reach, 0), *range(1, reach + 1)):
        for v, u in ((off, 0), (0, off)):
            beside = jax.lax.dynamic_slice(padded, (reach + v, reach + u), depth.shape)
            there &= jnp.abs(beside - depth) < JUMP * depth
    return there


def _beside_an_edge(depth: Float[Array, "h w"], reach: int) -> Bool[Array, "h w"]:
    """Pixels of which two opposite ones, up to so many away, are not in line with them by inverse depth, as those of a
    plane are.

    A moving camera blurs what is in front over what is behind. Those that were not measured say nothing.
    """
    inverse = jnp.where(depth > 0, 1 / jnp.maximum(depth, NEAR), 0)
    padded, bent = jnp.pad(inverse, reach), jnp.zeros(depth.shape, bool)
    for off in range(1, reach + 1):
        for v, u in ((off, 0), (0, off)):
            before = jax.lax.dynamic_slice(padded, (reach - v, reach - u), depth.shape)
            after = jax.lax.dynamic_slice(padded, (reach + v, reach + u), depth.shape)
            bend = jnp.abs(before + after - 2 * inverse)
            bent |= (before > 0) & (after > 0) & (bend > EDGE * inverse)
    return bent


def grey_of(color: UInt8[Array, "H W 3"]) -> Float[Array, "H W"]:
    """Brightness of an RGB image, 0 to 255 (ITU-R BT.601)."""
    return color.astype(jnp.float32) @ jnp.array([0.299, 0.587, 0.114])


def brightness_system(T: Float[Array, "4 4"], seen: Shades, camera: Intrinsics, cfg: Config) -> System:
    """Normal equations of differences in brightness, for a twist (v, omega) in the camera's frame.

    They are scaled so that one standard deviation is one of a point's depth (`sensor.noise_floor`), metres, and both
    weigh alike; what the noise of the depth makes of it counts as theirs.
    """
    return _rows(T, seen, camera, cfg).system()


def with_noise(seen: Shades, T: Float[Array, "4 4"], camera: Intrinsics, cfg: Config) -> Shades:
    """With the noise that is measured at a pose near the right one: a blurred image, or one in another light, says the
    less the less it is like the others. Images that show few points say nothing."""
    rows = _compared(T, seen, camera, cfg)
    there = jnp.sum(rows.mask, -1) >= FEWEST
    off = jnp.where(rows.mask, jnp.abs(rows.error), jnp.nan)
    measured = DEVIATION * jnp.nanmedian(off, axis=-1)
    noise = jnp.where(there, jnp.maximum(seen.noise, measured), seen.noise)
    return seen._replace(noise=noise, images=seen.images._replace(mask=seen.images.mask & there))


class _Compared(NamedTuple):
    """P points in K images, gain and offset of each image taken off."""

    error: Float[Array, "K P"]
    jacobian: Float[Array, "K P 6"]
    """By a twist in the frame's camera."""
    variance: Float[Array, "K P"]
    robust: Float[Array, "K P"]
    """Cauchy weight of the error, 0 to 1."""
    mask: Bool[Array, "K P"]
    """Points that the image shows, and that are on an edge of it."""


def _rows(T: Float[Array, "4 4"], seen: Shades, camera: Intrinsics, cfg: Config) -> Rows:
    wanted, compared = cfg.track.brightness, _compared(T, seen, camera, cfg)
    metres = cfg.sensor.noise_floor * jax.lax.rsqrt(compared.variance)
    error = metres * compared.error
    scale = wanted.robust * cfg.sensor.noise_floor
    # Bounded, so that leaving the image is never a gain
    off = jnp.where(compared.mask, jnp.minimum(jnp.abs(error) / scale, LOST), LOST)
    cost = scale**2 * jnp.log1p(off**2) * (seen.measured & seen.images.mask[:, None])
    weight = compared.robust * compared.mask
    return Rows(error, metres[..., None] * compared.jacobian, wanted.weight * weight, wanted.weight * cost)


def _compared(T: Float[Array, "4 4"], seen: Shades, camera: Intrinsics, cfg: Config) -> _Compared:
    height, width = seen.texture.shape[1:3]
    small, limit = _halved(camera, round(camera.width / width)), jnp.array([[width - 1.0, height - 1.0]])

    def one(p_cam, measured, brightness, texture, image, noise):
        R_sub_ref = image.T_sub_cam[:3, :3]
        p_ref = transform_back(image.T_sub_cam, transform(T, p_cam))
        pixel = project(p_ref, small)
        there = _between(texture, pixel)
        inside = jnp.all((pixel >= 0) & (pixel <= limit), -1) & (p_ref[:, 2] > NEAR)
        steep = jnp.sum(there[:, 1:] ** 2, -1) > STEEP**2
        # Steep where the image shows it, too: on an even patch any pose is as good
        shown = inside & steep & _shown(image.depth, p_ref, camera) & measured & image.mask
        # By the point in the image's camera, then in its own
        z = jnp.maximum(p_ref[:, 2], NEAR)
        by_u, by_v = there[:, 1] * small.fx / z, there[:, 2] * small.fy / z
        # Derivatives of the pinhole projection: u moves by fx / z along x, and by -fx x / z^2 along z
        by_ref = jnp.stack([by_u, by_v, -(by_u * p_ref[:, 0] + by_v * p_ref[:, 1]) / z], -1)
        by_cam = turned(T[:3, :3].T, turned(R_sub_ref, by_ref))
        jacobian = jnp.concatenate([by_cam, jnp.cross(p_cam, by_cam)], -1)
        # A point whose depth is wrong is looked for beside its place, and is as much brighter there
        by_depth = cfg.sensor.noise_floor * jnp.sum(by_cam * p_cam, -1) / jnp.maximum(p_cam[:, 2], NEAR)
        variance = noise**2 + by_depth**2 / losses.precision(p_cam[:, 2], cfg.sensor)
        return _evened(there[:, 0], brightness, jacobian, variance, shown, cfg)

    return jax.vmap(one)(*seen)


def _evened(there, here, jacobian, variance, shown, cfg: Config) -> _Compared:
    """Gain and offset of one image fitted to all points and taken off, of errors and of how they change: what a change
    of light explains says nothing of the pose."""
    difference, robust = there - here, jnp.ones_like(here)

    def without_light(values):
        """Less what gain and offset explain of them; a weak prior keeps both where there is little to tell them by."""
        # By the noise, without which one bright spot would set the gain of the image
        weight = robust * shown / variance
        total = jnp.sum(weight) + 1
        centred, offset = here - weight @ here / total, weight @ values / total
        gain = (weight * centred) @ values / (jnp.sum(weight * centred**2) + 1)
        return values - jnp.outer(centred, gain) - offset[None]

    error = without_light(difference[:, None])[:, 0]
    for _ in range(2):
        robust = 1 / (1 + error**2 / (variance * cfg.track.brightness.robust**2))
        error = without_light(difference[:, None])[:, 0]
    return _Compared(error, without_light(jacobian), variance, robust, shown)


def _shown(depth: Float[Array, "h w"], p_ref: Float[Array, "P 3"], camera: Intrinsics) -> Bool[Array, " P"]:
    """Points that lie on the surface that an image shows in their place. Those outside of it mean nothing."""
    height, width = depth.shape
    small = camera.decimated(round(camera.width / width))
    u, v = jnp.round(project(p_ref, small)).T
    u, v = jnp.clip(u, 0, width - 1).astype(jnp.int32), jnp.clip(v, 0, height - 1).astype(jnp.int32)
    measured = depth[v, u]
    return (measured > 0) & (jnp.abs(measured - p_ref[:, 2]) < HIDDEN_M + HIDDEN * p_ref[:, 2])


def _texture(grey: Float[Array, "H W"], level: int) -> Float[Array, "h w 3"]:
    """Brightness, 0 to 1, slightly smoothed, and its central differences along u and v."""
    size = 2**level
    height, width = grey.shape[0] // size, grey.shape[1] // size
    # Means of whole tiles; rows and columns that make none are left out, as in the camera of `_halved`
    tiles = grey[: height * size, : width * size].reshape(height, size, width, size)
    image = jnp.mean(tiles, (1, 3)) / 255

    def neighbours(image, axis):
        padding = [(0, 0), (0, 0)]
        padding[axis] = (1, 1)
        padded = jnp.pad(image, padding, mode="edge")
        before = jax.lax.slice_in_dim(padded, 0, image.shape[axis], axis=axis)
        return before, jax.lax.slice_in_dim(padded, 2, image.shape[axis] + 2, axis=axis)

    for axis in (0, 1):
        before, after = neighbours(image, axis)
        image = (before + 2 * image + after) / 4
    across, down = neighbours(image, 1), neighbours(image, 0)
    return jnp.stack([image, (across[1] - across[0]) / 2, (down[1] - down[0]) / 2], -1)


def _halved(camera: Intrinsics, size: int) -> Intrinsics:
    """Of an image whose pixels are means of so many times so many."""
    width, height = camera.width // size, camera.height // size
    return camera.cropped(0, 0, width * size, height * size).resized(width, height)


def _between(texture: Float[Array, "h w C"], pixel: Float[Array, "P 2"]) -> Float[Array, "P C"]:
    """Values between four pixels each; those outside mean nothing."""
    height, width = texture.shape[:2]
    # The last pixel has no right neighbour: it is read as the end of the cell before
    corner = jnp.clip(jnp.floor(pixel), 0, jnp.array([[width - 2, height - 2]])).astype(jnp.int32)
    share = jnp.clip(pixel - corner, 0, 1)
    place, values = corner[:, 1] * width + corner[:, 0], texture.reshape(-1, texture.shape[-1])
    across, down = share[:, :1], share[:, 1:]
    above = values[place] * (1 - across) + values[place + 1] * across
    below = values[place + width] * (1 - across) + values[place + width + 1] * across
    return above * (1 - down) + below * down
