"""A keyframe in submaps other than its own: where it should lie, where it is found, and the links proposed of that.

Nothing here changes the state. A proposal is a value; `submaps/closure.py` judges all of a frame together, and commits
those that it accepts.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core import tracking, volume
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import distance, inverse, rigid, transform
from mipsjax.submaps.bundle import mapping_camera, nearest, views_of
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.links import (
    Link,
    SubmapPair,
    best_link,
    chain,
    chain_distances,
    joined,
    linked_pairs,
    links,
    pair_of_ids,
)
from mipsjax.submaps.state import How, Keyframe, Pose, SlamState, Submap

REPEATS = 3
"""Times at most that registration is repeated: from 9 cm off the third moves a frame by millimetres."""
VIEWS = 8  # keyframes that say what a submap observed around a guess
STILL = 0.01  # metres, or as many times 1 rad: registration that moves a frame by less has ended


class Sighting(NamedTuple):
    """A frame found in a submap other than the one it was tracked in."""

    submap: SubmapId
    T_sub_cam: Pose
    inliers: float


class Expected(NamedTuple):
    """Where a frame lies in a submap, before it is looked for there."""

    T_sub_cam: Pose
    metres: float = float("inf")
    """Farthest from there that it may be found."""
    radians: float = float("inf")
    """The same, turned."""

    def agrees(self, T_sub_cam: Pose) -> bool:
        """Whether a pose is as near to this one as was expected."""
        metres, radians = distance(self.T_sub_cam, T_sub_cam)
        return metres <= self.metres and radians <= self.radians


class Proposal(NamedTuple):
    """A link that may be made: a keyframe of one submap was found in another."""

    first: SubmapId
    """The submap that the keyframe was tracked in."""
    second: SubmapId
    """The submap that it was found in."""
    link: Link
    """The keyframe as the first has it, and as the second would."""
    inliers: float
    """Share of the frame's pixels that fit the second submap, of those it knows."""
    how: How

    @property
    def pair(self) -> SubmapPair:
        """The submaps that would be linked."""
        return pair_of_ids(self.first, self.second)


def proposed(state: SlamState, first: SubmapId, keyframe: Keyframe, sighting: Sighting, how: How) -> Proposal:
    """The proposal to link a keyframe of the submap `first` with the submap that it was found in."""
    (beside,) = nearest(state.submaps[sighting.submap].keyframes, sighting.T_sub_cam, 1)
    # What registration itself may be off by is `loop.sigma`, which each factor has
    there = keyframe._replace(T_sub_cam=sighting.T_sub_cam, covariance=beside.covariance)
    return Proposal(first, sighting.submap, Link(keyframe, there), sighting.inliers, how)


def with_links(state: SlamState, proposals: Sequence[Proposal]) -> SlamState:
    """The state as it would be with all of these links."""
    for proposal in proposals:
        known = state.submaps[proposal.second].keyframes
        state = state.with_submap(proposal.second, keyframes=(*known, proposal.link.second))
    return state


def loop_candidates(state: SlamState, submap_id: SubmapId, cfg: Config) -> list[SubmapId]:
    """The submaps with which a link would close a loop: far away along the chain, and not linked yet."""
    away, linked = chain_distances(state, submap_id), set(linked_pairs(state))
    return [
        other
        for other in state.submap_ids
        if away[other] >= cfg.loop.apart and pair_of_ids(submap_id, other) not in linked
    ]


def by_box(state: SlamState, cfg: Config) -> list[Proposal]:
    """The newest keyframe of the active submap in the submaps whose box holds enough of its view, where it fits.

    It is looked for only where it is known how the submaps lie: where the camera had been lost, boxes mean nothing.
    """
    keyframe = state.submap.keyframes[-1]
    p_cam, mask = volume.seen(keyframe.depth, mapping_camera(state.camera, cfg), cfg.volume)
    proposals, near = list[Proposal](), joined(state, state.active)
    candidate = state
    for submap_id in state.submap_ids:
        if submap_id == state.active or submap_id not in near:
            continue
        # With the links proposed so far: one with a submap on the way says more exactly what has drifted
        expected = expect(candidate, submap_id, cfg)
        box = state.submaps[submap_id].box
        inside = volume.contained(box, transform(expected.T_sub_cam, p_cam), mask)
        if inside < cfg.loop.overlap:
            continue
        sighting = sight(state, submap_id, keyframe, expected, cfg)
        if sighting is not None:
            proposal = proposed(state, state.active, keyframe, sighting, How.BOX)
            candidate = with_links(candidate, [proposal])
            proposals.append(proposal)
    return proposals


