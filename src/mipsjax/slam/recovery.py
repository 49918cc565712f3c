"""A lost camera: found again in the map, or a new submap that is joined when it is seen to overlap."""

from __future__ import annotations

from itertools import islice, takewhile
from typing import NamedTuple

import numpy as np

from mipsjax.config.sections import Config
from mipsjax.submaps.astray import ANYWHERE
from mipsjax.submaps.bundle import nearest
from mipsjax.submaps.recognition import recognise
from mipsjax.submaps.state import Keyframe, Pose, SlamState, Status, world_pose
from mipsjax.submaps.switching import activated, begin
from mipsjax.uncertainty.held import NONE, Matrix, carried


class Relocation(NamedTuple):
    """Where a lost camera is: found again, or the anchor of a new submap."""

    state: SlamState
    """With the submap that knows what the frame sees as the active one."""
    keyframe: Keyframe
    """The nearest of its keyframes."""
    T_sub_cam: Pose
    covariance: Matrix
    """Of this pose."""


def find_again(state: SlamState, keyframe: Keyframe, cfg: Config) -> Relocation | None:
    """The frame in any of the submaps, by its image; None where nothing fits."""
    found = recognise(state, keyframe, state.submap_ids, cfg)
    if found is None:
        return None
    known = state.submaps[found.submap].keyframes
    (beside,) = nearest(known, found.T_sub_cam, 1)
    # In the order of a twist, shifts first: what registration may be off by beside the keyframe
    own = np.repeat([cfg.loop.sigma, cfg.loop.sigma_rotation], 3) ** 2
    covariance = beside.covariance + carried(np.diag(own), found.T_sub_cam)
    return Relocation(activated(state, found.submap), beside, found.T_sub_cam, covariance)


def lost_in_a_row(state: SlamState, enough: int) -> int:
    """Lost frames up to now, `enough` at most; skipped ones between them do not count."""
    tracked = (r.status for r in reversed(state.records) if r.status is not Status.SKIPPED)
    lost = takewhile(lambda status: status is Status.LOST, tracked)
    # No farther back than is asked for: a frame costs the same however many there were
    return sum(1 for _ in islice(lost, enough))


def start_anew(state: SlamState, keyframe: Keyframe, cfg: Config) -> Relocation | None:
    """A submap that hangs on nothing, placed where the camera was seen last until a loop joins it to the others; None
    where its first fit is not finite."""
    last_seen = world_pose(state, state.records[-1])
    submap, ok = begin(keyframe, [], last_seen, cfg.map.submap_steps, state.camera, cfg)
    if not ok:
        return None
    submap = submap._replace(covariance=ANYWHERE)
    state = state._replace(submaps=(*state.submaps, submap))
    return Relocation(activated(state, state.submap_ids[-1]), submap.anchor, np.eye(4), NONE)
