"""How far submaps, and with them the camera, may be from where the map began, by the ways that lead there.

A submap hangs on the frame that it was begun at, and is as far off as that: what was loose of it stays loose for all
that is tracked from there on, however firmly frames are held in the new submap. A loop is another way, and the best one
counts. Ways are not averaged: they have frames in common, and what these are off by would seem to shrink.
"""

from __future__ import annotations

from collections import defaultdict
from typing import NamedTuple

import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core.rigid import inverse
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.links import best_link, linked_pairs, pair_of_ids
from mipsjax.submaps.state import Pose, SlamState, Submap
from mipsjax.uncertainty.held import NONE, OPEN, Matrix, carried, deviations

FIRST = SubmapId(0)
ANYWHERE = OPEN**2 * np.eye(6)
"""The covariance of a submap that hangs on nothing."""


class Step(NamedTuple):
    """From one submap to another."""

    to: SubmapId
    covariance: Matrix
    """What is added on the way there, in the frame of the first submap."""


def with_covariances(state: SlamState, cfg: Config) -> SlamState:
    """The state in which each submap says how far it may be off by the best of all ways, after frames that are shared
    have changed."""
    steps, known, waiting = _steps(state, cfg), {FIRST: NONE}, {FIRST}
    while waiting:
        # Of those that a way leads to, the nearest: no other way to it is better (Dijkstra 1959)
        here = min(waiting, key=lambda submap_id: _size(state, submap_id, known[submap_id]))
        waiting.remove(here)
        for step in steps[here]:
            way = known[here] + step.covariance
            if step.to not in known or (
                step.to in waiting and _size(state, step.to, way) < _size(state, step.to, known[step.to])
            ):
                known[step.to] = way
                waiting.add(step.to)
    for submap_id in state.submap_ids:
        state = state.with_submap(submap_id, covariance=known.get(submap_id, ANYWHERE))
    return state


def begun_at(state: SlamState, parent: SubmapId, covariance: Matrix) -> Matrix:
    """The covariance of a submap whose anchor is a frame of another one, from that of the frame's pose there."""
    return state.submaps[parent].covariance + carried(covariance, _in_first(state, parent))


def deviations_from_first(
    state: SlamState, submap_id: SubmapId, covariance: Matrix, T_sub_cam: Pose
) -> tuple[float, float]:
    """Standard deviations of where a camera is relative to the first submap, metres, and of how it is turned there,
    radians, from the covariance of its pose in its own submap."""
    return deviations(begun_at(state, submap_id, covariance), _in_first(state, submap_id) @ T_sub_cam)


def _steps(state: SlamState, cfg: Config) -> dict[SubmapId, list[Step]]:
    """All steps from each submap: to those that were begun from it or it from them, and, where loops are closed, to
    those that share a frame with it otherwise and were not found to be elsewhere."""
    weights = {pair_of_ids(loop.first, loop.second): loop.weight for loop in state.loops}
    steps = defaultdict[SubmapId, list[Step]](list)
    for first, second in linked_pairs(state):
        one, other = state.submaps[first], state.submaps[second]
        if other.parent == first:
            added = _begun(state, first, other)
        elif one.parent == second:
            added = _begun(state, second, one)
        # Only loops have a weight: any other pair counts as kept
        elif cfg.loop.enabled and weights.get((first, second), 1.0):
            added = _registered(state, first, second, cfg)
        else:
            continue
        steps[first].append(Step(second, added))
        steps[second].append(Step(first, added))
    return steps


def _begun(state: SlamState, parent: SubmapId, child: Submap) -> Matrix:
    """What a submap is off by relative to its parent: as much as its anchor was there."""
    return carried(state.submaps[parent].keyframe_of(child.anchor.id).covariance, _in_first(state, parent))


def _registered(state: SlamState, first: SubmapId, second: SubmapId, cfg: Config) -> Matrix:
    """The same of two submaps by a frame of one that was found in the other, where it did not drift."""
    link = best_link(state.submaps[first], state.submaps[second], False, cfg)
    assert link is not None
    own = np.repeat([cfg.loop.sigma, cfg.loop.sigma_rotation], 3) ** 2
    T_first_sub, T_first_other = _in_first(state, first), _in_first(state, second)
    found = carried(np.diag(own), T_first_sub @ link.first.T_sub_cam)
    tracked = carried(link.first.covariance, T_first_sub) + carried(link.second.covariance, T_first_other)
    return found + tracked


def _size(state: SlamState, submap_id: SubmapId, covariance: Matrix) -> float:
    """Of the covariance of a submap; a radian counts as a metre, as elsewhere."""
    return float(np.hypot(*deviations(covariance, _in_first(state, submap_id))))


def _in_first(state: SlamState, submap_id: SubmapId) -> Pose:
    """The pose of a submap in the first one: the world's origin may be any distance away."""
    return inverse(state.submaps[FIRST].T_world_sub) @ state.submaps[submap_id].T_world_sub
