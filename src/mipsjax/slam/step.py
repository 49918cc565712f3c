"""The host loop: frames in, poses and a map out. It reads like Algorithm 1 of the paper.

`start`, `step` and `finish` (of `slam/finish.py`) are the whole interface. State goes in and comes out; nothing is kept
elsewhere.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.data.checked import checked_frame, checked_start
from mipsjax.data.sequence import Frame
from mipsjax.slam.info import FrameInfo, info_of
from mipsjax.slam.landmarks import corners_of, with_corners
from mipsjax.slam.outcome import (
    NOT_FOUND_YET,
    coasted,
    few,
    joined_notes,
    keyframe_for,
    keyframe_of_lost,
    moved_on,
    ms_since,
    relocated,
    stats_of,
    trusted_record,
)
from mipsjax.slam.policy import Decision, decide
from mipsjax.slam.recovery import find_again, lost_in_a_row, start_anew
from mipsjax.slam.tracker import Tracked, track
from mipsjax.submaps.astray import deviations_from_first
from mipsjax.submaps.background import refine_inactive, with_refined
from mipsjax.submaps.bundle import adjust_submap, choose, make_keyframe
from mipsjax.submaps.chance import Purpose, generator_for, key_for
from mipsjax.submaps.closure import commit, judge, prepare, propose
from mipsjax.submaps.ids import FrameId, RecordId, SubmapId
from mipsjax.submaps.mending import HOPELESS, mended
from mipsjax.submaps.records import Records
from mipsjax.submaps.schedule import INLINE, Executor
from mipsjax.submaps.state import (
    Keyframe,
    Pose,
    Record,
    SlamState,
    Status,
    Submap,
    pose_of,
)
from mipsjax.submaps.switching import (
    FULL,
    NEW,
    STAY,
    activated,
    awake,
    begin,
    enter,
    full,
    govern,
    with_grown_box,
)


def start(
    frame: Frame, camera: Intrinsics, cfg: Config, T_world_sub: Pose | None = None
) -> tuple[SlamState, FrameInfo]:
    """A new map from its first anchor, the first frame with colour and depth, and what there is to say about it.

    `T_world_sub` is the pose of that frame in the world, the identity if none is given.
    """
    began = perf_counter()
    frame, camera, T_world_sub = checked_start(frame, camera, T_world_sub)
    corners = corners_of(frame, 0, camera, cfg)
    anchor = keyframe_for(frame, RecordId(0), np.eye(4), corners, cfg, camera)
    submap, ok = begin(anchor, [], T_world_sub, cfg.map.first_steps, camera, cfg)
    info = FrameInfo(
        keyframe=True,
        map_steps=cfg.map.first_steps,
        map_ms=ms_since(began),
        note="" if ok else "map not finite",
    )
    first = SubmapId(0)
    record = Record(
        FrameId(frame.number), frame.timestamp, first, anchor.id, np.eye(4), Status.OK, is_keyframe=True
    )
    good = submap.learned if ok else None
    state = SlamState((submap,), first, Records.of([record]), camera, 0, good=good)
    state = with_corners(state, corners, [], cfg)
    # Now, while nobody waits for a frame: programs that are needed where two submaps first meet
    prepare(state, cfg)
    return state, info


def anchor_problem(frame: Frame, cfg: Config) -> str:
    """Why a frame cannot begin a map, or a submap that hangs on nothing; empty if it can."""
    frame = frame.cleaned()
    if frame.color is None or frame.depth is None:
        return frame.problem or "no image"
    measured = float(np.mean(frame.depth > 0))
    least = cfg.guard.first_measured
    if measured >= least and measured > 0:
        return ""
    return f"{few(measured)}; a map begins with at least {100 * least:g} % (--guard.first-measured)"


def step(
    state: SlamState, frame: Frame, cfg: Config, executor: Executor = INLINE
) -> tuple[SlamState, FrameInfo]:
    """Tracks one frame, decides what it is worth, learns from it, and keeps the submaps in order.

    Returns the state after it, and what there is to say about the frame. `executor` refines inactive submaps
    meanwhile; the result is the same to the bit with any (`submaps/schedule.py`).
    """
    state, info = _processed(awake(state), checked_frame(frame, state.camera), cfg, executor)
    newest = state.records[-1]
    metres, _ = deviations_from_first(state, newest.submap, newest.held.covariance, pose_of(state, newest))
    return state, info._replace(world_deviation_m=metres)


def _processed(
    state: SlamState, frame: Frame, cfg: Config, executor: Executor
) -> tuple[SlamState, FrameInfo]:
    """The state after a frame that was checked."""
    if frame.depth is None or not frame.depth.any():
        return coasted(state, frame, frame.problem or "no depth", Status.SKIPPED, cfg)
    if not state.located:
        return _recover(state, frame, NOT_FOUND_YET, None, cfg)
    tracked = track(state, frame, cfg)
    stats = stats_of(state, tracked, cfg)
    decision = decide(stats, cfg)
    if decision.status is Status.LOST:
        # It may be lost because the map is broken
        state, how = mended(state, state.active, cfg)
        if how and how != HOPELESS:
            state, info = _processed(state, frame, cfg, executor)
            return state, info._replace(note=joined_notes(how, info.note))
        # Recovery may enter the submap that is being refined: what becomes of that is taken over first
        return _recover(
            with_refined(state, executor, cfg), frame, joined_notes(how, stats.said), tracked, cfg
        )
    # Nor is what moves learned
    learned, info = _learn(state, tracked.frame, tracked, decision, cfg)
    if decision.informative:
        learned = moved_on(learned, state, tracked, stats.residual, cfg)
    else:
        info = info._replace(note=joined_notes(info.note, few(stats.measured)))
    state = learned
    if state.records[-1].is_keyframe:
        began = perf_counter()
        state, problem = _order(state, cfg, executor)
        note = joined_notes(info.note, problem)
        info = info._replace(submap=state.active, order_ms=ms_since(began), full=problem == FULL, note=note)
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
    if choice == NEW and full(state, cfg):
        return state, FULL
    if choice != STAY:
        return enter(with_refined(state, executor, cfg), choice, cfg)
    return state, ""


def _recover(
    state: SlamState, frame: Frame, note: str, tracked: Tracked | None, cfg: Config
) -> tuple[SlamState, FrameInfo]:
    """A lost frame: looked for in the whole map, after a while the anchor of a new submap, otherwise set aside.

    `tracked` is what tracking said of it, None where there was nothing to track it from.
    """
    assert frame.depth is not None
    relocation, problem = None, ""
    # However else could it be found in a map of earlier recordings?
    if (cfg.loop.relocalise or not state.located) and frame.color is not None:
        keyframe = keyframe_of_lost(state, frame, tracked, cfg)
        relocation = find_again(state, keyframe, cfg)
        # A recording that was never found in the map of others has no place in it
        waited = state.located and lost_in_a_row(state, cfg.loop.patience) >= cfg.loop.patience
        if relocation is None and waited and not anchor_problem(frame, cfg):
            relocation, problem = start_anew(state, keyframe, cfg)
            note = joined_notes(note, problem)
    if relocation is None:
        after, info = coasted(state, frame, note, Status.LOST, cfg, tracked)
        return after, info._replace(full=problem == FULL)
    entered = activated(relocation.state, relocation.submap)
    return relocated(entered, frame, relocation, tracked)


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
    T_sub_cam, note = tracked.T_sub_cam, frame.problem
    mapped = frame.color is not None and decision.map_steps > 0
    made = mapped and decision.keyframe
    if mapped:
        if made:
            current = keyframe_for(frame, state.next_record, T_sub_cam, tracked.corners, cfg, state.camera)
        else:
            current = make_keyframe(frame, state.next_record, T_sub_cam, cfg, state.camera)
        current = current._replace(covariance=tracked.held.covariance)
        state, T_sub_cam, problem = _adjusted(state, current, decision, made, cfg)
        note = joined_notes(note, problem)
    info = info_of(tracked)._replace(
        keyframe=made,
        map_steps=decision.map_steps if mapped else 0,
        map_ms=ms_since(began),
        submap=state.active,
        note=note,
    )
    record = trusted_record(frame, state, tracked, T_sub_cam, decision.status)._replace(is_keyframe=made)
    in_trouble = state.frames_in_trouble + 1 if decision.in_trouble else 0
    return state.with_record(record)._replace(frames_in_trouble=in_trouble), info


def _adjusted(
    state: SlamState, current: Keyframe, decision: Decision, kept: bool, cfg: Config
) -> tuple[SlamState, Pose, str]:
    """The active submap after local bundle adjustment with a frame, which becomes a keyframe of it if it is `kept`, the
    frame's pose after it, and what went wrong; empty if nothing did."""
    rng = generator_for(cfg, Purpose.MAP_KEYFRAMES, current.id)
    chosen = choose(state.submap, cfg.map.frames - 2, rng)
    key = key_for(cfg, Purpose.MAP, current.id)

    def adjusted(submap: Submap) -> tuple[Submap, bool]:
        # The frame takes part as the last keyframe
        batch = submap._replace(keyframes=(*submap.keyframes, current))
        batch_ids = [len(submap.keyframes), *chosen]
        steps, share = decision.map_steps, decision.pose_rate
        return adjust_submap(batch, batch_ids, share, steps, key, state.camera, cfg)

    batch, ok = adjusted(state.submap)
    problem = ""
    if not ok:
        # Either these steps were not finite, or what they began from
        state, how = mended(state, state.active, cfg)
        problem = how or "map not finite"
        if how and how != HOPELESS:
            batch, ok = adjusted(state.submap)
    T_sub_cam = batch.keyframes[-1].T_sub_cam
    submap = batch if kept else batch._replace(keyframes=batch.keyframes[:-1])
    state = state.with_submap(state.active, **submap._asdict())
    return state._replace(good=submap.learned if ok else state.good), T_sub_cam, problem
