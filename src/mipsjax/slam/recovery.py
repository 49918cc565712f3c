"""A lost camera: found again in the map, or a new submap that is joined when it is seen to overlap."""

from __future__ import annotations

from itertools import islice, takewhile
from typing import NamedTuple

import numpy as np

from mipsjax.config.sections import Config
from mipsjax.loops.registration import MIN_INLIERS
from mipsjax.submaps.astray import ANYWHERE
from mipsjax.submaps.bundle import nearest
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.recognition import recognise
from mipsjax.submaps.state import Keyframe, Pose, SlamState, Status, world_pose
from mipsjax.submaps.switching import FULL, NOT_FINITE, begin, full
from mipsjax.uncertainty.held import NONE, Matrix, carried

BLANK = "too bare to begin a submap, which nothing could join to the others"


class Relocation(NamedTuple):
    """Where a lost camera is: found again, or the anchor of a new submap."""

    state: SlamState
    """With the submap that knows what the frame sees; the active one is the one before."""
    submap: SubmapId
    """That submap."""
    keyframe: Keyframe
    """The nearest of its keyframes."""
    T_sub_cam: Pose
    covariance: Matrix
    """Of this pose."""
    begun: bool = False
    """The submap was begun with the frame: nothing knows how it lies to the others."""


def find_again(state: SlamState, keyframe: Keyframe, cfg: Config) -> Relocation | None:
    """The frame in any of the submaps, by its image; None where nothing fits."""
    found = recognise(state, keyframe, state.submap_ids, cfg)
    if found is None:
        return None
    return registered(state, found.submap, found.T_sub_cam, cfg)


def registered(state: SlamState, submap_id: SubmapId, T_sub_cam: Pose, cfg: Config) -> Relocation:
    """Where a frame is that was registered in a submap: it is as far off as the keyframe beside it and as registration
    itself may be."""
    (beside,) = nearest(state.submaps[submap_id].keyframes, T_sub_cam, 1)
    # In the order of a twist, shifts first
    own = np.repeat([cfg.loop.sigma, cfg.loop.sigma_rotation], 3) ** 2
    covariance = beside.covariance + carried(np.diag(own), T_sub_cam)
    return Relocation(state, submap_id, beside, T_sub_cam, covariance)


def lost_in_a_row(state: SlamState, enough: int) -> int:
    """Lost frames of this recording up to now, `enough` at most; skipped ones between them do not count."""
    of_this_one = islice(reversed(state.records), state.next_record - state.first)
    tracked = (r.status for r in of_this_one if r.status is not Status.SKIPPED)
    lost = takewhile(lambda status: status is Status.LOST, tracked)
    # No farther back than is asked for: a frame costs the same however many there were
    return sum(1 for _ in islice(lost, enough))


def start_anew(state: SlamState, keyframe: Keyframe, cfg: Config) -> tuple[Relocation | None, str]:
    """A submap that hangs on nothing, placed where the camera was seen last until a loop joins it to the others.

    None, and why, where it shows nothing to know it again by, where no other may begin, or where its first fit is not
    finite.
    """
    if keyframe.features is None or len(keyframe.features.p_cam) < MIN_INLIERS:
        return None, BLANK
    if full(state, cfg):
        return None, FULL
    last_seen = world_pose(state, state.records[-1])
    submap, ok = begin(keyframe, [], last_seen, cfg.map.submap_steps, state.camera, cfg)
    if not ok:
        return None, NOT_FINITE
    submap = submap._replace(covariance=ANYWHERE)
    state = state._replace(submaps=(*state.submaps, submap))
    return Relocation(state, state.submap_ids[-1], submap.anchor, np.eye(4), NONE, begun=True), ""