def expect(state: SlamState, submap_id: SubmapId, cfg: Config) -> Expected:
    """Where the newest keyframe of the active submap lies in another submap.

    Near along the chain the nearest frame that both share says so, up to what tracking may have drifted since: one
    found elsewhere has slid along surfaces that hardly hold it, or turned towards what the submap has never seen. Where
    none is shared, the poses of the submaps say so, up to what may have drifted on the way through those between.
    Across a loop they may be off by any amount.
    """
    keyframe, other, loop = state.submap.keyframes[-1], state.submaps[submap_id], cfg.loop
    way = chain(state, state.active, submap_id)
    by_submaps = inverse(other.T_world_sub) @ state.submap.T_world_sub @ keyframe.T_sub_cam
    # Empty where they were begun apart; longer where a link would close a loop
    if not 0 < len(way) <= loop.apart:
        return Expected(by_submaps)
    shared = links(other, state.submap)
    if not shared:
        passed = [best_link(state.submaps[a], state.submaps[b], True, cfg) for a, b in pairwise(way)]
        reach = sum(float("inf") if link is None else link.reach for link in passed)
        metres = float(np.linalg.norm(keyframe.T_sub_cam[:3, 3])) + reach
        return Expected(by_submaps, *_drifted(metres, cfg))
    away = [distance(link.second.T_sub_cam, keyframe.T_sub_cam)[0] for link in shared]
    closest = min(range(len(shared)), key=away.__getitem__)
    T_sub_cam = shared[closest].T_first_second @ keyframe.T_sub_cam
    return Expected(T_sub_cam, *_drifted(away[closest], cfg))


def _drifted(metres: float, cfg: Config) -> tuple[float, float]:
    """Metres and radians by which a registered frame may be from where it is expected, after a way."""
    loop = cfg.loop
    return loop.sigma + loop.drift * metres, loop.sigma_rotation + loop.drift_rotation * metres


def sight(
    state: SlamState,
    submap_id: SubmapId,
    keyframe: Keyframe,
    expected: Expected,
    cfg: Config,
    measured: bool = False,
) -> Sighting | None:
    """The frame in a submap; None where it does not fit what the submap knows, or not where it was expected.

    Unless that was `measured`, as by image features, the surfaces must hold the frame in every direction.
    """
    loop = cfg.loop
    found = _registered(state.submaps[submap_id], keyframe, expected.T_sub_cam, state.camera, cfg)
    fits = found.overlap >= loop.overlap and found.inliers >= loop.inliers
    if not measured:
        fits = fits and found.held >= loop.held
    if not (np.isfinite(found.T_sub_cam).all() and fits):
        return None
    T_sub_cam = rigid(found.T_sub_cam)
    return Sighting(submap_id, T_sub_cam, float(found.inliers)) if expected.agrees(T_sub_cam) else None


def _registered(submap: Submap, keyframe: Keyframe, guess: Pose, camera: Intrinsics, cfg: Config) -> Any:
    """The frame registered in the submap, on the host. It is registered again from where it ended, while that moves it:
    across a loop the guess may be decimetres off."""
    small, depth = mapping_camera(camera, cfg), jnp.asarray(keyframe.depth)
    views = views_of(nearest(submap.keyframes, guess, VIEWS))

    def register(T_sub_cam: Pose) -> Any:
        start = jnp.asarray(T_sub_cam, jnp.float32)
        return jax.device_get(tracking.register(submap.learned.field, depth, start, small, cfg, views))

    found = register(guess)
    for _ in range(REPEATS):
        if max(distance(guess, found.T_sub_cam)) < STILL:
            break
        guess, found = found.T_sub_cam, register(found.T_sub_cam)
    return found
