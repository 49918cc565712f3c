"""What one step of mapping learns from: pixels of some frames, drawn anew each time, and samples on their rays."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core import sampling
from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, rays
from mipsjax.core.views import planes_at

CHUNK_SAMPLES = 12_000  # of which the activations stay in a core's cache
STEEPEST = 0.25  # least |n . ray|: normals at grazing angles are too uncertain for more


class Frames(NamedTuple):
    """F posed frames of one size."""

    depth: Float[Array, "F H W"]
    """Metres, 0 for no measurement."""
    color: UInt8[Array, "F H W 3"]
    T_sub_cam: Float[Array, "F 4 4"]
    movable: Float[Array, " F"]
    """Share of the pose learning rate at which the pose is optimised; 0 for the anchor's."""


class Pixels(NamedTuple):
    """P pixels of one frame."""

    ray: Float[Array, "P 3"]
    depth: Float[Array, " P"]
    slope: Float[Array, " P"]
    color: Float[Array, "P 3"]


class Batch(NamedTuple):
    """R rays of several frames, with S samples each."""

    frame: Int[Array, " R"]
    pixels: Pixels
    samples: sampling.Samples


def draw(field: nf.Field, frames: Frames, key: PRNGKeyArray, camera: Intrinsics, cfg: Config) -> Batch:
    """Pixels of every frame and samples on their rays, with a leading axis of chunks."""
    count = frames.depth.shape[0]
    k_pixels, k_rays, k_surface = jax.random.split(key, 3)
    pixels = jax.vmap(draw_pixels, (0, 0, 0, None, None))(
        jax.random.split(k_pixels, count), frames.depth, frames.color, camera, cfg
    )
    # Rays of all frames in one list, each with its frame's number, so that chunks may cut anywhere
    frame = jnp.repeat(jnp.arange(count), pixels.depth.shape[1])
    pixels = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), pixels)
    depth = sampling.first_phase(k_rays, pixels.depth, cfg.field.truncation, cfg.sample)
    chunks = _chunks(len(frame), depth.shape[1] + cfg.sample.surface)

    def finish(chunk):
        frame, pixels, depth, jitter = chunk

        def distance(depth):
            points = points_of(frames.T_sub_cam, frame, pixels, depth)
            return nf.tsdf(field, points, cfg.field).psi.reshape(depth.shape)

        depth = sampling.second_phase(jitter, depth, distance, cfg.sample)
        return Batch(frame, pixels, sampling.label(depth, pixels.depth, pixels.slope, cfg.field.truncation))

    jitter = jax.random.uniform(k_surface, (len(frame), cfg.sample.surface))
    rays = (frame, pixels, depth, jitter)
    return jax.lax.map(
        finish, jax.tree.map(lambda a: a.reshape(chunks, len(frame) // chunks, *a.shape[1:]), rays)
    )


def _chunks(rays: int, samples: int) -> int:
    """The least number of equal chunks of which none is too large."""
    return next(n for n in range(1, rays + 1) if rays % n == 0 and rays // n * samples <= CHUNK_SAMPLES)


def points_of(
    poses: Float[Array, "F 4 4"], frame: Int[Array, " R"], pixels: Pixels, depth: Float[Array, "R S"]
) -> Float[Array, "RS 3"]:
    """The samples in the submap's frame."""
    ray = jnp.einsum("rij,rj->ri", poses[frame, :3, :3], pixels.ray)
    return (poses[frame, None, :3, 3] + depth[..., None] * ray[:, None]).reshape(-1, 3)


def draw_pixels(
    key: PRNGKeyArray,
    depth: Float[Array, "H W"],
    color: UInt8[Array, "H W 3"],
    camera: Intrinsics,
    cfg: Config,
) -> Pixels:
    """A stripe grid of pixels, shifted by a random part of a cell."""
    height, width = depth.shape
    v, u = pixel_grid(
        *grid_shape(cfg.map.pixels, height, width), jax.random.uniform(key, (2,)), height, width
    )
    ray = rays(v, u, camera)
    slope = surface_slope(depth, v, u, camera, cfg) if cfg.sample.perpendicular else jnp.ones(u.shape)
    return Pixels(ray, depth[v, u], slope, color[v, u].astype(jnp.float32) / 255)


def surface_slope(
    depth: Float[Array, "H W"],
    v: Int[Array, " P"],
    u: Int[Array, " P"],
    camera: Intrinsics,
    cfg: Config,
) -> Float[Array, " P"]:
    """|n . ray| of the surface at each pixel; 1 where the depth image has no normal."""
    planes = planes_at(depth, v, u, camera, cfg.sensor.noise_growth)
    slope = jnp.abs(jnp.sum(planes.normal * rays(v, u, camera), -1))
    return jnp.where(planes.smooth, jnp.clip(slope, STEEPEST, 1.0), 1.0)
