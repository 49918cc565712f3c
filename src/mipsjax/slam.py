"""The host loop: frames in, poses and a map out. It reads like Algorithm 1 of the paper.

`start`, `step` and `finish` (of `final`) are the whole interface. State goes in and comes out; nothing is kept
elsewhere.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np

from mipsjax.background import refine_inactive, taken_over
from mipsjax.bundle import CHOOSE, MAP, choose, make_keyframe, random_key, refine
from mipsjax.closure import close, prepare
from mipsjax.config import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.data.sequence import Frame
from mipsjax.host.corners import Corners
from mipsjax.host.features import detect
from mipsjax.host.held import at, deviations
from mipsjax.host.trust import RECENT
from mipsjax.landmarks import corners_of, with_corners
from mipsjax.policy import STAY, Decision, FrameStats, Status, decide
from mipsjax.recovery import find_again, lost_in_a_row, start_anew
from mipsjax.schedule import INLINE, Executor
from mipsjax.state import (
    FrameInfo,
    Keyframe,
    Motion,
    Pose,
    Record,
    SlamState,
    distance,
    inverse,
    last_pose,
    pose_of,
    thumbnail,
)
from mipsjax.territory import begin, enter, govern, settle
from mipsjax.tracker import Tracked, coasting, last_trusted, track

ANCHOR_MEASURED = 0.1
"""Share of pixels with depth that the first frame of a map needs."""
RESIDUAL_RISE = 0.02  # share of a frame's excess by which the least residual of late goes up


def start(frame: Frame, camera: Intrinsics, cfg: Config, T_world_sub: Pose | None = None) -> SlamState:
    """A new map from its first anchor, the first frame with colour and depth.

    `T_world_sub` is the pose of that frame in the world, the identity if none is given.
    """
    began = perf_counter()
    frame = frame.cleaned()
    corners = corners_of(frame, 0, camera, cfg)
    anchor = _keyframe(frame, 0, np.eye(4), corners, cfg, camera)
    T_world_sub = np.eye(4) if T_world_sub is None else T_world_sub
    submap, ok = begin(anchor, [], T_world_sub, cfg.map.first_steps, camera, cfg)
    info = FrameInfo(
        keyframe=True, map_steps=cfg.map.first_steps, map_ms=_ms(began), note="" if ok else "map not finite"
    )
    record = Record(frame.number, frame.timestamp, 0, 0, np.eye(4), Status.OK, info)
    state = with_corners(SlamState((submap,), 0, (record,), camera, 0), corners, [], cfg)
    prepare(state, cfg)
    return state


def anchor_problem(frame: Frame) -> str:
    """Why a frame cannot begin a map, or a submap that hangs on nothing; empty if it can."""
    frame = frame.cleaned()
    if frame.color is None or frame.depth is None:
        return frame.problem or "no image"
    measured = float(np.mean(frame.depth > 0))
    return "" if measured >= ANCHOR_MEASURED else _few(measured)


def _few(measured: float) -> str:
    return f"depth in {100 * measured:.1f} % of the pixels only"


def step(state: SlamState, frame: Frame, cfg: Config, executor: Executor = INLINE) -> SlamState:
    """Tracks one frame, decides what it is worth, learns from it, and keeps the submaps in order.

    `executor` refines inactive submaps meanwhile; what comes out is the same to the bit with any (`schedule.py`).
    """
    frame = frame.cleaned()
    if frame.depth is None or not frame.depth.any():
        return _coast(state, frame, frame.problem or "no depth", Status.SKIPPED, cfg)
    tracked = track(state, frame, cfg)
    stats = _stats(state, frame.depth, tracked)
    decision = decide(stats, cfg)
    if decision.status is Status.LOST:
        note = f"known {stats.known:.2f}, confirmed {stats.confirmed:.2f}, residual {1e3 * stats.residual:.0f} mm"
        return _recover(taken_over(state, executor), frame, note, tracked, cfg)
    if not decision.tells:
        frame = frame._replace(problem=_few(stats.measured))
    learned = _learn(state, frame, tracked, decision, cfg)
    if decision.tells:
        learned = _moved_on(learned, state, tracked, stats.residual)
        learned = with_corners(learned, tracked.corners, tracked.found, cfg)
        if tracked.doubt is not None:
            learned = learned._replace(doubts=(*learned.doubts, tracked.doubt)[-RECENT:])
    state = learned
    if state.records[-1].info.keyframe:
        state = _order(state, cfg, executor)
    return refine_inactive(state, cfg, executor)


def _order(state: SlamState, cfg: Config, executor: Executor) -> SlamState:
    """After a new keyframe: the other submaps see it, loops are closed, and the right submap takes over."""
    began, before = perf_counter(), state
    state, sightings = settle(state, cfg)
    if cfg.loop.enabled:
        state = close(state, sightings, before, cfg)
    choice = govern(state, cfg)
    if choice != STAY:
        state = enter(taken_over(state, executor), choice, cfg)
    last = state.records[-1]
    info = last.info._replace(submap=state.active, order_ms=_ms(began))
    return state._replace(records=(*state.records[:-1], last._replace(info=info)))


def _recover(state: SlamState, frame: Frame, note: str, tracked: Tracked, cfg: Config) -> SlamState:
    """A lost frame: looked for in the whole map, after a while the anchor of a new submap, otherwise set aside."""
    assert frame.depth is not None
    place, found = None, ""
    if cfg.loop.relocalise and frame.color is not None:
        keyframe = _keyframe(frame, len(state.records), np.eye(4), tracked.corners, cfg, state.camera)
        place = find_again(state, keyframe, cfg)
        if place is not None:
            found = "again"
        elif lost_in_a_row(state) >= cfg.loop.patience and not anchor_problem(frame):
            place, found = start_anew(state, keyframe, cfg), "nowhere"
    if place is None:
        return _coast(state, frame, note, Status.LOST, cfg, tracked)
    details = _info(tracked)._replace(found=found, submap=place.state.active, keyframe=found == "nowhere")
    record = _record(frame, place.state, place.T_sub_cam, Status.WEAK, details, place.keyframe)
    held = at(place.covariance, place.T_sub_cam)
    record = record._replace(held=held, depth=thumbnail(frame.depth, state.camera))
    return place.state._replace(records=(*state.records, record), trouble=1, motion=None)


def _learn(
    state: SlamState,
    frame: Frame,
    tracked: Tracked,
    decision: Decision,
    cfg: Config,
) -> SlamState:
    """Local bundle adjustment with the frame, which becomes a keyframe where that was decided."""
    assert frame.depth is not None
    began = perf_counter()
    number, ok, T_sub_cam = len(state.records), True, tracked.T_sub_cam
    mapped = frame.color is not None and decision.map_steps > 0
    made = mapped and decision.keyframe
    if mapped:
        if made:
            current = _keyframe(frame, number, T_sub_cam, tracked.corners, cfg, state.camera)
        else:
            current = make_keyframe(frame, number, T_sub_cam, cfg, state.camera)
        current = current._replace(covariance=tracked.held.covariance)
        chosen = choose(state.submap, cfg.map.frames - 2, (cfg.seed, CHOOSE, number))
        batch = state.submap._replace(keyframes=(*state.submap.keyframes, current))
        steps, share = decision.map_steps, decision.pose_rate
        newest = len(batch.keyframes) - 1
        key = random_key(cfg, MAP, number)
        batch, ok = refine(batch, [newest, *chosen], share, steps, key, state.camera, cfg)
        T_sub_cam = batch.keyframes[-1].T_sub_cam
        kept = batch if made else batch._replace(keyframes=batch.keyframes[:-1])
        state = state.with_submap(state.active, **kept._asdict())
    details = _info(tracked)._replace(
        keyframe=made,
        map_steps=decision.map_steps if mapped else 0,
        map_ms=_ms(began),
        submap=state.active,
        note=frame.problem if ok else "map not finite",
    )
    record = _record(frame, state, T_sub_cam, decision.status, details)
    record = record._replace(
        held=tracked.held,
        depth=thumbnail(frame.depth, state.camera),
        colour=tracked.info.information.corners + tracked.info.information.brightness,
    )
    trouble = state.trouble + 1 if decision.trouble else 0
    return state._replace(records=(*state.records, record), trouble=trouble)


def _keyframe(
    frame: Frame, number: int, T_sub_cam: Pose, corners: Corners | None, cfg: Config, camera: Intrinsics
) -> Keyframe:
    """The keyframe that a frame becomes, with features where loops want them, and with its `corners` where keyframes
    are measured against each other."""
    keyframe = make_keyframe(frame, number, T_sub_cam, cfg, camera)
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
) -> SlamState:
    """A frame without a trusted pose stays where the camera was seen last; nothing is learned from it."""
    T_sub_cam = last_pose(state)
    details = FrameInfo() if tracked is None else _info(tracked)
    details = details._replace(note=note, submap=state.active)
    record = _record(frame, state, T_sub_cam, status, details)._replace(held=coasting(state, frame, cfg))
    return state._replace(records=(*state.records, record), trouble=state.trouble + 1)


def _moved_on(state: SlamState, before: SlamState, tracked: Tracked, residual: float) -> SlamState:
    """With motion and residual after a trusted frame."""
    newest, older = state.records[-1], last_trusted(before)
    T_older_newer = inverse(pose_of(state, before.records[-1])) @ pose_of(state, newest)
    T_older_newer = T_older_newer @ inverse(tracked.T_sub_cam) @ tracked.T_as_moved
    motion = Motion(T_older_newer, newest.timestamp - older.timestamp)
    over = max(residual - before.residual, 0.0)
    floor = min(residual, before.residual + RESIDUAL_RISE * over) if before.residual else residual
    return state._replace(motion=motion, residual=floor)


def _stats(state: SlamState, depth: np.ndarray, tracked: Tracked) -> FrameStats:
    T_sub_cam, info = tracked.T_sub_cam, tracked.info
    keyframe, last = state.submap.keyframes[state.submap.newest], last_pose(state)
    translation, rotation = distance(keyframe.T_sub_cam, T_sub_cam)
    step_translation, step_rotation = distance(last, T_sub_cam)
    return FrameStats(
        finite=bool(info.ok),
        measured=float(np.mean(depth > 0)),
        known=float(info.after.known),
        confirmed=float(info.after.confirmed),
        open=float(tracked.together.deviation[-1]),
        astray=deviations(tracked.held.covariance, T_sub_cam)[0],
        residual=float(info.after.residual),
        least_residual=state.residual,
        unsure=state.records[-1].status in (Status.LOST, Status.SKIPPED),
        lost=lost_in_a_row(state),
        since_keyframe=len(state.records) - keyframe.number,
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
    info: FrameInfo,
    keyframe: int | None = None,
) -> Record:
    """Hung on a keyframe of the active submap, the newest if none is given."""
    submap = state.submap
    keyframe = submap.newest if keyframe is None else keyframe
    relative = np.linalg.inv(submap.keyframes[keyframe].T_sub_cam) @ T_sub_cam
    return Record(frame.number, frame.timestamp, state.active, keyframe, relative, status, info)


def _info(tracked: Tracked) -> FrameInfo:
    before, after, together = tracked.info.before, tracked.info.after, tracked.together
    return FrameInfo(
        residual_before=float(before.residual),
        residual_after=float(after.residual),
        known=float(after.known),
        confirmed=float(after.confirmed),
        surfaces=_numbers(tracked.surfaces.deviation),
        together=_numbers(together.deviation),
        free=_numbers(together.twist[-1]),
        searched=bool(tracked.info.searched),
        track_ms=tracked.ms,
    )


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.2g}" for value in values)


def _ms(began: float) -> float:
    return 1e3 * (perf_counter() - began)
