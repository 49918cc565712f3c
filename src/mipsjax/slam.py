"""The host loop: frames in, poses and a map out. It reads like Algorithm 1 of the paper.

`start`, `step` and `finish` (of `final`) are the whole interface. State goes in and comes out; nothing is kept
elsewhere.
"""

from __future__ import annotations

from time import perf_counter

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from mipsjax.bundle import CHOOSE, INIT, TRACK, adjust, make_keyframe, random_key
from mipsjax.config import Config
from mipsjax.core import mapping, tracking
from mipsjax.core.camera import Intrinsics
from mipsjax.core.views import Views
from mipsjax.data.sequence import Frame
from mipsjax.policy import Decision, FrameStats, Status, decide, widening
from mipsjax.state import (
    FrameInfo,
    Keyframe,
    Pose,
    Record,
    SlamState,
    distance,
    last_pose,
    pose_of,
    rigid,
    thumbnail,
)

DT_MIN = 1e-3  # seconds; two stamps nearer than this count as this far apart
DT_RATIO_MAX = 5.0  # a gap longer than this many intervals is not extrapolated further


def start(frame: Frame, camera: Intrinsics, cfg: Config, T_world_sub: Pose | None = None) -> SlamState:
    """A new submap from its anchor, the first frame with colour and depth.

    `T_world_sub` is the pose of that frame in the world, the identity if none is given.
    """
    began = perf_counter()
    submap = mapping.create(random_key(cfg, INIT, 0), cfg)
    keyframe = make_keyframe(frame, 0, np.eye(4), cfg, camera)
    submap, _, ok = adjust(
        submap, [keyframe] * cfg.map.frames, [0.0] * cfg.map.frames, cfg.map.first_steps, 0, camera, cfg
    )
    info = FrameInfo(
        keyframe=True, map_steps=cfg.map.first_steps, map_ms=_ms(began), note="" if ok else "map not finite"
    )
    record = Record(frame.number, frame.timestamp, 0, np.eye(4), Status.OK, info)
    return SlamState(
        submap, (keyframe,), (record,), np.eye(4) if T_world_sub is None else T_world_sub, camera, 0
    )


def step(state: SlamState, frame: Frame, cfg: Config) -> SlamState:
    """Tracks one frame, decides what it is worth, and learns from it."""
    if frame.depth is None or not frame.depth.any():
        return _coast(state, frame, frame.problem or "no depth", Status.SKIPPED, cfg)
    began = perf_counter()
    T_sub_cam, info = _track(state, frame, cfg)
    track_ms = _ms(began)
    stats = _stats(state, T_sub_cam, info)
    decision = decide(stats, cfg)
    if decision.status is Status.LOST:
        return _coast(state, frame, f"known {stats.known:.2f}", Status.LOST, cfg, info, track_ms)
    return _learn(state, frame, T_sub_cam, decision, info, track_ms, cfg)


def _track(state: SlamState, frame: Frame, cfg: Config) -> tuple[Pose, tracking.TrackInfo]:
    assert frame.depth is not None
    color = np.zeros((*frame.depth.shape, 3), np.uint8) if frame.color is None else frame.color
    T, info = tracking.track(
        state.submap.field,
        frame.depth,
        color,
        np.stack(_candidates(state, frame.timestamp)).astype(np.float32),
        np.float32(widening(state.trouble, cfg)),
        random_key(cfg, TRACK, len(state.records)),
        state.camera,
        cfg,
        _views(state, cfg),
    )
    T, info = jax.device_get((T, info))
    return rigid(T), info


