"""Earlier frames in the current one: where their corners say that the camera is, and what their images add."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.core.evidence import Landmarks
from mipsjax.core.photometric import Images
from mipsjax.core.rigid import inverse, transform
from mipsjax.data.sequence import Frame
from mipsjax.images.corners import Corners, corners, decimated, grey_of
from mipsjax.images.following import Followed, follow
from mipsjax.submaps.links import best_link
from mipsjax.submaps.state import Pose, SlamState, pose_of


class Seen(NamedTuple):
    """Corners of one earlier frame that were found again."""

    reference: Corners
    T_sub_ref: Pose
    """Pose of that frame."""
    followed: Followed

    @property
    def T_sub_cam(self) -> Pose:
        """The current pose by these corners alone."""
        return self.T_sub_ref @ self.followed.T_ref_cam


def follow_all(state: SlamState, frame: Frame, expected: Pose, cfg: Config) -> list[Seen]:
    """Corners of the last trusted frame and of keyframes, as far as they are found; none without colour.

    `expected` is the pose at which the first are looked for. The others are looked for where the ones before say, which
    is mostly within a pixel or two.
    """
    if frame.color is None or not state.corners:
        return []
    grey, found = grey_of(frame.color), list[Seen]()
    for reference, T_sub_ref in placed(state, cfg):
        guess = inverse(T_sub_ref) @ expected
        followed = follow(reference, grey, guess, cfg.track.corners.fewest, state.camera, near=bool(found))
        if followed is None:
            continue
        found.append(Seen(reference, T_sub_ref, followed))
        expected = found[-1].T_sub_cam
    return found


def placed(state: SlamState, cfg: Config) -> list[tuple[Corners, Pose]]:
    """Earlier frames of which corners are kept, with their poses in the active submap as far as these are known."""
    poses = [_pose(state, reference, cfg) for reference in state.corners]
    return [(reference, T) for reference, T in zip(state.corners, poses, strict=True) if T is not None]


def _pose(state: SlamState, reference: Corners, cfg: Config) -> Pose | None:
    """Of an earlier frame in the active submap; None where it is not known to a hair.

    It is in a submap, and in the one that was begun from it or that it was begun from: tracking went from one into the
    other. How others lie is known only as well as loops say.
    """
    record, active = state.records[reference.record], state.active
    if record.submap == active:
        return pose_of(state, record)
    other = state.submaps[record.submap]
    if state.submap.parent != record.submap and other.parent != active:
        return None
    # By the shared frame that is nearest to both anchors: the pose graph moves submaps, not what they have learned
    between = best_link(state.submap, other, True, cfg)
    return None if between is None else between.T_first_second @ pose_of(state, record)


def landmarks(found: list[Seen], frames: int, camera: Intrinsics, cfg: Config) -> Landmarks | None:
    """Corners of at most so many frames, filled up to a fixed number; None where the configuration wants no corners."""
    size = frames * cfg.track.corners.count
    if not size:
        return None
    p_sub, ray = np.zeros((size, 3), np.float32), np.zeros((size, 2), np.float32)
    axes, mask = np.zeros((size, 2, 2), np.float32), np.zeros(size, bool)
    begin = 0
    for seen in found:
        # A map may have been learned with more of them
        strongest = slice(0, cfg.track.corners.count)
        pixel = seen.followed.pixel[strongest]
        end = begin + len(pixel)
        p_sub[begin:end] = transform(seen.T_sub_ref, seen.followed.p_ref[strongest])
        ray[begin:end] = (pixel - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        axes[begin:end] = seen.followed.axes[strongest]
        mask[begin:end] = True
        begin = end
    return Landmarks(*(jnp.asarray(part) for part in (p_sub, ray, axes, mask)))


def images_of(
    frames: list[tuple[Corners, Pose]], size: int, camera: Intrinsics, cfg: Config
) -> Images | None:
    """How frames looked at these poses, again from the first up to a fixed number; None where they are not wanted."""
    if not cfg.track.brightness.weight:
        return None
    small = decimated(camera)
    grey = np.zeros((size, camera.height, camera.width), np.uint8)
    depth = np.zeros((size, small.height, small.width), np.float32)
    T_sub_cam, mask = np.tile(np.eye(4, dtype=np.float32), (size, 1, 1)), np.full(size, bool(frames))
    for i in range(size if frames else 0):
        reference, T_sub_cam[i] = frames[i % len(frames)]
        grey[i], depth[i] = reference.grey, reference.depth
    return Images(*(jnp.asarray(part) for part in (grey, depth, T_sub_cam, mask)))


def corners_of(frame: Frame, record: int, camera: Intrinsics, cfg: Config) -> Corners | None:
    """Of one frame, without any where only brightness is wanted; None without colour or depth, or where neither is."""
    count = cfg.track.corners.count
    wanted = count or cfg.track.brightness.weight
    if not wanted or frame.color is None or frame.depth is None:
        return None
    return corners(grey_of(frame.color), frame.depth, record, count, camera)


def with_corners(state: SlamState, newest: Corners | None, found: list[Seen], cfg: Config) -> SlamState:
    """With `newest`, the corners of the last frame, a trusted one, and with those of keyframes among the ones kept so
    far; as it was where `newest` is None.

    `found` are the earlier frames that the last one showed. The newest keyframe is kept, and of the others the oldest,
    as long as they are seen: the longer a corner is followed, the less the camera drifts.
    """
    if newest is None:
        return state
    wanted = cfg.track.corners
    seen = {one.reference.record for one in found}
    keyframes = [old for old in state.corners if state.records[old.record].is_keyframe]
    # Newest first. A frame that shows none at all, as in the dark, does not say which are out of sight
    kept = keyframes[:1] + [old for old in keyframes[1:] if not seen or old.record in seen]
    if len(kept) > wanted.keyframes:
        kept = kept[: min(1, wanted.keyframes)] + kept[len(kept) - wanted.keyframes + 1 :]
    return state._replace(corners=(newest, *kept))
