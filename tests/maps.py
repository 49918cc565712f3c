"""Submaps put together by hand: poses and shared frames, with networks that know nothing."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics
from mipsjax.core.mapping import Learned
from mipsjax.core.volume import Box
from mipsjax.submaps.ids import FrameId, RecordId, SubmapId
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import Keyframe, Record, SlamState, Status, Submap

CAMERA = Intrinsics(20.0, 20.0, 9.5, 7.5, 20, 16)
DEPTH = np.full((16, 20), 2.0, np.float32)
COLOR = np.zeros((16, 20, 3), np.uint8)


def pose(rotation_deg=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix()
    T[:3, 3] = translation
    return T


def keyframe(record_id: int, T_sub_cam: np.ndarray | None = None) -> Keyframe:
    return Keyframe(RecordId(record_id), DEPTH, COLOR, np.eye(4) if T_sub_cam is None else T_sub_cam)


def submap(*keyframes: Keyframe, T_world_sub: np.ndarray | None = None, learned=None) -> Submap:
    box = Box(np.full(3, -3.0), np.full(3, 3.0))
    learned = Learned((), ()) if learned is None else learned  # pyright: ignore[reportArgumentType]
    return Submap(learned, box, keyframes, np.eye(4) if T_world_sub is None else T_world_sub)


def state(*submaps: Submap, active: int = 0) -> SlamState:
    """After one frame, which hangs on the anchor of the active submap."""
    anchor = submaps[active].anchor
    record = Record(FrameId(0), 0.0, SubmapId(active), anchor.id, np.eye(4), Status.OK)
    return SlamState(submaps, SubmapId(active), Records.of([record]), CAMERA, 0)
