"""What is known after a frame, as values: submaps with their keyframes, and records of all frames."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8, UInt16

from mipsjax.core import mapping
from mipsjax.core.camera import Intrinsics
from mipsjax.core.volume import Box
from mipsjax.host.corners import Corners
from mipsjax.host.features import Features
from mipsjax.host.held import EXACT, NONE, Held, Matrix, deviations
from mipsjax.host.trust import Differing
from mipsjax.policy import Status
from mipsjax.schedule import Job

Pose = Float64[np.ndarray, "4 4"]
How = Literal["box", "features"]

THUMBNAIL_WIDTH = 48  # pixels, about; 3 kB a frame
THUMBNAIL_UNIT = 2e-4  # metres; 16 bits then reach 13 m


class Keyframe(NamedTuple):
    """A frame the map is learned from, at mapping size.

    A frame that several submaps see is a keyframe in each, with the same `number` and images and a pose of its own:
    these linked records are the measurements between submaps.
    """

    number: int
    """Its place in `SlamState.records`."""
    depth: Float32[np.ndarray, "h w"]
    color: UInt8[np.ndarray, "h w 3"]
    T_sub_cam: Pose
    features: Features | None = None
    """For loops and relocalisation; None where neither is wanted."""
    corners: Corners | None = None
    """To be followed into other keyframes after the last frame; None where that is not wanted."""
    covariance: Matrix = NONE
    """Of its pose, relative to the anchor (`host/held.py`)."""


class Submap(NamedTuple):
    """M_s of the paper: what it has learned, the box it governs, its keyframes and its pose."""

    learned: mapping.Learned
    box: Box
    """Submap frame, metres."""
    keyframes: tuple[Keyframe, ...]
    """The first is the anchor, whose pose is the identity."""
    T_world_sub: Pose
    parent: int | None = None
    """The submap whose keyframe its anchor is; None for the first, and where the camera had been lost."""

    @property
    def newest(self) -> int:
        """Place of the newest keyframe: not the last one while a new submap has only those it was begun with."""
        return max(range(len(self.keyframes)), key=lambda place: self.keyframes[place].number)


class Record(NamedTuple):
    """One processed frame. Its pose hangs on a keyframe of a submap, so that bundle adjustment and loop closure move
    it along."""

    frame: int
    """Number of the frame in the sequence on disk."""
    timestamp: float
    submap: int
    """Place of its submap in `SlamState.submaps`."""
    keyframe: int
    """Place of its keyframe in that submap."""
    T_keyframe_cam: Pose
    status: Status
    info: FrameInfo
    held: Held = EXACT
    """How far the pose in the submap may be off."""
    depth: UInt16[np.ndarray, "h w"] | None = None
    """A small picture of the depth, in units of `THUMBNAIL_UNIT`, to align the frame to the finished map with."""
    colour: Matrix = NONE
    """How firmly corners and brightness of the image held it then (`core/solvers.py: Information`)."""


class Refinement(NamedTuple):
    """Of some inactive submaps, begun after one frame and taken over after a later one."""

    places: tuple[int, ...]
    job: Job
    """Gives the submaps as they become from what they were when it began."""


class Motion(NamedTuple):
    """Between the last two trusted frames, as it is expected to go on: along what measurements leave loose, partly that
    of before."""

    T_older_newer: Pose
    """Camera to camera."""
    seconds: float


class FrameInfo(NamedTuple):
    """For the reader of `status.csv`; of it only `keyframe` decides anything."""

    residual_before: float = float("nan")
    """Metres."""
    residual_after: float = float("nan")
    known: float = float("nan")
    """Share of measured pixels within 5 cm of the mapped surface, before mapping."""
    confirmed: float = float("nan")
    """The same where the map is certain."""
    surfaces: str = ""
    """Standard deviations of the pose in the six directions that surfaces hold most to least firmly, metres or rad."""
    together: str = ""
    """The same by surfaces, corners of the image and brightness."""
    free: str = ""
    """The motion that these leave most open, (v, omega) in the camera's frame."""
    searched: bool = False
    """RO was run."""
    keyframe: bool = False
    map_steps: int = 0
    submap: int = 0
    """The active one."""
    found: Literal["", "again", "nowhere"] = ""
    """A lost camera was found in the map again, or began a submap that hangs on nothing yet."""
    track_ms: float = 0.0
    map_ms: float = 0.0
    order_ms: float = 0.0
    """Of keeping the submaps in order: boxes, links, loops, a new submap."""
    note: str = ""


