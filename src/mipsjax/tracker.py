"""One frame in the active submap: where it is, by what, and how far that may be off."""

from __future__ import annotations

from time import perf_counter
from typing import NamedTuple

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from mipsjax.bundle import TRACK, nearest, random_key, views_of
from mipsjax.config import Config
from mipsjax.core import tracking
from mipsjax.data.sequence import Frame
from mipsjax.host.held import NONE, Directions, Held, Matrix, directions, held
from mipsjax.landmarks import Seen, follow_all, landmarks
from mipsjax.policy import Status, converged, widening
from mipsjax.state import Keyframe, Pose, Record, SlamState, distance, last_pose, rigid

DT_MIN = 1e-3  # seconds; two stamps nearer than this count as this far apart
DT_RATIO_MAX = 5.0  # a gap longer than this many intervals is not extrapolated further


class Tracked(NamedTuple):
    """What tracking says of a frame."""

    T_sub_cam: Pose
    info: tracking.TrackInfo
    found: list[Seen]
    """Corners of earlier frames."""
    surfaces: Directions
    """How firmly surfaces hold it."""
    together: Directions
    """The same with corners of the image."""
    held: Held
    ms: float


def track(state: SlamState, frame: Frame, cfg: Config) -> Tracked:
    """A frame with depth, from where its corners or the motion before it say that it is."""
    assert frame.depth is not None
    began = perf_counter()
    color = np.zeros((*frame.depth.shape, 3), np.uint8) if frame.color is None else frame.color
    candidates, near, known = _candidates(state, frame.timestamp), _near(state, cfg), cfg.track.go.known
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
        views_of([near[round(i)] for i in np.linspace(0, len(near) - 1, cfg.track.go.views)]),
        np.float32(converged(state.residual, cfg)),
        landmarks(found, state.camera, cfg),
        views_of(nearest(state.submap.keyframes, candidates[0], known)) if known else None,
    )
    T, info = jax.device_get((T, info))
    T_sub_cam = rigid(T)
    surfaces, corners = (part.astype(np.float64) / cfg.track.held.group for part in info.information)
    reference = min((keyframe.covariance for keyframe in near), key=np.trace)
    return Tracked(
        T_sub_cam,
        info,
        found,
        directions(surfaces),
        directions(surfaces + corners),
        _held(state, frame, T_sub_cam, surfaces + corners, reference, cfg),
        1e3 * (perf_counter() - began),
    )


def coasting(state: SlamState, frame: Frame, cfg: Config) -> Held:
    """How far a frame may be off that nothing is measured of."""
    last = state.records[-1].held
    return _held(state, frame, last_pose(state), NONE, last.covariance, cfg)


def _held(
    state: SlamState, frame: Frame, T_sub_cam: Pose, information: Matrix, reference: Matrix, cfg: Config
) -> Held:
    last = state.records[-1]
    seconds = max(frame.timestamp - last.timestamp, DT_MIN)
    return held(reference, last.held, T_sub_cam, information, seconds, cfg.track.held)


def _near(state: SlamState, cfg: Config) -> list[Keyframe]:
    """Keyframes near the last pose, in the order of their list, which begins with the anchor."""
    last, go, submap = last_pose(state), cfg.track.go, state.submap
    near = [
        keyframe
        for keyframe in submap.keyframes
        if np.all(np.less(distance(keyframe.T_sub_cam, last), (go.view_translation, go.view_rotation)))
    ]
    return near or [submap.keyframes[submap.newest]]


def _candidates(state: SlamState, timestamp: float) -> list[Pose]:
    """Constant velocity over the real time since the last trusted frame, and no motion; the expected one first.

    Over a longer time than velocity is carried on for, it says nothing, and no motion comes first.
    """
    last = last_pose(state)
    if state.motion is None:
        return [last, last]
    ratio = (timestamp - last_trusted(state).timestamp) / max(state.motion.seconds, DT_MIN)
    moved = last @ _scaled(state.motion.T_older_newer, min(max(ratio, 0.0), DT_RATIO_MAX))
    return [moved, last] if ratio <= DT_RATIO_MAX else [last, moved]


def last_trusted(state: SlamState) -> Record:
    """The newest frame whose pose was measured."""
    return next(r for r in reversed(state.records) if r.status in (Status.OK, Status.WEAK))


def _scaled(motion: Pose, ratio: float) -> Pose:
    scaled = np.eye(4)
    scaled[:3, :3] = Rotation.from_rotvec(
        ratio * Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    ).as_matrix()
    scaled[:3, 3] = ratio * motion[:3, 3]
    return scaled
