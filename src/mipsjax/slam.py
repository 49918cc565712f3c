"""The host loop: frames in, poses and a map out. It reads like Algorithm 1 of the paper.

`start`, `step` and `finish` are the whole interface. State goes in and comes out; nothing is kept elsewhere.
"""

from __future__ import annotations

from time import perf_counter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from scipy.spatial.transform import Rotation

from mipsjax.config import Config
from mipsjax.core import mapping, tracking
from mipsjax.core.camera import Intrinsics
from mipsjax.data.sequence import Frame
from mipsjax.policy import Decision, FrameStats, Status, decide, widening

Pose = Float64[np.ndarray, "4 4"]

# Purposes of random draws: a draw added in one place moves no other.
INIT, TRACK, MAP, CHOOSE, FINISH = range(5)
FINISH_STEPS = 10  # of each batch in `finish`
DT_MIN = 1e-3  # seconds; two stamps nearer than this count as this far apart
DT_RATIO_MAX = 5.0  # a gap longer than this many intervals is not extrapolated further


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


def start(frame: Frame, camera: Intrinsics, cfg: Config, T_world_sub: Pose | None = None) -> SlamState:
    """A new submap from its anchor, the first frame with colour and depth.

    `T_world_sub` is the pose of that frame in the world, the identity if none is given.
    """
    began = perf_counter()
    submap = mapping.create(_key(cfg, INIT, 0), cfg)
    keyframe = _keyframe(frame, 0, np.eye(4), cfg, camera)
    submap, _, ok = _refine(
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


def finish(state: SlamState, cfg: Config) -> SlamState:
    """Bundle adjustment over all keyframes after the last frame, at rates that fall to zero.

    Each call of `mapping.refine` takes another random batch; the anchor is always fixed.
    """
    calls, keyframes, submap = -(-cfg.map.final_steps // FINISH_STEPS), list(state.keyframes), state.submap
    for call in range(calls):
        rng = np.random.default_rng((cfg.seed, FINISH, call))
        fresh = len(keyframes) < cfg.map.frames
        chosen = [int(i) for i in rng.choice(len(keyframes), cfg.map.frames, replace=fresh)]
        fall = 1 - call / calls
        rates = [cfg.map.pose_rate_slow * fall if i != 0 else 0.0 for i in chosen]
        batch, number = [keyframes[i] for i in chosen], len(state.records) + call
        submap, poses, _ = _refine(submap, batch, rates, FINISH_STEPS, number, state.camera, cfg, fall)
        for i, pose in zip(chosen, poses, strict=True):
            keyframes[i] = keyframes[i]._replace(T_sub_cam=pose)
    return state._replace(submap=submap, keyframes=tuple(keyframes))


def trajectory(state: SlamState) -> Float64[np.ndarray, "N 4 4"]:
    """World pose of every processed frame, camera-to-world."""
    return np.stack([state.T_world_sub @ _pose(state, record) for record in state.records])


def _track(state: SlamState, frame: Frame, cfg: Config) -> tuple[Pose, tracking.TrackInfo]:
    assert frame.depth is not None
    color = np.zeros((*frame.depth.shape, 3), np.uint8) if frame.color is None else frame.color
    T, info = tracking.track(
        state.submap.field,
        frame.depth,
        color,
        np.stack(_candidates(state, frame.timestamp)).astype(np.float32),
        np.float32(widening(state.trouble, cfg)),
        _key(cfg, TRACK, len(state.records)),
        state.camera,
        cfg,
    )
    T, info = jax.device_get((T, info))
    return _rigid(T), info


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
    began = perf_counter()
    number, submap, keyframes, ok = len(state.records), state.submap, list(state.keyframes), True
    mapped = frame.color is not None and decision.map_steps > 0
    if mapped:
        current = _keyframe(frame, number, T_sub_cam, cfg, state.camera)
        chosen = _choose(len(keyframes), number, cfg)
        batch = [current, *(keyframes[i] for i in chosen)]
        rates = [decision.pose_rate if i != 0 else 0.0 for i in (-1, *chosen)]
        submap, poses, ok = _refine(submap, batch, rates, decision.map_steps, number, state.camera, cfg)
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
    T_sub_cam = _last_pose(state)
    details = (FrameInfo() if info is None else _info(info, track_ms))._replace(note=note)
    record = _record(frame, list(state.keyframes), T_sub_cam, status, details)
    return state._replace(records=(*state.records, record), trouble=state.trouble + 1)


def _refine(
    submap: mapping.Submap,
    batch: list[Keyframe],
    rates: list[float],
    steps: int,
    number: int,
    camera: Intrinsics,
    cfg: Config,
    rate: float = 1.0,
) -> tuple[mapping.Submap, list[Pose], bool]:
    frames = mapping.Frames(
        depth=jnp.asarray(np.stack([k.depth for k in batch])),
        color=jnp.asarray(np.stack([k.color for k in batch])),
        T_sub_cam=jnp.asarray(np.stack([k.T_sub_cam for k in batch]), jnp.float32),
        movable=jnp.asarray(np.array(rates, np.float32)),
    )
    small = camera.decimated(mapping_stride(camera, cfg))
    submap, poses, info = mapping.refine(
        submap, frames, jnp.int32(steps), _key(cfg, MAP, number), small, cfg, np.float32(rate)
    )
    moved = [
        _rigid(pose) if rate else k.T_sub_cam
        for pose, rate, k in zip(np.asarray(poses), rates, batch, strict=True)
    ]
    return submap, moved, bool(info.ok)


def mapping_stride(camera: Intrinsics, cfg: Config) -> int:
    """Images are decimated by this for mapping."""
    return max(1, round(camera.width / cfg.map.width_px))


def _choose(count: int, number: int, cfg: Config) -> list[int]:
    """Keyframes that are optimised with the current frame: the anchor and random others, repeated if too few."""
    rng = np.random.default_rng((cfg.seed, CHOOSE, number))
    others = cfg.map.frames - 2
    chosen = rng.choice(np.arange(1, count), min(others, count - 1), replace=False) if count > 1 else []
    picked = [0, *(int(i) for i in chosen)]
    return picked + [0] * (cfg.map.frames - 1 - len(picked))


def _candidates(state: SlamState, timestamp: float) -> list[Pose]:
    """Constant velocity over the real time between frames, and no motion."""
    last = _last_pose(state)
    trusted = [r for r in state.records[-8:] if r.status in (Status.OK, Status.WEAK)][-2:]
    if len(trusted) < 2:
        return [last, last]
    older, newer = trusted
    ratio = (timestamp - newer.timestamp) / max(newer.timestamp - older.timestamp, DT_MIN)
    motion = np.linalg.inv(_pose(state, older)) @ _pose(state, newer)
    return [last @ _scaled(motion, min(max(ratio, 0.0), DT_RATIO_MAX)), last]


def _scaled(motion: Pose, ratio: float) -> Pose:
    scaled = np.eye(4)
    scaled[:3, :3] = Rotation.from_rotvec(
        ratio * Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    ).as_matrix()
    scaled[:3, 3] = ratio * motion[:3, 3]
    return scaled


def _stats(state: SlamState, T_sub_cam: Pose, info: tracking.TrackInfo) -> FrameStats:
    keyframe, last = state.keyframes[-1], _last_pose(state)
    translation, rotation = _distance(keyframe.T_sub_cam, T_sub_cam)
    step_translation, step_rotation = _distance(last, T_sub_cam)
    return FrameStats(
        finite=bool(info.ok),
        known=float(info.after.known),
        since_keyframe=len(state.records) - keyframe.number,
        translation=translation,
        rotation=rotation,
        step_translation=step_translation,
        step_rotation=step_rotation,
    )


def _distance(T_a: Pose, T_b: Pose) -> tuple[float, float]:
    """Metres and radians between two poses."""
    cosine = (np.trace(T_a[:3, :3].T @ T_b[:3, :3]) - 1) / 2
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), float(np.arccos(np.clip(cosine, -1, 1)))


def _pose(state: SlamState, record: Record) -> Pose:
    return state.keyframes[record.keyframe].T_sub_cam @ record.T_keyframe_cam


def _last_pose(state: SlamState) -> Pose:
    return _pose(state, state.records[-1])


def _record(
    frame: Frame, keyframes: list[Keyframe], T_sub_cam: Pose, status: Status, info: FrameInfo
) -> Record:
    relative = np.linalg.inv(keyframes[-1].T_sub_cam) @ T_sub_cam
    return Record(frame.number, frame.timestamp, len(keyframes) - 1, relative, status, info)


def _keyframe(frame: Frame, number: int, T_sub_cam: Pose, cfg: Config, camera: Intrinsics) -> Keyframe:
    assert frame.depth is not None and frame.color is not None
    every = mapping_stride(camera, cfg)
    return Keyframe(
        number, frame.depth[::every, ::every].copy(), frame.color[::every, ::every].copy(), T_sub_cam
    )


def _info(info: tracking.TrackInfo, track_ms: float) -> FrameInfo:
    return FrameInfo(
        residual_before=float(info.before.residual),
        residual_after=float(info.after.residual),
        known=float(info.after.known),
        searched=bool(info.searched),
        track_ms=track_ms,
    )


def _rigid(T: Float[np.ndarray, "4 4"]) -> Pose:
    """The nearest rigid motion in double precision: products of single-precision rotations drift."""
    out = np.eye(4)
    u, _, vt = np.linalg.svd(T[:3, :3].astype(np.float64))
    out[:3, :3], out[:3, 3] = u @ vt, T[:3, 3]
    return out


def _key(cfg: Config, purpose: int, number: int) -> jax.Array:
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(cfg.seed), purpose), number)


def _ms(began: float) -> float:
    return 1e3 * (perf_counter() - began)