class Loop(NamedTuple):
    """One loop that was found between two submaps, kept or rejected."""

    frame: int
    """Place of the frame that closed it in `SlamState.records`."""
    first: int
    """The submap the camera was in."""
    second: int
    """The submap that was seen again."""
    how: How
    """The frame lay in the other submap's box, or its image looked like one of the other's keyframes."""
    inliers: float
    """Share of the frame's pixels that fit the other submap, of those it knows."""
    correction_m: float
    """How far the pose graph moved the camera."""
    correction_rad: float
    weight: float
    """1: kept; 0: rejected by the pose graph as false."""


class SlamState(NamedTuple):
    """All that is known after a frame."""

    submaps: tuple[Submap, ...]
    active: int
    """The submap that the camera is tracked in."""
    records: tuple[Record, ...]
    camera: Intrinsics
    trouble: int
    """Frames in a row, up to now, that were lost or hardly held or known."""
    loops: tuple[Loop, ...] = ()
    motion: Motion | None = None
    """None before there are two trusted frames, and where a lost camera was found elsewhere."""
    refinement: Refinement | None = None
    """Under way."""
    corners: tuple[Corners, ...] = ()
    """Of the last frame that was tracked with colour and taught the map, then of keyframes before it: the newest, and
    the oldest that are still seen."""
    doubts: tuple[Differing, ...] = ()
    """How colour and surfaces of frames of late differ, by which colour is trusted."""
    residual: float = 0.0
    """Metres; the least that trusted frames end at of late, which is the sensor's noise; 0 at the start."""

    @property
    def submap(self) -> Submap:
        """The active one."""
        return self.submaps[self.active]

    def with_submap(self, place: int, **fields: Any) -> SlamState:
        """With fields of one submap replaced."""
        submaps = list(self.submaps)
        submaps[place] = submaps[place]._replace(**fields)
        return self._replace(submaps=tuple(submaps))


def pose_of(state: SlamState, record: Record) -> Pose:
    """Camera-to-submap pose of a frame, in its own submap."""
    return state.submaps[record.submap].keyframes[record.keyframe].T_sub_cam @ record.T_keyframe_cam


def last_pose(state: SlamState) -> Pose:
    """Camera-to-submap pose of the last frame, which is always in the active submap."""
    return pose_of(state, state.records[-1])


def deviations_of(state: SlamState, record: Record) -> tuple[float, float]:
    """Standard deviations of where a frame's camera is in its submap, metres, and of how it is turned, radians."""
    return deviations(record.held.covariance, pose_of(state, record))


def world_pose(state: SlamState, record: Record) -> Pose:
    """Camera-to-world pose of a frame."""
    return state.submaps[record.submap].T_world_sub @ pose_of(state, record)


def trajectory(state: SlamState) -> Float64[np.ndarray, "N 4 4"]:
    """World pose of every processed frame, camera-to-world."""
    return np.stack([world_pose(state, record) for record in state.records])


def keyframes(state: SlamState) -> int:
    """Different frames that are keyframes, of one submap or more."""
    return len({keyframe.number for submap in state.submaps for keyframe in submap.keyframes})


def keyframe_bytes(keyframe: Keyframe) -> int:
    """Size of its images, features and corners; a keyframe of several submaps is kept once."""
    parts = [*(keyframe.features or ()), *(keyframe.corners or ())]
    others = sum(part.nbytes for part in parts if isinstance(part, np.ndarray))
    return keyframe.depth.nbytes + keyframe.color.nbytes + others


def map_bytes(state: SlamState) -> int:
    """Size of the networks of all submaps."""
    return sum(leaf.nbytes for submap in state.submaps for leaf in jax.tree.leaves(submap.learned.field))


def inverse(T: Pose) -> Pose:
    """Of a rigid motion."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    return out


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


def to_metres(record: Record) -> Float32[np.ndarray, "h w"]:
    """The thumbnail of a frame that has one, as depth; 0 for no measurement."""
    assert record.depth is not None
    return record.depth.astype(np.float32) * np.float32(THUMBNAIL_UNIT)