def _views(state: SlamState, cfg: Config) -> Views:
    """Keyframes near the last pose, spread evenly from the oldest, which has drifted least, to the newest."""
    last, go = last_pose(state), cfg.track.go
    near = [
        keyframe
        for keyframe in state.keyframes
        if np.all(np.less(distance(keyframe.T_sub_cam, last), (go.view_translation, go.view_rotation)))
    ] or [state.keyframes[-1]]
    chosen = [near[round(i)] for i in np.linspace(0, len(near) - 1, go.views)]
    height, width = near[0].depth.shape
    return Views(
        jnp.asarray(np.array([k.depth for k in chosen], np.float32).reshape(-1, height, width)),
        jnp.asarray(np.array([k.T_sub_cam for k in chosen], np.float32).reshape(-1, 4, 4)),
    )


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
    number, submap, keyframes, ok = len(state.records), state.submap, list(state.keyframes), True
    mapped = frame.color is not None and decision.map_steps > 0
    if mapped:
        current = make_keyframe(frame, number, T_sub_cam, cfg, state.camera)
        chosen = _choose(len(keyframes), number, cfg)
        batch = [current, *(keyframes[i] for i in chosen)]
        rates = [decision.pose_rate if i != 0 else 0.0 for i in (-1, *chosen)]
        submap, poses, ok = adjust(submap, batch, rates, decision.map_steps, number, state.camera, cfg)
        T_sub_cam = poses[0]
        for i, pose in zip(chosen, poses[1:], strict=True):
            keyframes[i] = keyframes[i]._replace(T_sub_cam=pose)
        if decision.keyframe:
            keyframes.append(current._replace(T_sub_cam=T_sub_cam))
    made = mapped and decision.keyframe
    details = _info(info, track_ms)._replace(
        keyframe=made,
        map_steps=decision.map_steps if mapped else 0,
        map_ms=_ms(began),
        note=frame.problem if ok else "map not finite",
    )
    record = _record(frame, keyframes, T_sub_cam, decision.status, details)
    record = record._replace(depth=thumbnail(frame.depth, state.camera))
    trouble = 0 if decision.status is Status.OK else state.trouble + 1
    return state._replace(
        submap=submap, keyframes=tuple(keyframes), records=(*state.records, record), trouble=trouble
    )


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
    details = (FrameInfo() if info is None else _info(info, track_ms))._replace(note=note)
    record = _record(frame, list(state.keyframes), T_sub_cam, status, details)
    return state._replace(records=(*state.records, record), trouble=state.trouble + 1)


def _choose(count: int, number: int, cfg: Config) -> list[int]:
    """Keyframes that are optimised with the current frame: the anchor and random others, repeated if too few."""
    rng = np.random.default_rng((cfg.seed, CHOOSE, number))
    others = cfg.map.frames - 2
    chosen = rng.choice(np.arange(1, count), min(others, count - 1), replace=False) if count > 1 else []
    picked = [0, *(int(i) for i in chosen)]
    return picked + [0] * (cfg.map.frames - 1 - len(picked))


def _candidates(state: SlamState, timestamp: float) -> list[Pose]:
    """Constant velocity over the real time between frames, and no motion."""
    last = last_pose(state)
    trusted = [r for r in state.records[-8:] if r.status in (Status.OK, Status.WEAK)][-2:]
    if len(trusted) < 2:
        return [last, last]
    older, newer = trusted
    ratio = (timestamp - newer.timestamp) / max(newer.timestamp - older.timestamp, DT_MIN)
    motion = np.linalg.inv(pose_of(state, older)) @ pose_of(state, newer)
    return [last @ _scaled(motion, min(max(ratio, 0.0), DT_RATIO_MAX)), last]


def _scaled(motion: Pose, ratio: float) -> Pose:
    scaled = np.eye(4)
    scaled[:3, :3] = Rotation.from_rotvec(
        ratio * Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    ).as_matrix()
    scaled[:3, 3] = ratio * motion[:3, 3]
    return scaled


def _stats(state: SlamState, T_sub_cam: Pose, info: tracking.TrackInfo) -> FrameStats:
    keyframe, last = state.keyframes[-1], last_pose(state)
    translation, rotation = distance(keyframe.T_sub_cam, T_sub_cam)
    step_translation, step_rotation = distance(last, T_sub_cam)
    return FrameStats(
        finite=bool(info.ok),
        known=float(info.after.known),
        since_keyframe=len(state.records) - keyframe.number,
        translation=translation,
        rotation=rotation,
        step_translation=step_translation,
        step_rotation=step_rotation,
    )


def _record(
    frame: Frame, keyframes: list[Keyframe], T_sub_cam: Pose, status: Status, info: FrameInfo
) -> Record:
    relative = np.linalg.inv(keyframes[-1].T_sub_cam) @ T_sub_cam
    return Record(frame.number, frame.timestamp, len(keyframes) - 1, relative, status, info)


def _info(info: tracking.TrackInfo, track_ms: float) -> FrameInfo:
    return FrameInfo(
        residual_before=float(info.before.residual),
        residual_after=float(info.after.residual),
        known=float(info.after.known),
        searched=bool(info.searched),
        track_ms=track_ms,
    )


def _ms(began: float) -> float:
    return 1e3 * (perf_counter() - began)
