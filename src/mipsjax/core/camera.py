"""Pinhole camera: intrinsics, pixel grids, unprojection and projection.

Projection and unprojection take NumPy arrays and JAX arrays alike: of NumPy arrays they are computed on the host, in
the precision of these (double for whole pixels), of JAX arrays, traced ones too, in JAX.

Camera frame as in OpenCV: x right, y down, z forward. Pixel centres lie at integer coordinates, so the
principal point of an image of width W seen symmetrically is (W - 1) / 2. Depth is z-depth in metres.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float64, Int

AnyArray = TypeVar("AnyArray", np.ndarray, jax.Array)

BEHIND_M = 1e-6
"""A point nearer than this to the plane of the lens, or behind it, is projected as if it were there: far outside of
the image, and finite."""


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

    def matrix(self) -> Float64[np.ndarray, "3 3"]:
        """K: of a point of the camera's frame, K p is z times its homogeneous pixel (u, v, 1)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])


def pixel_grid(
    rows: int, columns: int, shift: Float[Array, "2"], height: int, width: int
) -> tuple[Int[Array, " P"], Int[Array, " P"]]:
    """Rows v and columns u of a stripe grid over the image, P = rows * columns.

    `shift` in [0, 1)^2 moves the whole grid within one cell, so that over many shifts every pixel is reached
    (the paper samples 16 x 24 pixels of 480 x 640 this way).
    """
    v = jnp.floor((jnp.arange(rows) + shift[0]) * (height / rows)).astype(jnp.int32)
    u = jnp.floor((jnp.arange(columns) + shift[1]) * (width / columns)).astype(jnp.int32)
    # In single precision a shift just below 1 may round up to the next cell
    v, u = jnp.clip(v, 0, height - 1), jnp.clip(u, 0, width - 1)
    return jnp.repeat(v, columns), jnp.tile(u, rows)


def grid_shape(pixels: int, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of a grid of at most `pixels` cells, as square as the image allows."""
    # Cells as wide as high: rows / columns = height / width
    rows = max(1, min(pixels, int((pixels * height / width) ** 0.5)))
    return rows, max(1, pixels // rows)


def rays(v: AnyArray, u: AnyArray, camera: Intrinsics) -> AnyArray:
    """Direction of each pixel with z = 1, camera frame: a point at depth d is d times the ray.

    Rows v and columns u are arrays `*P` of one shape, whole numbers or not; the directions are `*P 3`.
    """
    xp = _module_of(u)
    x = (u - camera.cx) / camera.fx
    y = (v - camera.cy) / camera.fy
    return xp.stack([x, y, xp.ones_like(x)], -1)


def unproject(v: AnyArray, u: AnyArray, depth: AnyArray, camera: Intrinsics) -> AnyArray:
    """What pixels at rows v and columns u show at their depths, all `*P`: points `*P 3`, camera frame."""
    return rays(v, u, camera) * depth[..., None]


def project(p_cam: AnyArray, camera: Intrinsics, nearest: float = BEHIND_M) -> AnyArray:
    """Pixel coordinates (u, v), `P 2`, of points `P 3`.

    Points nearer than `nearest` to the camera, metres, or behind it, give a large finite value.
    """
    xp = _module_of(p_cam)
    z = xp.maximum(p_cam[:, 2], nearest)
    u = camera.fx * p_cam[:, 0] / z + camera.cx
    v = camera.fy * p_cam[:, 1] / z + camera.cy
    return xp.stack([u, v], -1)


def _module_of(array: np.ndarray | jax.Array) -> Any:
    """`jax.numpy` for arrays of JAX, whether traced or not, and NumPy for its own."""
    return jnp if isinstance(array, jax.Array) else np
