"""What becomes of a frame: its keyframe, its record, and the state after a frame whose pose is not trusted."""

from __future__ import annotations

from time import perf_counter

import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import distance, inverse
from mipsjax.data.sequence import Frame
from mipsjax.images.corners import Corners
from mipsjax.images.features import detect
from mipsjax.slam.info import FrameInfo, info_of
from mipsjax.slam.landmarks import corners_of, with_corners
from mipsjax.slam.policy import FrameStats
from mipsjax.slam.recovery import Relocation, lost_in_a_row
from mipsjax.slam.tracker import Tracked, coasting
from mipsjax.submaps.astray import deviations_from_first
from mipsjax.submaps.bundle import make_keyframe
from mipsjax.submaps.ids import FrameId, RecordId
from mipsjax.submaps.state import (
    Keyframe,
    Motion,
    Pose,
    Record,
    SlamState,
    Status,
    last_pose,
    last_trusted,
    pose_of,
    thumbnail,
)
from mipsjax.uncertainty.held import at
from mipsjax.uncertainty.trust import RECENT

NOT_FOUND_YET = "not yet found in the map"
RESIDUAL_RISE = 0.02  # share of a frame's excess by which the least residual of late goes up


def keyframe_for(
    frame: Frame,
    record_id: RecordId,
    T_sub_cam: Pose,
    corners: Corners | None,
    cfg: Config,
    camera: Intrinsics,
) -> Keyframe:
    """The keyframe that a frame becomes, with features where loops want them, and with its `corners` where keyframes
    are measured against each other."""
    keyframe = make_keyframe(frame, record_id, T_sub_cam, cfg, camera)
    if cfg.pairs.wanted:
        keyframe = keyframe._replace(corners=corners)
    if not ((cfg.loop.enabled and cfg.loop.features) or cfg.loop.relocalise):
        return keyframe
    assert frame.depth is not None and frame.color is not None
    return keyframe._replace(features=detect(frame.color, frame.depth, camera))


def record_for(
    frame: Frame,
    state: SlamState,
    T_sub_cam: Pose,
    status: Status,
    keyframe: Keyframe | None = None,
) -> Record:
    """The record of a frame, hung on a keyframe of the active submap, the newest if none is given."""
    submap = state.submap
    keyframe = submap.newest if keyframe is None else keyframe
    T_keyframe_cam = np.linalg.inv(keyframe.T_sub_cam) @ T_sub_cam
    return Record(FrameId(frame.number), frame.timestamp, state.active, keyframe.id, T_keyframe_cam, status)


def trusted_record(
    frame: Frame, state: SlamState, tracked: Tracked, T_sub_cam: Pose, status: Status
) -> Record:
    """The record of a frame that was tracked, with what is done with it after the last frame."""
    assert frame.depth is not None
    information = tracked.info.information
    return record_for(frame, state, T_sub_cam, status)._replace(
        held=tracked.held,
        depth=thumbnail(frame.depth, state.camera),
        colour=information.corners + information.brightness,
    )


def keyframe_of_lost(state: SlamState, frame: Frame, tracked: Tracked | None, cfg: Config) -> Keyframe:
    """A lost frame with its features, to be looked for in the map; `tracked` is what tracking said of it, if it was
    tried."""
    record_id = state.next_record
    corners = corners_of(frame, record_id, state.camera, cfg) if tracked is None else tracked.corners
    keyframe = keyframe_for(frame, record_id, np.eye(4), corners, cfg, state.camera)
    if keyframe.features is None:
        assert frame.color is not None and frame.depth is not None
        keyframe = keyframe._replace(features=detect(frame.color, frame.depth, state.camera))
    return keyframe


