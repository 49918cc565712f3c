"""The host loop: frames in, poses and a map out. It reads like Algorithm 1 of the paper.

`start`, `step` and `finish` (of `final`) are the whole interface. State goes in and comes out; nothing is kept
elsewhere.
"""

from __future__ import annotations

from time import perf_counter

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from mipsjax.background import refine_inactive, taken_over
from mipsjax.bundle import CHOOSE, MAP, TRACK, choose, make_keyframe, random_key, refine, views_of
from mipsjax.closure import close, prepare
from mipsjax.config import Config
from mipsjax.core import tracking
from mipsjax.core.camera import Intrinsics
from mipsjax.core.views import Views
from mipsjax.data.sequence import Frame
from mipsjax.host.features import detect
from mipsjax.landmarks import follow_all, landmarks, with_corners
from mipsjax.policy import STAY, Decision, FrameStats, Status, converged, decide, widening
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
    rigid,
    thumbnail,
)
from mipsjax.territory import begin, enter, govern, settle

ANCHOR_MEASURED = 0.1
"""Share of pixels with depth that the first frame of a map needs."""
DT_MIN = 1e-3  # seconds; two stamps nearer than this count as this far apart
DT_RATIO_MAX = 5.0  # a gap longer than this many intervals is not extrapolated further
RESIDUAL_RISE = 0.02  # share of a frame's excess by which the least residual of late goes up


def start(frame: Frame, camera: Intrinsics, cfg: Config, T_world_sub: Pose | None = None) -> SlamState:
    """A new map from its first anchor, the first frame with colour and depth.

    `T_world_sub` is the pose of that frame in the world, the identity if none is given.
    """
    began = perf_counter()
    anchor = _keyframe(frame.cleaned(), 0, np.eye(4), cfg, camera)
    T_world_sub = np.eye(4) if T_world_sub is None else T_world_sub
    submap, ok = begin(anchor, [], T_world_sub, cfg.map.first_steps, camera, cfg)
    info = FrameInfo(
        keyframe=True, map_steps=cfg.map.first_steps, map_ms=_ms(began), note="" if ok else "map not finite"
    )
    record = Record(frame.number, frame.timestamp, 0, 0, np.eye(4), Status.OK, info)
    state = with_corners(SlamState((submap,), 0, (record,), camera, 0), frame.cleaned(), cfg)
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
    began = perf_counter()
    T_sub_cam, info = _track(state, frame, cfg)
    track_ms = _ms(began)
    stats = _stats(state, frame.depth, T_sub_cam, info)
    decision = decide(stats, cfg)
    if decision.status is Status.LOST:
        note = f"known {stats.known:.2f}, confirmed {stats.confirmed:.2f}, residual {1e3 * stats.residual:.0f} mm"
        return _recover(taken_over(state, executor), frame, note, info, track_ms, cfg)
    if not decision.tells:
        frame = frame._replace(problem=_few(stats.measured))
    learned = _learn(state, frame, T_sub_cam, decision, info, track_ms, cfg)
    if decision.tells:
        learned = with_corners(_moved_on(learned, state, float(info.after.residual)), frame, cfg)
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


def _recover(
    state: SlamState, frame: Frame, note: str, info: tracking.TrackInfo, track_ms: float, cfg: Config
) -> SlamState:
    """A lost frame: looked for in the whole map, after a while the anchor of a new submap, otherwise set aside."""
    assert frame.depth is not None
    place, found = None, ""
    if cfg.loop.relocalise and frame.color is not None:
        keyframe = _keyframe(frame, len(state.records), np.eye(4), cfg, state.camera)
        place = find_again(state, keyframe, cfg)
        if place is not None:
            found = "again"
        elif lost_in_a_row(state) >= cfg.loop.patience and not anchor_problem(frame):
            place, found = start_anew(state, keyframe, cfg), "nowhere"
    if place is None:
        return _coast(state, frame, note, Status.LOST, cfg, info, track_ms)
    details = _info(info, track_ms)._replace(
        found=found, submap=place.state.active, keyframe=found == "nowhere"
    )
    record = _record(frame, place.state, place.T_sub_cam, Status.WEAK, details, place.keyframe)
    record = record._replace(depth=thumbnail(frame.depth, state.camera))
    return place.state._replace(records=(*state.records, record), trouble=1, motion=None)


def _track(state: SlamState, frame: Frame, cfg: Config) -> tuple[Pose, tracking.TrackInfo]:
    assert frame.depth is not None
    color = np.zeros((*frame.depth.shape, 3), np.uint8) if frame.color is None else frame.color
    candidates = _candidates(state, frame.timestamp)
    found = follow_all(state, frame, candidates[0], cfg)
    if found:
        # What was measured between two images is a better guess than that the camera has gone on as before
        candidates = [found[0].T_sub_cam, candidates[0]]
    T, info = tracking.track(
        state.submap.learned.field,
        frame.depth,
        color,
        np.stack(candidates).astype(np.float32),
        np.float32(widening(state.trouble, cfg)),
        random_key(cfg, TRACK, len(state.records)),
        state.camera,
        cfg,
        _views(state, cfg),
        np.float32(converged(state.residual, cfg)),
        landmarks(found, state.camera, cfg),
    )
    T, info = jax.device_get((T, info))
    return rigid(T), info


