"""The host loop: frames in, poses and a map out. It reads like Algorithm 1 of the paper.

`start`, `step` and `finish` (of `slam/finish.py`) are the whole interface. State goes in and comes out; nothing is kept
elsewhere.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import distance, inverse
from mipsjax.data.checked import checked_frame, checked_start
from mipsjax.data.sequence import Frame
from mipsjax.images.corners import Corners
from mipsjax.images.features import detect
from mipsjax.slam.info import FrameInfo, info_of
from mipsjax.slam.landmarks import corners_of, with_corners
from mipsjax.slam.policy import Decision, FrameStats, decide
from mipsjax.slam.recovery import find_again, lost_in_a_row, start_anew
from mipsjax.slam.tracker import Tracked, coasting, last_trusted, track
from mipsjax.submaps.astray import deviations_from_first
from mipsjax.submaps.background import refine_inactive, taken_over
from mipsjax.submaps.bundle import CHOOSE, MAP, adjust_submap, choose, make_keyframe, random_key
from mipsjax.submaps.closure import commit, judge, prepare, propose
from mipsjax.submaps.ids import FrameId, RecordId, SubmapId
from mipsjax.submaps.records import Records
from mipsjax.submaps.schedule import INLINE, Executor
from mipsjax.submaps.state import (
    Keyframe,
    Motion,
    Pose,
    Record,
    SlamState,
    Status,
    last_pose,
    pose_of,
    thumbnail,
)
from mipsjax.submaps.switching import NOT_FINITE, STAY, begin, enter, govern, with_grown_box
from mipsjax.uncertainty.held import at
from mipsjax.uncertainty.trust import RECENT

ANCHOR_MEASURED = 0.1
"""Share of pixels with depth that the first frame of a map needs."""
RESIDUAL_RISE = 0.02  # share of a frame's excess by which the least residual of late goes up


def start(
    frame: Frame, camera: Intrinsics, cfg: Config, T_world_sub: Pose | None = None
) -> tuple[SlamState, FrameInfo]:
    """A new map from its first anchor, the first frame with colour and depth, and what there is to say about it.

    `T_world_sub` is the pose of that frame in the world, the identity if none is given.
    """
    began = perf_counter()
    frame, camera, T_world_sub = checked_start(frame, camera, T_world_sub)
    corners = corners_of(frame, 0, camera, cfg)
    anchor = _keyframe(frame, RecordId(0), np.eye(4), corners, cfg, camera)
    submap, ok = begin(anchor, [], T_world_sub, cfg.map.first_steps, camera, cfg)
    info = FrameInfo(
        keyframe=True, map_steps=cfg.map.first_steps, map_ms=_ms(began), note="" if ok else "map not finite"
    )
    first = SubmapId(0)
    record = Record(
        FrameId(frame.number), frame.timestamp, first, anchor.id, np.eye(4), Status.OK, is_keyframe=True
    )
    state = with_corners(SlamState((submap,), first, Records.of([record]), camera, 0), corners, [], cfg)
    # Now, while nobody waits for a frame: programs that are needed where two submaps first meet
    prepare(state, cfg)
    return state, info


def anchor_problem(frame: Frame) -> str:
    """Why a frame cannot begin a map, or a submap that hangs on nothing; empty if it can."""
    frame = frame.cleaned()
    if frame.color is None or frame.depth is None:
        return frame.problem or "no image"
    measured = float(np.mean(frame.depth > 0))
    if measured >= ANCHOR_MEASURED:
        return ""
    return f"{_few(measured)}; a map begins with at least {100 * ANCHOR_MEASURED:g} %"


def _few(measured: float) -> str:
    return f"depth in {100 * measured:.1f} % of the pixels only"


def step(
    state: SlamState, frame: Frame, cfg: Config, executor: Executor = INLINE
) -> tuple[SlamState, FrameInfo]:
    """Tracks one frame, decides what it is worth, learns from it, and keeps the submaps in order.

    Returns the state after it, and what there is to say about the frame. `executor` refines inactive submaps
    meanwhile; the result is the same to the bit with any (`submaps/schedule.py`).
    """
    state, info = _processed(state, checked_frame(frame, state.camera), cfg, executor)
    newest = state.records[-1]
    metres, _ = deviations_from_first(state, newest.submap, newest.held.covariance, pose_of(state, newest))
    return state, info._replace(world_deviation_m=metres)


def _processed(
    state: SlamState, frame: Frame, cfg: Config, executor: Executor
) -> tuple[SlamState, FrameInfo]:
    """The state after a frame that was checked."""
    if frame.depth is None or not frame.depth.any():
        return _coast(state, frame, frame.problem or "no depth", Status.SKIPPED, cfg)
    tracked = track(state, frame, cfg)
    stats = _stats(state, frame.depth, tracked, cfg)
    decision = decide(stats, cfg)
    if decision.status is Status.LOST:
        note = f"known {stats.known:.2f}, confirmed {stats.confirmed:.2f}, residual {1e3 * stats.residual:.0f} mm"
        # Recovery may enter the submap that is being refined: what becomes of that is taken over first
        return _recover(taken_over(state, executor, cfg), frame, note, tracked, cfg)
    learned, info = _learn(state, frame, tracked, decision, cfg)
    if decision.informative:
        learned = _moved_on(learned, state, tracked, stats.residual)
        learned = with_corners(learned, tracked.corners, tracked.found, cfg)
        if tracked.doubt is not None:
            learned = learned._replace(doubts=(*learned.doubts, tracked.doubt)[-RECENT:])
    else:
        info = info._replace(note=_few(stats.measured))
    state = learned
    if state.records[-1].is_keyframe:
        began = perf_counter()
        state, problem = _order(state, cfg, executor)
        note = _notes(info.note, problem)
        info = info._replace(submap=state.active, order_ms=_ms(began), note=note)
    return refine_inactive(state, cfg, executor), info


def _order(state: SlamState, cfg: Config, executor: Executor) -> tuple[SlamState, str]:
    """After a new keyframe: the other submaps see it, loops are closed, and the right submap takes over.

    Returns what went wrong with that one, too; empty where nothing did.
    """
    # First, since it is asked of the grown box whether the camera leaves it
    state = with_grown_box(state, cfg)
    judgement = judge(state, propose(state, cfg), cfg)
    state = commit(state, judgement, cfg)
    choice = govern(state, judgement.accepted, cfg)
    if choice != STAY:
        return enter(taken_over(state, executor, cfg), choice, cfg)
    return state, ""


def _recover(
    state: SlamState, frame: Frame, note: str, tracked: Tracked, cfg: Config
) -> tuple[SlamState, FrameInfo]:
    """A lost frame: looked for in the whole map, after a while the anchor of a new submap, otherwise set aside."""
    assert frame.depth is not None
    relocation, how = None, ""
    if cfg.loop.relocalise and frame.color is not None:
        keyframe = _keyframe(frame, state.next_record, np.eye(4), tracked.corners, cfg, state.camera)
        relocation = find_again(state, keyframe, cfg)
        if relocation is not None:
            how = "again"
        elif lost_in_a_row(state, cfg.loop.patience) >= cfg.loop.patience and not anchor_problem(frame):
            relocation, how = start_anew(state, keyframe, cfg), "nowhere"
            if relocation is None:
                note = _notes(note, NOT_FINITE)
    if relocation is None:
        return _coast(state, frame, note, Status.LOST, cfg, tracked)
    state = relocation.state
    begun = how == "nowhere"
    record = _record(frame, state, relocation.T_sub_cam, Status.WEAK, relocation.keyframe)
    held = at(relocation.covariance, relocation.T_sub_cam)
    record = record._replace(held=held, depth=thumbnail(frame.depth, state.camera), is_keyframe=begun)
    info = info_of(tracked)._replace(found=how, submap=state.active, keyframe=begun)
    records = state.records.appended(record)
    # Nobody saw how the camera moved to here: no motion to go on with, and a wider search
    return state._replace(records=records, frames_in_trouble=1, motion=None), info


def _learn(
    state: SlamState,
    frame: Frame,
    tracked: Tracked,
    decision: Decision,
    cfg: Config,
) -> tuple[SlamState, FrameInfo]:
    """Local bundle adjustment with the frame, which becomes a keyframe where that was decided."""
    assert frame.depth is not None
    began = perf_counter()
    record_id, ok, T_sub_cam = state.next_record, True, tracked.T_sub_cam
    mapped = frame.color is not None and decision.map_steps > 0
    made = mapped and decision.keyframe
    if mapped:
        if made:
            current = _keyframe(frame, record_id, T_sub_cam, tracked.corners, cfg, state.camera)
        else:
            current = make_keyframe(frame, record_id, T_sub_cam, cfg, state.camera)
        current = current._replace(covariance=tracked.held.covariance)
        chosen = choose(state.submap, cfg.map.frames - 2, (cfg.seed, CHOOSE, record_id))
        # The frame takes part as the last keyframe, and goes again where it does not become one
        batch = state.submap._replace(keyframes=(*state.submap.keyframes, current))
        steps, share = decision.map_steps, decision.pose_rate
        newest = len(batch.keyframes) - 1
        key = random_key(cfg, MAP, record_id)
        batch, ok = adjust_submap(batch, [newest, *chosen], share, steps, key, state.camera, cfg)
        T_sub_cam = batch.keyframes[-1].T_sub_cam
        kept = batch if made else batch._replace(keyframes=batch.keyframes[:-1])
        state = state.with_submap(state.active, **kept._asdict())
    info = info_of(tracked)._replace(
        keyframe=made,
        map_steps=decision.map_steps if mapped else 0,
        map_ms=_ms(began),
        submap=state.active,
        note=frame.problem if ok else "map not finite",
    )
    record = _record(frame, state, T_sub_cam, decision.status)
    record = record._replace(
        held=tracked.held,
        depth=thumbnail(frame.depth, state.camera),
        colour=tracked.info.information.corners + tracked.info.information.brightness,
        is_keyframe=made,
    )
    in_trouble = state.frames_in_trouble + 1 if decision.in_trouble else 0
    return state._replace(records=state.records.appended(record), frames_in_trouble=in_trouble), info


def _keyframe(
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


def _coast(
    state: SlamState,
    frame: Frame,
    note: str,
    status: Status,
    cfg: Config,
    tracked: Tracked | None = None,
) -> tuple[SlamState, FrameInfo]:
    """A frame without a trusted pose stays where the camera was seen last; nothing is learned from it."""
    info = FrameInfo() if tracked is None else info_of(tracked)
    record = _record(frame, state, last_pose(state), status)._replace(held=coasting(state, frame, cfg))
    records, in_trouble = state.records.appended(record), state.frames_in_trouble + 1
    after = state._replace(records=records, frames_in_trouble=in_trouble)
    return after, info._replace(note=note, submap=state.active)


def _moved_on(state: SlamState, before: SlamState, tracked: Tracked, residual: float) -> SlamState:
    """With motion and residual after a trusted frame."""
    newest, older = state.records[-1], last_trusted(before)
    # In the submap, whose pose in the world may jump where a known one takes over
    T_older_newer = inverse(pose_of(state, before.records[-1])) @ pose_of(state, newest)
    # Along what is left loose the motion is believed by a gain of its own (`_believed`)
    T_older_newer = T_older_newer @ inverse(tracked.T_sub_cam) @ tracked.T_as_moved
    motion = Motion(T_older_newer, newest.timestamp - older.timestamp)
    # Falls at once and rises slowly: one frame that fits badly says little of the sensor's noise
    over = max(residual - before.residual, 0.0)
    floor = min(residual, before.residual + RESIDUAL_RISE * over) if before.residual else residual
    return state._replace(motion=motion, residual=floor)


def _stats(state: SlamState, depth: np.ndarray, tracked: Tracked, cfg: Config) -> FrameStats:
    T_sub_cam, info = tracked.T_sub_cam, tracked.info
    keyframe, last = state.submap.newest, last_pose(state)
    translation, rotation = distance(keyframe.T_sub_cam, T_sub_cam)
    step_translation, step_rotation = distance(last, T_sub_cam)
    return FrameStats(
        finite=bool(info.ok),
        measured=float(np.mean(depth > 0)),
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


def _record(
    frame: Frame,
    state: SlamState,
    T_sub_cam: Pose,
    status: Status,
    keyframe: Keyframe | None = None,
) -> Record:
    """Hung on a keyframe of the active submap, the newest if none is given."""
    submap = state.submap
    keyframe = submap.newest if keyframe is None else keyframe
    T_keyframe_cam = np.linalg.inv(keyframe.T_sub_cam) @ T_sub_cam
    return Record(FrameId(frame.number), frame.timestamp, state.active, keyframe.id, T_keyframe_cam, status)


def _notes(*notes: str) -> str:
    """Those that say something, as one."""
    return "; ".join(note for note in notes if note)


def _ms(began: float) -> float:
    return 1e3 * (perf_counter() - began)
