"""Pinhole camera: intrinsics, pixel grids, unprojection and projection.

Camera frame as in OpenCV: x right, y down, z forward. Pixel centres lie at integer coordinates, so the
principal point of an image of width W seen symmetrically is (W - 1) / 2. Depth is z-depth in metres.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
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
