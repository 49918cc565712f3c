"""A painted wall in front of a camera, seen from any pose: images in which corners can be followed."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics

CAMERA = Intrinsics(290.0, 290.0, 159.5, 119.5, 320, 240)
RANGE_M = 2.0
"""Of the painted wall in front of the camera."""
FINE_PX_PER_M = 400
"""Of its painting: finer than the image of it, 145 pixels a metre."""


def pose(degrees, metres) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees)).as_matrix()
    T[:3, 3] = metres
    return T


def painting(seed: int = 0) -> np.ndarray:
    """Random blobs of several sizes, 4 m wide."""
    rng = np.random.default_rng(seed)
    side = 4 * FINE_PX_PER_M
    sizes = (16, 48, 96)
    blobs = [rng.uniform(size=(n, n)).astype(np.float32) for n in sizes]
    layers = [cv2.resize(blob, (side, side), interpolation=cv2.INTER_CUBIC) for blob in blobs]
    return np.clip(sum(layers) * 80, 0, 255).astype(np.uint8)


def wall(T_wall_cam: np.ndarray, painted: np.ndarray, z: float = RANGE_M) -> tuple[np.ndarray, np.ndarray]:
    """Brightness and depth of the painted plane at `z`, metres, seen from a pose."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], -1)
    slope = ray @ T_wall_cam[:3, :3].T
    depth = (z - T_wall_cam[2, 3]) / slope[..., 2]
    at = T_wall_cam[:3, 3] + slope * depth[..., None]
    x, y = ((at[..., :2] + 2) * FINE_PX_PER_M).astype(np.float32).transpose(2, 0, 1)
    return cv2.remap(painted, x, y, cv2.INTER_AREA), depth.astype(np.float32)
