"""A lost camera: found again in the map, or a new submap that is joined when it is seen to overlap."""

from __future__ import annotations

from itertools import takewhile
from typing import NamedTuple

import numpy as np

from mipsjax.closure import recognise
from mipsjax.config import Config
from mipsjax.host.held import NONE, Matrix, carried
from mipsjax.policy import Status
from mipsjax.state import Keyframe, Pose, SlamState, distance, world_pose
from mipsjax.territory import activated, begin


class Place(NamedTuple):
    """Where a lost camera is."""

    state: SlamState
    """With the submap that knows what the frame sees as the active one."""
    keyframe: int
    """The nearest of its keyframes."""
    T_sub_cam: Pose
    covariance: Matrix
    """Of this pose."""


def find_again(state: SlamState, keyframe: Keyframe, cfg: Config) -> Place | None:
    """The frame in any of the submaps, by its image; None where nothing fits."""
    found = recognise(state, keyframe, list(range(len(state.submaps))), cfg)
    if found is None:
        return None
    known = state.submaps[found.submap].keyframes
    nearest = min(range(len(known)), key=lambda i: sum(distance(known[i].T_sub_cam, found.T_sub_cam)))
    own = np.repeat([cfg.loop.sigma, cfg.loop.sigma_rotation], 3) ** 2
    covariance = known[nearest].covariance + carried(np.diag(own), found.T_sub_cam)
    return Place(activated(state, found.submap), nearest, found.T_sub_cam, covariance)


def lost_in_a_row(state: SlamState) -> int:
    """Lost frames up to now; skipped ones between them do not count."""
    tracked = (r.status for r in reversed(state.records) if r.status is not Status.SKIPPED)
    return sum(1 for _ in takewhile(lambda status: status is Status.LOST, tracked))


def start_anew(state: SlamState, keyframe: Keyframe, cfg: Config) -> Place:
    """A submap that hangs on nothing, placed where the camera was seen last until a loop joins it to the others."""
    last_seen = world_pose(state, state.records[-1])
    submap, _ = begin(keyframe, [], last_seen, cfg.map.submap_steps, state.camera, cfg)
    state = state._replace(submaps=(*state.submaps, submap))
    return Place(activated(state, len(state.submaps) - 1), 0, np.eye(4), NONE)