def relocated(
    state: SlamState,
    frame: Frame,
    found: Relocation,
    tracked: Tracked | None,
) -> tuple[SlamState, FrameInfo]:
    """The state after a lost frame that was found in what is the active submap now, or has begun it."""
    assert frame.depth is not None
    record = record_for(frame, state, found.T_sub_cam, Status.WEAK, found.keyframe)
    record = record._replace(
        held=at(found.covariance, found.T_sub_cam),
        depth=thumbnail(frame.depth, state.camera),
        is_keyframe=found.begun,
    )
    info = FrameInfo() if tracked is None else info_of(tracked)
    # Nobody saw how the camera moved to here: no motion to go on with, and a wider search
    state = state.with_record(record)._replace(frames_in_trouble=1, motion=None)
    how = "nowhere" if found.begun else "again"
    return state, info._replace(found=how, submap=state.active, keyframe=found.begun)


def coasted(
    state: SlamState,
    frame: Frame,
    note: str,
    status: Status,
    cfg: Config,
    tracked: Tracked | None = None,
) -> tuple[SlamState, FrameInfo]:
    """The state after a frame without a trusted pose, which stays where the camera was seen last."""
    info = FrameInfo() if tracked is None else info_of(tracked)
    record = record_for(frame, state, last_pose(state), status)._replace(held=coasting(state, frame, cfg))
    after = state.with_record(record)._replace(frames_in_trouble=state.frames_in_trouble + 1)
    return after, info._replace(note=note, submap=state.active)


def moved_on(
    state: SlamState, before: SlamState, tracked: Tracked, residual: float, cfg: Config
) -> SlamState:
    """The state with what a trusted frame says of those to come: motion, residual, corners, and how far colour is to be
    trusted. `before` is the state before the frame."""
    newest, older = state.records[-1], last_trusted(before)
    # In the submap, whose pose in the world may jump where a known one takes over
    T_older_newer = inverse(pose_of(state, before.records[-1])) @ pose_of(state, newest)
    # Along what is left loose the motion is believed by a gain of its own (`_believed`)
    T_older_newer = T_older_newer @ inverse(tracked.T_sub_cam) @ tracked.T_as_moved
    motion = Motion(T_older_newer, newest.timestamp - older.timestamp)
    # Falls at once and rises slowly: one frame that fits badly says little of the sensor's noise
    over = max(residual - before.residual, 0.0)
    floor = min(residual, before.residual + RESIDUAL_RISE * over) if before.residual else residual
    state = state._replace(motion=motion, residual=floor)
    if tracked.doubt is not None:
        state = state._replace(doubts=(*state.doubts, tracked.doubt)[-RECENT:])
    return with_corners(state, tracked.corners, tracked.found, cfg)


def stats_of(state: SlamState, tracked: Tracked, cfg: Config) -> FrameStats:
    """The numbers of a tracked frame by which it is decided what becomes of it."""
    assert tracked.frame.depth is not None
    T_sub_cam, info = tracked.T_sub_cam, tracked.info
    keyframe, last = state.submap.newest, last_pose(state)
    translation, rotation = distance(keyframe.T_sub_cam, T_sub_cam)
    step_translation, step_rotation = distance(last, T_sub_cam)
    return FrameStats(
        finite=bool(info.ok),
        measured=float(np.mean(tracked.frame.depth > 0)),
        known=float(info.after.known),
        confirmed=float(info.after.confirmed),
        open=float(tracked.together.deviation[-1]),
        astray=deviations_from_first(state, state.active, tracked.held.covariance, T_sub_cam)[0],
        residual=float(info.after.residual),
        least_residual=state.residual,
        unsure=state.records[-1].status in (Status.LOST, Status.SKIPPED),
        lost=lost_in_a_row(state, cfg.guard.lost_frames),
        since_keyframe=state.next_record - keyframe.id,
        translation=translation,
        rotation=rotation,
        step_translation=step_translation,
        step_rotation=step_rotation,
    )


def few(measured: float) -> str:
    """In words, what share of a frame has depth."""
    return f"depth in {100 * measured:.1f} % of the pixels only"


def joined_notes(*notes: str) -> str:
    """The notes that say something, as one."""
    return "; ".join(note for note in notes if note)


def ms_since(began: float) -> float:
    """Milliseconds."""
    return 1e3 * (perf_counter() - began)
