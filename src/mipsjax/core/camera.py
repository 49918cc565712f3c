"""Pinhole camera: intrinsics, pixel grids, unprojection and projection.

Camera frame as in OpenCV: x right, y down, z forward. Pixel centres lie at integer coordinates, so the
principal point of an image of width W seen symmetrically is (W - 1) / 2. Depth is z-depth in metres.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Intrinsics(NamedTuple):
    """Pinhole intrinsics of one image size. Pixels; exact floats, never rounded."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def resized(self, width: int, height: int) -> Intrinsics:
        """Intrinsics of the same view resampled to another size.

        A pixel covers [u - 1/2, u + 1/2], hence u' = (u + 1/2) s - 1/2 with s the ratio of the sizes.
        """
        sx, sy = width / self.width, height / self.height
        cx, cy = (self.cx + 0.5) * sx - 0.5, (self.cy + 0.5) * sy - 0.5
        return Intrinsics(self.fx * sx, self.fy * sy, cx, cy, width, height)

    def cropped(self, left: int, top: int, width: int, height: int) -> Intrinsics:
        """Intrinsics of the window of `width` x `height` pixels whose first pixel is (left, top)."""
        return Intrinsics(self.fx, self.fy, self.cx - left, self.cy - top, width, height)

    def decimated(self, every_px: int) -> Intrinsics:
        """Intrinsics of `image[::every_px, ::every_px]`: u' = u / every_px exactly."""
        width, height = -(-self.width // every_px), -(-self.height // every_px)
        return Intrinsics(
            self.fx / every_px, self.fy / every_px, self.cx / every_px, self.cy / every_px, width, height
        )


def pixel_grid(
    rows: int, columns: int, shift: Float[Array, "2"], height: int, width: int
) -> tuple[Int[Array, " P"], Int[Array, " P"]]:
    """Rows v and columns u of a stripe grid over the image, P = rows * columns.

    `shift` in [0, 1)^2 moves the whole grid within one cell, so that over many shifts every pixel is reached
    (the paper samples 16 x 24 pixels of 480 x 640 this way).
    """
    v = jnp.floor((jnp.arange(rows) + shift[0]) * (height / rows)).astype(jnp.int32)
    u = jnp.floor((jnp.arange(columns) + shift[1]) * (width / columns)).astype(jnp.int32)
    v, u = jnp.clip(v, 0, height - 1), jnp.clip(u, 0, width - 1)
    return jnp.repeat(v, columns), jnp.tile(u, rows)


def grid_shape(pixels: int, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of a grid of at most `pixels` cells, as square as the image allows."""
    rows = max(1, min(pixels, int((pixels * height / width) ** 0.5)))
    return rows, max(1, pixels // rows)


def rays(v: Int[Array, " P"], u: Int[Array, " P"], camera: Intrinsics) -> Float[Array, "P 3"]:
    """Direction of each pixel with z = 1, camera frame: a point at depth d is d times the ray."""
    return jnp.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, jnp.ones(u.shape)], -1)


def transform(T_a_b: Float[Array, "4 4"], p_b: Float[Array, "P 3"]) -> Float[Array, "P 3"]:
    """Points from frame b to frame a."""
    return p_b @ T_a_b[:3, :3].T + T_a_b[None, :3, 3]


def project(p_cam: Float[Array, "P 3"], camera: Intrinsics) -> Float[Array, "P 2"]:
    """Pixel coordinates (u, v); points at or behind the camera give a large finite value."""
    z = jnp.maximum(p_cam[:, 2], 1e-6)
    return jnp.stack([camera.fx * p_cam[:, 0] / z + camera.cx, camera.fy * p_cam[:, 1] / z + camera.cy], -1)
