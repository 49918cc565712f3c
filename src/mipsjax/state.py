"""What is known after a frame, as values: keyframes, records of all frames, the submap."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8, UInt16

from mipsjax.core import mapping
from mipsjax.core.camera import Intrinsics
from mipsjax.policy import Status

Pose = Float64[np.ndarray, "4 4"]

THUMBNAIL_WIDTH = 48  # pixels, about; 4 kB a frame
THUMBNAIL_UNIT = 2e-4  # metres; 16 bits then reach 13 m


class Keyframe(NamedTuple):
    """A frame the map is learned from, at mapping size."""

    number: int
    """Its place in `SlamState.records`."""
    depth: Float32[np.ndarray, "h w"]
    color: UInt8[np.ndarray, "h w 3"]
    T_sub_cam: Pose


class Record(NamedTuple):
    """One processed frame. Its pose hangs on a keyframe, so that bundle adjustment moves it along."""

    frame: int
    """Number of the frame in the sequence on disk."""
    timestamp: float
    keyframe: int
    """Place of its keyframe in `SlamState.keyframes`."""
    T_keyframe_cam: Pose
    status: Status
    info: FrameInfo
    depth: UInt16[np.ndarray, "h w"] | None = None
    """A small picture of the depth, in units of `THUMBNAIL_UNIT`, to align the frame to the finished map with."""


class FrameInfo(NamedTuple):
    """For the reader of `status.csv`; nothing depends on it."""

    residual_before: float = float("nan")
    """Metres."""
    residual_after: float = float("nan")
    known: float = float("nan")
    """Share of measured pixels within 5 cm of the mapped surface, before mapping."""
    searched: bool = False
    """RO was run."""
    keyframe: bool = False
    map_steps: int = 0
    track_ms: float = 0.0
    map_ms: float = 0.0
    note: str = ""


class SlamState(NamedTuple):
    """All that is known after a frame."""

    submap: mapping.Submap
    keyframes: tuple[Keyframe, ...]
    """The first is the anchor."""
    records: tuple[Record, ...]
    T_world_sub: Pose
    camera: Intrinsics
    trouble: int
    """Weak or lost frames in a row, up to now."""


def pose_of(state: SlamState, record: Record) -> Pose:
    """Camera-to-submap pose of a frame."""
    return state.keyframes[record.keyframe].T_sub_cam @ record.T_keyframe_cam


def last_pose(state: SlamState) -> Pose:
    """Camera-to-submap pose of the last frame."""
    return pose_of(state, state.records[-1])


def trajectory(state: SlamState) -> Float64[np.ndarray, "N 4 4"]:
    """World pose of every processed frame, camera-to-world."""
    return np.stack([state.T_world_sub @ pose_of(state, record) for record in state.records])


def rigid(T: Float[np.ndarray, "4 4"]) -> Pose:
    """The nearest rigid motion in double precision: products of single-precision rotations drift."""
    out = np.eye(4)
    u, _, vt = np.linalg.svd(T[:3, :3].astype(np.float64))
    out[:3, :3], out[:3, 3] = u @ vt, T[:3, 3]
    return out


def distance(T_a: Pose, T_b: Pose) -> tuple[float, float]:
    """Metres and radians between two poses."""
    cosine = (np.trace(T_a[:3, :3].T @ T_b[:3, :3]) - 1) / 2
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), float(np.arccos(np.clip(cosine, -1, 1)))


def thumbnail_stride(camera: Intrinsics) -> int:
    """Depth images are decimated by this for the thumbnails."""
    return max(1, round(camera.width / THUMBNAIL_WIDTH))


def thumbnail(depth: Float32[np.ndarray, "h w"], camera: Intrinsics) -> UInt16[np.ndarray, "h w"]:
    """A small picture of a depth image; 0 stays no measurement."""
    every = thumbnail_stride(camera)
    units = np.round(depth[::every, ::every] / THUMBNAIL_UNIT)
    return np.where(units < 2**16, units, 0).astype(np.uint16)