def _views(state: SlamState, cfg: Config) -> Views:
    """Keyframes near the last pose, spread evenly over their list, which begins with the anchor."""
    last, go = last_pose(state), cfg.track.go
    submap = state.submap
    near = [
        keyframe
        for keyframe in submap.keyframes
        if np.all(np.less(distance(keyframe.T_sub_cam, last), (go.view_translation, go.view_rotation)))
    ] or [submap.keyframes[submap.newest]]
    chosen = [near[round(i)] for i in np.linspace(0, len(near) - 1, go.views)]
    return views_of(chosen)


def _learn(
    state: SlamState,
    frame: Frame,
    T_sub_cam: Pose,
    decision: Decision,
    info: tracking.TrackInfo,
    track_ms: float,
    cfg: Config,
) -> SlamState:
    """Local bundle adjustment with the frame, which becomes a keyframe where that was decided."""
    assert frame.depth is not None
    began = perf_counter()
    number, ok = len(state.records), True
    mapped = frame.color is not None and decision.map_steps > 0
    made = mapped and decision.keyframe
    if mapped:
        current = (_keyframe if made else make_keyframe)(frame, number, T_sub_cam, cfg, state.camera)
        chosen = choose(state.submap, cfg.map.frames - 2, (cfg.seed, CHOOSE, number))
        batch = state.submap._replace(keyframes=(*state.submap.keyframes, current))
        steps, share = decision.map_steps, decision.pose_rate
        newest = len(batch.keyframes) - 1
        key = random_key(cfg, MAP, number)
        batch, ok = refine(batch, [newest, *chosen], share, steps, key, state.camera, cfg)
        T_sub_cam = batch.keyframes[-1].T_sub_cam
        kept = batch if made else batch._replace(keyframes=batch.keyframes[:-1])
        state = state.with_submap(state.active, **kept._asdict())
    details = _info(info, track_ms)._replace(
        keyframe=made,
        map_steps=decision.map_steps if mapped else 0,
        map_ms=_ms(began),
        submap=state.active,
        note=frame.problem if ok else "map not finite",
    )
    record = _record(frame, state, T_sub_cam, decision.status, details)
    record = record._replace(depth=thumbnail(frame.depth, state.camera))
    trouble = 0 if decision.status is Status.OK else state.trouble + 1
    return state._replace(records=(*state.records, record), trouble=trouble)


def _keyframe(frame: Frame, number: int, T_sub_cam: Pose, cfg: Config, camera: Intrinsics) -> Keyframe:
    """With features, if they are wanted."""
    keyframe = make_keyframe(frame, number, T_sub_cam, cfg, camera)
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
    info: tracking.TrackInfo | None = None,
    track_ms: float = 0.0,
) -> SlamState:
    """A frame without a trusted pose stays where the camera was seen last; nothing is learned from it."""
    T_sub_cam = last_pose(state)
    details = FrameInfo() if info is None else _info(info, track_ms)
    details = details._replace(note=note, submap=state.active)
    record = _record(frame, state, T_sub_cam, status, details)
    return state._replace(records=(*state.records, record), trouble=state.trouble + 1)


def _candidates(state: SlamState, timestamp: float) -> list[Pose]:
    """Constant velocity over the real time since the last trusted frame, and no motion; the expected one first.

    Over a longer time than velocity is carried on for, it says nothing, and no motion comes first.
    """
    last = last_pose(state)
    if state.motion is None:
        return [last, last]
    ratio = (timestamp - _last_trusted(state).timestamp) / max(state.motion.seconds, DT_MIN)
    moved = last @ _scaled(state.motion.T_older_newer, min(max(ratio, 0.0), DT_RATIO_MAX))
    return [moved, last] if ratio <= DT_RATIO_MAX else [last, moved]


def _last_trusted(state: SlamState) -> Record:
    return next(r for r in reversed(state.records) if r.status in (Status.OK, Status.WEAK))


def _moved_on(state: SlamState, before: SlamState, residual: float) -> SlamState:
    """With motion and residual after a trusted frame."""
    newest, older = state.records[-1], _last_trusted(before)
    T_older_newer = inverse(pose_of(state, before.records[-1])) @ pose_of(state, newest)
    motion = Motion(T_older_newer, newest.timestamp - older.timestamp)
    over = max(residual - before.residual, 0.0)
    floor = min(residual, before.residual + RESIDUAL_RISE * over) if before.residual else residual
    return state._replace(motion=motion, residual=floor)


def _scaled(motion: Pose, ratio: float) -> Pose:
    scaled = np.eye(4)
    scaled[:3, :3] = Rotation.from_rotvec(
        ratio * Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    ).as_matrix()
    scaled[:3, 3] = ratio * motion[:3, 3]
    return scaled


def _stats(state: SlamState, depth: np.ndarray, T_sub_cam: Pose, info: tracking.TrackInfo) -> FrameStats:
    keyframe, last = state.submap.keyframes[state.submap.newest], last_pose(state)
    translation, rotation = distance(keyframe.T_sub_cam, T_sub_cam)
    step_translation, step_rotation = distance(last, T_sub_cam)
    return FrameStats(
        finite=bool(info.ok),
        measured=float(np.mean(depth > 0)),
        known=float(info.after.known),
        confirmed=float(info.after.confirmed),
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


def _info(info: tracking.TrackInfo, track_ms: float) -> FrameInfo:
    return FrameInfo(
        residual_before=float(info.before.residual),
        residual_after=float(info.after.residual),
        known=float(info.after.known),
        confirmed=float(info.after.confirmed),
        searched=bool(info.searched),
        track_ms=track_ms,
    )


def _ms(began: float) -> float:
    return 1e3 * (perf_counter() - began)
