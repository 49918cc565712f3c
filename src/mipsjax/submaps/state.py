"""What is known after a frame, as values: submaps with their keyframes, and records of all frames."""

from __future__ import annotations

from enum import IntEnum
from itertools import takewhile
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float32, Float64, UInt8, UInt16

from mipsjax.core import mapping
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import Pose
from mipsjax.core.volume import Box
from mipsjax.images.corners import Corners
from mipsjax.images.features import Features
from mipsjax.submaps.ids import FrameId, RecordId, SubmapId
from mipsjax.submaps.records import Records
from mipsjax.uncertainty.held import EXACT, NONE, Held, Matrix, deviations
from mipsjax.uncertainty.trust import Differing

THUMBNAIL_WIDTH = 48  # pixels, about; 3 kB a frame
THUMBNAIL_UNIT = 2e-4  # metres; 16 bits then reach 13 m


class Word(IntEnum):
    """A number, as all of the state, that is shown as a word."""

    def __str__(self) -> str:
        return self.name.lower()

    def __format__(self, form: str) -> str:
        return format(str(self), form)


class Status(Word):
    """How far a frame's pose can be trusted."""

    OK = 0
    WEAK = 1
    """Little of it is known, or little holds it, or the camera may have gone astray before. It is mapped, unless it has
    hardly any depth or was only found again."""
    LOST = 2
    """Not mapped; its pose is the last trusted one."""
    SKIPPED = 3
    """No usable image; its pose is the last trusted one."""

    @property
    def trusted(self) -> bool:
        """Whether the pose of such a frame was measured."""
        return self in (Status.OK, Status.WEAK)


class How(Word):
    """By what a loop was found."""

    BOX = 0
    """The frame lay in the other submap's box."""
    FEATURES = 1
    """Its image looked like one of the other's keyframes."""


class Keyframe(NamedTuple):
    """A frame the map is learned from, at mapping size.

    A frame that several submaps see is a keyframe in each, with the same `id` and images and a pose of its own:
    these linked keyframes are the measurements between submaps.
    """

    id: RecordId
    """That of the frame's record."""
    depth: Float32[np.ndarray, "h w"]
    color: UInt8[np.ndarray, "h w 3"]
    T_sub_cam: Pose
    features: Features | None = None
    """For loops and relocalisation; None where neither is wanted."""
    corners: Corners | None = None
    """To be followed into other keyframes after the last frame; None where that is not wanted."""
    covariance: Matrix = NONE
    """Of its pose, relative to the anchor (`uncertainty/held.py`)."""


class Submap(NamedTuple):
    """M_s of the paper: what it has learned, the box it governs, its keyframes and its pose."""

    learned: mapping.Learned
    box: Box
    """Submap frame, metres."""
    keyframes: tuple[Keyframe, ...]
    """The first is the anchor, whose pose is the identity."""
    T_world_sub: Pose
    parent: SubmapId | None = None
    """The submap whose keyframe its anchor is; None for the first, and where the camera had been lost."""
    covariance: Matrix = NONE
    """Of its pose relative to the first submap, for a twist in the frame of that one, as it was when it was last found
    out how they lie (`submaps/astray.py`)."""

    @property
    def anchor(self) -> Keyframe:
        """The keyframe whose camera frame is the frame of the submap."""
        return self.keyframes[0]

    @property
    def newest(self) -> Keyframe:
        """The newest keyframe: not the last one while a new submap has only those it was begun with."""
        return max(self.keyframes, key=lambda keyframe: keyframe.id)

    def keyframe_of(self, record_id: RecordId) -> Keyframe:
        """The keyframe that was made of a frame.

        Raises:
            KeyError: the frame is no keyframe of this submap.
        """
        # From the end, where the keyframe is that the frames of late hang on
        for keyframe in reversed(self.keyframes):
            if keyframe.id == record_id:
                return keyframe
        raise KeyError(f"frame {record_id} is no keyframe of the submap")


class Record(NamedTuple):
    """One processed frame. Its pose hangs on a keyframe of a submap, so that bundle adjustment and loop closure move
    it along."""

    frame: FrameId
    timestamp: float
    submap: SubmapId
    keyframe: RecordId
    """The keyframe of that submap which the pose hangs on."""
    T_keyframe_cam: Pose
    status: Status
    held: Held = EXACT
    """How far the pose in the submap may be off."""
    depth: UInt16[np.ndarray, "h w"] | None = None
    """A small picture of the depth, in units of `THUMBNAIL_UNIT`, to align the frame to the finished map with."""
    colour: Matrix = NONE
    """How firmly corners and brightness of the image held it then (`core/information.py: Information`)."""
    is_keyframe: bool = False
    """It was made a keyframe of its submap."""


