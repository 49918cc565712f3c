"""One frame in the active submap: where it is, by what, and how far that may be off."""

from __future__ import annotations

from time import perf_counter
from typing import NamedTuple

import jax
import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core import tracking
from mipsjax.core.rigid import distance, from_twist, rigid, to_twist
from mipsjax.data.sequence import Frame
from mipsjax.images.corners import Corners
from mipsjax.slam.landmarks import Seen, corners_of, follow_all, images_of, landmarks, placed
from mipsjax.slam.moving import Found, in_free_space, without_moving
from mipsjax.slam.policy import converged, widening
from mipsjax.submaps.astray import ANYWHERE
from mipsjax.submaps.bundle import nearest, views_of
from mipsjax.submaps.chance import Purpose, key_for
from mipsjax.submaps.state import (
    Keyframe,
    Pose,
    Record,
    SlamState,
    deviations_of,
    last_pose,
    last_trusted,
)
from mipsjax.uncertainty.held import (
    NONE,
    Directions,
    Gains,
    Held,
    Matrix,
    at,
    directions,
    gains,
    held,
    predicted,
)
from mipsjax.uncertainty.trust import ALLOWED_TRACKED, Differing, differing, trusted

DT_MIN = 1e-3  # seconds; two stamps nearer than this count as this far apart
DT_RATIO_MAX = 5.0  # a gap longer than this many intervals is not extrapolated further


class Tracked(NamedTuple):
    """What tracking says of a frame."""

    frame: Frame
    """Without depth where something moves."""
    T_sub_cam: Pose
    T_as_moved: Pose
    """Where its motion led; the pose itself but for what measurements leave loose."""
    info: tracking.TrackInfo
    found: list[Seen]
    """Corners of earlier frames that it shows."""
    corners: Corners | None
    """Those of the frame itself; None without colour, or where neither corners nor brightness are wanted."""
    surfaces: Directions
    """How firmly surfaces hold it."""
    together: Directions
    """The same with corners of the image and brightness."""
    doubt: Differing | None
    """How colour differs from surfaces; None where one of both does not hold the frame."""
    held: Held
    moving: float = 0.0
    """Share of its depth that was left out."""
    ms: float = 0.0


def track(state: SlamState, frame: Frame, cfg: Config) -> Tracked:
    """A frame with depth, from where its corners or the motion before it say that it is; once more, without what moves,
    where something does."""
    began = perf_counter()
    tracked, found = _tracked(state, frame, cfg)
    still, moving = without_moving(frame, found, cfg)
    if moving:
        tracked, _ = _tracked(state, still, cfg)
    return tracked._replace(moving=moving, ms=1e3 * (perf_counter() - began))


def _tracked(state: SlamState, frame: Frame, cfg: Config) -> tuple[Tracked, Found | None]:
    """A frame as if all stood still, and where it shows that something does not."""
    assert frame.depth is not None
    # Compiled code takes an image in any case; a black one that stands for none counts for nothing
    color = np.zeros((*frame.depth.shape, 3), np.uint8) if frame.color is None else frame.color
    candidates, near = _candidates(state, frame.timestamp), _near(state, cfg)
    earlier = 1 + cfg.track.corners.keyframes
    trust = 0.0 if frame.color is None else trusted(state.doubts, ALLOWED_TRACKED)
    T_as_before = candidates[0]
    found = follow_all(state, frame, T_as_before, cfg)
    if found:
        # What was measured between two images is a better guess than that the camera has gone on as before
        candidates = [found[0].T_sub_cam, candidates[0]]
    known = views_of(nearest(state.submap.keyframes, candidates[0], cfg.track.go.known))
    T, info = tracking.track(
        state.submap.learned.field,
        frame.depth,
        color,
        np.stack(candidates).astype(np.float32),
        np.float32(widening(state.frames_in_trouble, cfg)),
        key_for(cfg, Purpose.TRACK, state.next_record),
        state.camera,
        cfg,
        # Evenly over the list: its first is the anchor while that is near, and the pose of that is exact
        views_of([near[round(i)] for i in np.linspace(0, len(near) - 1, cfg.track.go.views)]),
        np.float32(converged(state.residual, cfg)),
        landmarks(found, earlier, state.camera, cfg),
        known,
        images_of([] if frame.color is None else placed(state, cfg), earlier, state.camera, cfg),
        np.float32(trust),
    )
    # JAX computes the pose and what moves meanwhile: nothing waits for them before device_get
    free = in_free_space(frame, T, known, state.camera, cfg)
    corners = corners_of(frame, len(state.records), state.camera, cfg)
    T, info = jax.device_get((T, info))
    surfaces, colour = _information(info, cfg)
    information, found_at = surfaces + trust * colour, rigid(T)
    reference, together = _reference(state, near, found, cfg), directions(information)
    expected = _predicted(reference, state.records[-1], frame, found_at, cfg)
    gain = gains(reference, expected, found_at, information)
    T_sub_cam, T_as_moved = _believed(found_at, T_as_before, together, gain, cfg)
    tracked = Tracked(
        frame,
        T_sub_cam,
        T_as_moved,
        info,
        found,
        corners,
        directions(surfaces),
        together,
        differing(info.information.to_surfaces - info.information.to_colour, surfaces, colour),
        held(reference, expected, T_sub_cam, information),
    )
    return tracked, free


