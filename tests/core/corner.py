"""An analytic scene: the corner of a room, and what a camera sees of it in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mipsjax.config.sections import Config, FieldConfig, KeyframeConfig, LossConfig, MapConfig, SampleConfig
from mipsjax.config.tracking import RefineConfig, SearchConfig, TrackConfig
from mipsjax.core.camera import Intrinsics

CAMERA = Intrinsics(105.0, 105.0, 63.5, 47.5, 128, 96)
WALLS = np.array([-1.2, 0.9, 2.0])  # metres: the planes x (left), y (floor) and z (back)

CFG = Config(
    field=FieldConfig(
        encoding="both",
        octaves=6,
        hidden=(32, 32),
        hash_levels=4,
        hash_log2_entries=12,
        hash_coarsest=0.4,
        hash_finest=0.05,
        hash_hidden=(16,),
        color_hidden=(16,),
    ),
    sample=SampleConfig(uniform=6, truncation=8, surface=0, perpendicular=False),
    loss=LossConfig(color_samples=8),  # all of the truncation region, on both sides of the surface
    map=MapConfig(frames=5, pixels=200, learning_rate=4e-3, pose_learning_rate=1e-3),
    track=TrackConfig(
        ro=SearchConfig(when="needed", particles=512, pixels=150, steps=10, rotation=0.12, translation=0.25),
        go=RefineConfig(method="lm", pixels=768, steps=15, smooth_steps=7, learning_rate=1e-2, rgb=1.0),
    ),
    keyframe=KeyframeConfig(),
    seed=0,
)
ADAM = replace(CFG, track=replace(CFG.track, go=replace(CFG.track.go, method="adam", steps=40)))


def pose(rotation_deg=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)) -> np.ndarray:
    """A rigid motion from a rotation vector in degrees and metres."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
    T[:3, 3] = translation
    return T


HOME = pose((-8.0, -10.0, 0.0))
"""Looks at the corner, so that all three planes are in sight."""
VIEWS = np.stack(
    [
        HOME,
        HOME @ pose((3, 0, 1), (0.08, 0, 0)),
        HOME @ pose((0, 4, 0), (-0.08, 0.03, 0.05)),
        HOME @ pose((-3, -3, 0), (0, -0.08, 0)),
        HOME @ pose((0, 2, -3), (0.04, 0.05, -0.1)),
    ]
)


def rays(v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Direction of each pixel with z = 1, from the documented conventions alone."""
    return np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)


def unprojected(depth: np.ndarray, T_a_cam: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """What pixels of a depth image show, in frame a."""
    return rays(v, u) * depth[v, u][..., None] @ T_a_cam[:3, :3].T + T_a_cam[:3, 3]


def see(T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H W, float32, metres) and colour (H W 3, uint8) from a pose."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    direction, origin = rays(v, u) @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    # A camera ray has z = 1, so that the ray's parameter is its z-depth
    to_walls = (WALLS - origin) / direction
    depth = np.where(to_walls > 0, to_walls, np.inf).min(-1)
    hit = origin + depth[..., None] * direction
    color = 127 + 100 * np.sin(4 * hit + np.array([0.0, 1.0, 2.0]))
    return depth.astype(np.float32), color.astype(np.uint8)


def apart(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    turn = Rotation.from_matrix(np.asarray(T_a, np.float64)[:3, :3].T @ np.asarray(T_b, np.float64)[:3, :3])
    return float(np.linalg.norm(np.asarray(T_a)[:3, 3] - np.asarray(T_b)[:3, 3])), float(
        np.rad2deg(turn.magnitude())
    )
