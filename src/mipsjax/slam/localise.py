"""Other recordings in a map that was learned before: from which the map goes on growing, or which only ask it."""

from __future__ import annotations

from mipsjax.config.sections import Config
from mipsjax.core import volume
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import inverse, transform
from mipsjax.data.checked import checked_frame
from mipsjax.data.sequence import Frame
from mipsjax.errors import InputError
from mipsjax.slam.info import FrameInfo, info_of
from mipsjax.slam.outcome import (
    NOT_FOUND_YET,
    coasted,
    few,
    joined_notes,
    keyframe_of_lost,
    moved_on,
    relocated,
    stats_of,
    trusted_record,
)
from mipsjax.slam.policy import decide
from mipsjax.slam.recovery import find_again, registered
from mipsjax.slam.tracker import Tracked, track
from mipsjax.submaps.astray import deviations_from_first
from mipsjax.submaps.bundle import make_keyframe, mapping_camera
from mipsjax.submaps.proposals import by_box
from mipsjax.submaps.state import Keyframe, SlamState, Status, last_pose, pose_of
from mipsjax.submaps.switching import govern
from mipsjax.uncertainty.held import at

SAME_PX = 1e-3
"""Pixels by which intrinsics may differ that are of one camera."""


def continued(state: SlamState, camera: Intrinsics) -> SlamState:
    """The state of a map in which another recording begins: nothing is known of where its camera is.

    `step` and `localise` look for its first frames in the whole map, by their images. All poses are in the world of the
    recording that the map began with.

    Raises:
        InputError: the recording is of another camera, its images have another size, or the map has no features by
            which it could be found in it.
    """
    if any(abs(own - other) > SAME_PX for own, other in zip(state.camera, camera, strict=True)):
        raise InputError(
            f"the map was learned with the camera {_described(state.camera)}, this recording has {_described(camera)}: "
            "only recordings of one camera and one size of images go on in a map"
        )
    if not any(keyframe.features for submap in state.submaps for keyframe in submap.keyframes):
        raise InputError(
            "the map was learned without image features, by which a camera is found in it: learn it anew with "
            "--loop.relocalise"
        )
    return state._replace(
        first=state.next_record,
        older_loops=len(state.loops),
        motion=None,
        corners=(),
        doubts=(),
        frames_in_trouble=1,
        refinement=None,
        good=None,
    )


def _described(camera: Intrinsics) -> str:
    fx, fy, cx, cy, width, height = camera
    return f"fx {fx:g} fy {fy:g} cx {cx:g} cy {cy:g} at {width} x {height}"


def localise(state: SlamState, frame: Frame, cfg: Config) -> tuple[SlamState, FrameInfo]:
    """Where a frame is in a map, of which nothing changes: `step` without anything that learns.

    Returns the state after it, which has one more record, and what there is to say about the frame.
    """
    state, info = _localised(state, checked_frame(frame, state.camera), cfg)
    newest = state.records[-1]
    metres, _ = deviations_from_first(state, newest.submap, newest.held.covariance, pose_of(state, newest))
    return state, info._replace(world_deviation_m=metres)


def _localised(state: SlamState, frame: Frame, cfg: Config) -> tuple[SlamState, FrameInfo]:
    """The state after a frame that was checked."""
    if frame.depth is None or not frame.depth.any():
        return coasted(state, frame, frame.problem or "no depth", Status.SKIPPED, cfg)
    if not state.located:
        return _looked_for(state, frame, NOT_FOUND_YET, None, cfg)
    tracked = track(state, frame, cfg)
    stats = stats_of(state, tracked, cfg)
    decision = decide(stats, cfg)
    if decision.status is Status.LOST:
        return _looked_for(state, frame, stats.said, tracked, cfg)
    info = info_of(tracked)._replace(submap=state.active, note=frame.problem)
    record = trusted_record(tracked.frame, state, tracked, tracked.T_sub_cam, decision.status)
    in_trouble = state.frames_in_trouble + 1 if decision.in_trouble else 0
    after = state.with_record(record)._replace(frames_in_trouble=in_trouble)
    if not decision.informative:
        return after, info._replace(note=joined_notes(info.note, few(stats.measured)))
    after = _handed_over(moved_on(after, state, tracked, stats.residual, cfg), tracked.frame, cfg)
    return after, info._replace(submap=after.active)


def _looked_for(
    state: SlamState, frame: Frame, note: str, tracked: Tracked | None, cfg: Config
) -> tuple[SlamState, FrameInfo]:
    """A lost frame: looked for in the whole map by its image, set aside where it is not found."""
    found = None
    # However else could it be found at first?
    if (cfg.loop.relocalise or not state.located) and frame.color is not None:
        found = find_again(state, keyframe_of_lost(state, frame, tracked, cfg), cfg)
    if found is None:
        return coasted(state, frame, note, Status.LOST, cfg, tracked)
    return relocated(state._replace(active=found.submap, good=None), frame, found, tracked)


def _handed_over(state: SlamState, frame: Frame, cfg: Config) -> SlamState:
    """The state in which another submap has the camera, where it knows more of what the last frame sees.

    By the rules that `step` goes by, asked of a state in which the frame is a keyframe, which is then forgotten.
    """
    if frame.color is None:
        return state
    seen = make_keyframe(frame, state.next_record, last_pose(state), cfg, state.camera)
    if _contained(state, seen, cfg) >= cfg.volume.overlap:
        return state
    asked = state.with_submap(state.active, keyframes=(*state.submap.keyframes, seen))
    proposals = by_box(asked, cfg)
    chosen = govern(asked, proposals, cfg)
    proposal = next((one for one in proposals if one.second == chosen), None)
    if proposal is None:
        return state
    found = registered(state, chosen, proposal.link.second.T_sub_cam, cfg)
    T_keyframe_cam = inverse(found.keyframe.T_sub_cam) @ found.T_sub_cam
    last = state.records[-1]._replace(
        submap=chosen,
        keyframe=found.keyframe.id,
        T_keyframe_cam=T_keyframe_cam,
        held=at(found.covariance, found.T_sub_cam),
    )
    return state._replace(active=chosen, good=None, records=state.records.with_last(last))


def _contained(state: SlamState, keyframe: Keyframe, cfg: Config) -> float:
    """Share of what a frame sees that lies in the box of the active submap."""
    p_cam, mask = volume.seen(keyframe.depth, mapping_camera(state.camera, cfg), cfg.volume)
    return volume.contained(state.submap.box, transform(keyframe.T_sub_cam, p_cam), mask)