def coasting(state: SlamState, frame: Frame, cfg: Config) -> Held:
    """How far a frame may be off that nothing is measured of, and that is taken to be where the last one was."""
    last, T_sub_cam = state.records[-1], last_pose(state)
    if not state.located:
        return at(ANYWHERE, T_sub_cam)
    if last.status.trusted:
        # Its motion is forgotten: a frame that is taken to stand still says nothing of one
        last = last._replace(held=at(last.held.covariance, T_sub_cam))
    return _predicted(None, last, frame, T_sub_cam, cfg)


def _predicted(reference: Matrix | None, last: Record, frame: Frame, T_sub_cam: Pose, cfg: Config) -> Held:
    seconds = max(frame.timestamp - last.timestamp, DT_MIN)
    return predicted(reference, last.held, T_sub_cam, seconds, cfg.track.held)


def _reference(state: SlamState, near: list[Keyframe], found: list[Seen], cfg: Config) -> Matrix | None:
    """What the pose is off by that a frame is measured against: that of the best known keyframe nearby; None for the
    frame before.

    Where the camera may be farther off than `track.held.unsure`, a keyframe that seems near may be elsewhere, unless
    the frame shows its corners; then what the frame fits is what the map has learned of the one before, a moment ago.
    """
    known = last_trusted(state)
    metres, _ = deviations_of(state, known)
    if metres <= cfg.track.held.unsure:
        # By the trace, a radian as much as a metre, as elsewhere
        return min((keyframe.covariance for keyframe in near), key=np.trace)
    seen = {one.reference.record for one in found}
    shown = [keyframe.covariance for keyframe in state.submap.keyframes if keyframe.id in seen]
    if shown:
        return min(shown, key=np.trace)
    # After a gap nothing was learned since the last frame that is known
    return None if known is state.records[-1] else known.held.covariance


def _information(info: tracking.TrackInfo, cfg: Config) -> tuple[Matrix, Matrix]:
    """Of surfaces and of colour, as if those that err together were one; none of a frame that is not finite."""
    wanted = cfg.track.held
    found = info.information
    surfaces = np.asarray(found.surfaces, np.float64) / wanted.points
    colour = np.asarray(found.corners, np.float64) / wanted.corners
    colour = colour + np.asarray(found.brightness, np.float64) / wanted.brightness
    surfaces, colour = (part if np.isfinite(part).all() else NONE for part in (surfaces, colour))
    return surfaces, colour


def _believed(
    T_found: Pose, T_as_before: Pose, together: Directions, gain: Gains, cfg: Config
) -> tuple[Pose, Pose]:
    """Where the frame is, and where its motion led: as found, but along directions that measurements leave loose, where
    both are means of what was found and of where the motion before led, by the gain."""
    motion = np.linalg.inv(T_as_before) @ T_found
    # To first order a twist: what is left loose is a shift, or a small turn
    surprise = to_twist(motion)
    loose = together.twist[together.deviation > cfg.track.held.loose]

    def moved(share):
        twist = loose.T @ (loose @ (share @ surprise - surprise))
        return T_found @ from_twist(twist)

    return (moved(gain.pose), moved(gain.motion)) if len(loose) else (T_found, T_found)


def _near(state: SlamState, cfg: Config) -> list[Keyframe]:
    """Keyframes near the last pose, in the order of their list, which begins with the anchor."""
    last, go, submap = last_pose(state), cfg.track.go, state.submap
    near = [
        keyframe
        for keyframe in submap.keyframes
        if np.all(np.less(distance(keyframe.T_sub_cam, last), (go.view_translation, go.view_rotation)))
    ]
    return near or [submap.newest]


def _candidates(state: SlamState, timestamp: float) -> list[Pose]:
    """Constant velocity over the real time since the last trusted frame, and no motion; the expected one first.

    Over a longer time than velocity is carried on for, it says nothing, and no motion comes first.
    """
    last = last_pose(state)
    if state.motion is None:
        return [last, last]
    ratio = (timestamp - last_trusted(state).timestamp) / max(state.motion.seconds, DT_MIN)
    further = min(max(ratio, 0.0), DT_RATIO_MAX) * to_twist(state.motion.T_older_newer)
    moved = last @ from_twist(further)
    return [moved, last] if ratio <= DT_RATIO_MAX else [last, moved]