class Refinement(NamedTuple):
    """Of some inactive submaps, begun after one frame and taken over after a later one: all that its result follows
    from."""

    places: tuple[SubmapId, ...]
    submaps: tuple[Submap, ...]
    """These, as they were when it began."""
    number: int
    """Frames that had been processed then."""


class Motion(NamedTuple):
    """Between the last two trusted frames, as it is expected to go on: along what measurements leave loose, partly that
    of before."""

    T_older_newer: Pose
    """Camera to camera."""
    seconds: float


class Loop(NamedTuple):
    """One loop that was found between two submaps, kept or rejected."""

    record: RecordId
    """The frame that closed it."""
    first: SubmapId
    """The submap the camera was in."""
    second: SubmapId
    """The submap that was seen again."""
    how: How
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
    active: SubmapId
    """The submap that the camera is tracked in."""
    records: Records[Record]
    camera: Intrinsics
    frames_in_trouble: int
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
    good: mapping.Learned | None = None
    """What the active submap had learned when its last steps came out finite; None where there were none since it took
    over (`submaps/mending.py`)."""
    trusted: RecordId = RecordId(0)
    """The newest frame whose pose was measured."""
    first: RecordId = RecordId(0)
    """The first frame of this recording; those before it are of recordings from which the map was learned earlier."""
    older_loops: int = 0
    """How many of the loops are of those."""

    @property
    def submap(self) -> Submap:
        """The active one."""
        return self.submaps[self.active]

    @property
    def submap_ids(self) -> list[SubmapId]:
        """The ids of all submaps, in order."""
        return [SubmapId(index) for index in range(len(self.submaps))]

    @property
    def next_record(self) -> RecordId:
        """The id that the next processed frame gets."""
        return RecordId(len(self.records))

    @property
    def located(self) -> bool:
        """Whether it is known where the camera is: not so before it was found in a map of earlier recordings."""
        return self.trusted >= self.first

    def with_record(self, record: Record) -> SlamState:
        """The state after one more frame."""
        trusted = self.next_record if record.status.trusted else self.trusted
        return self._replace(records=self.records.appended(record), trusted=trusted)

    def with_submap(self, submap_id: SubmapId, **fields: Any) -> SlamState:
        """The state with fields of one submap replaced."""
        submaps = list(self.submaps)
        submaps[submap_id] = submaps[submap_id]._replace(**fields)
        return self._replace(submaps=tuple(submaps))


def pose_of(state: SlamState, record: Record) -> Pose:
    """Camera-to-submap pose of a frame, in its own submap."""
    keyframe = state.submaps[record.submap].keyframe_of(record.keyframe)
    return keyframe.T_sub_cam @ record.T_keyframe_cam


def last_trusted(state: SlamState) -> Record:
    """The newest frame whose pose was measured."""
    return state.records[state.trusted]


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
    """World pose of every processed frame of this recording, camera-to-world; NaN before it was found in a map of
    earlier ones."""
    records = state.records[state.first :]
    unknown = list(takewhile(lambda record: not record.status.trusted, records)) if state.first else []
    poses = [np.full((4, 4), np.nan)] * len(unknown)
    poses += [world_pose(state, record) for record in records[len(unknown) :]]
    return np.array(poses).reshape(-1, 4, 4)


def keyframes(state: SlamState) -> int:
    """Different frames that are keyframes, of one submap or more."""
    return len({keyframe.id for submap in state.submaps for keyframe in submap.keyframes})


def keyframe_bytes(keyframe: Keyframe) -> int:
    """Size of its images, features and corners; a keyframe of several submaps is kept once."""
    parts = [*(keyframe.features or ()), *(keyframe.corners or ())]
    others = sum(part.nbytes for part in parts if isinstance(part, np.ndarray))
    return keyframe.depth.nbytes + keyframe.color.nbytes + others


def map_bytes(state: SlamState) -> int:
    """Size of the networks of all submaps."""
    return sum(leaf.nbytes for submap in state.submaps for leaf in jax.tree.leaves(submap.learned.field))


def thumbnail_stride(camera: Intrinsics) -> int:
    """Depth images are decimated by this for the thumbnails."""
    return max(1, round(camera.width / THUMBNAIL_WIDTH))


def thumbnail(depth: Float32[np.ndarray, "h w"], camera: Intrinsics) -> UInt16[np.ndarray, "h w"]:
    """A small picture of a depth image; 0 stays no measurement."""
    every = thumbnail_stride(camera)
    units = np.round(depth[::every, ::every] / THUMBNAIL_UNIT)
    # Beyond 13 m it is no measurement, where it would wrap round to a near one
    return np.where(units < 2**16, units, 0).astype(np.uint16)


def to_metres(record: Record) -> Float32[np.ndarray, "h w"]:
    """The thumbnail of a frame that has one, as depth; 0 for no measurement."""
    assert record.depth is not None
    return record.depth.astype(np.float32) * np.float32(THUMBNAIL_UNIT)
