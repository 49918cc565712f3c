"""Loops: finding a known place again, and moving the submaps so that it is one place (Section 3.5 of the paper)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mipsjax import surfaces
from mipsjax.bundle import MATCH
from mipsjax.config import Config
from mipsjax.host.factors import Factor
from mipsjax.host.features import Features, similar
from mipsjax.host.registration import Match, relative_pose
from mipsjax.links import Link, chain_distances, linked_pairs, links, misfit, unlinked
from mipsjax.state import How, Keyframe, Loop, Pose, SlamState, distance, last_pose
from mipsjax.surfaces import pair_of, plane_factor, pose_factor
from mipsjax.territory import Expected, Sighting, link, sight

LOOKED_UP = 3  # keyframes after the last frame that may join a pair of submaps
DEVIATIONS = 3.0  # standard deviations of a pose from features by which the field may correct it


def prepare(state: SlamState, cfg: Config) -> None:
    """Compiles, on the first submap alone, what the first meeting of two submaps will need."""
    sight(state, 0, state.submap.keyframes[0], Expected(np.eye(4)), cfg)
    if cfg.loop.enabled:
        surfaces.prepare(state.submap, state.camera, cfg)


def recognise(state: SlamState, keyframe: Keyframe, places: list[int], cfg: Config) -> Sighting | None:
    """The frame in one of some submaps, by its image: similar keyframes, matched features, then the field itself."""
    once = {
        k.number: (place, k)
        for place in places
        for k in state.submaps[place].keyframes
        if k.features is not None
    }
    stored = list(once.values())  # a frame that several of them share counts once
    if keyframe.features is None or not stored:
        return None
    database: list[Features] = [k.features for _, k in stored if k.features is not None]
    for i in similar(keyframe.features, database, cfg.loop.candidates):
        place, other = stored[i]
        seed = int(np.random.default_rng((cfg.seed, MATCH, keyframe.number, i)).integers(2**31))
        match = relative_pose(keyframe.features, database[i], state.camera, seed)
        if match.ok:
            found = sight(state, place, keyframe, _expected(other, match, cfg), cfg, measured=True)
            if found is not None:
                return found
    return None


def _expected(other: Keyframe, match: Match, cfg: Config) -> Expected:
    """Where the features put the frame. The field must too: things of one kind in two rooms match, the rooms do not."""
    loop = cfg.loop
    return Expected(
        other.T_sub_cam @ match.T_other_current,
        loop.sigma + DEVIATIONS * match.deviation_m,
        loop.sigma_rotation + DEVIATIONS * match.deviation_rad,
    )


def close(state: SlamState, sightings: list[Sighting], before: SlamState, cfg: Config) -> SlamState:
    """After a new keyframe of the active submap: loops are looked for, and the pose graph is solved where it disagrees.

    `sightings` are the submaps in whose box the frame was found, `before` the state without their links. A loop is a
    first link between submaps that are far apart along the chain.
    """
    keyframe, active = state.submap.keyframes[-1], state.active
    away, linked = chain_distances(before, active), set(linked_pairs(before))
    new = [p for p, n in enumerate(away) if n >= cfg.loop.apart and _pair(active, p) not in linked]
    found: list[tuple[Sighting, How]] = [(sighting, "box") for sighting in sightings]
    if cfg.loop.features:
        taken = {sighting.submap for sighting in sightings}
        recognised = recognise(state, keyframe, [p for p in new if p not in taken], cfg)
        if recognised is not None:
            state = link(state, keyframe, recognised)
            found.append((recognised, "features"))
    loops: list[tuple[Sighting, How]] = [pair for pair in found if pair[0].submap in new]
    if not loops and all(_agrees(state, sighting.submap, cfg) for sighting, _ in found):
        return state
    return _closed(state, [Found(keyframe.number, active, *pair) for pair in loops], cfg)


class Found(NamedTuple):
    """A keyframe of one submap that another one, far away along the chain, has seen."""

    number: int
    """Of the keyframe."""
    first: int
    """The submap that it was tracked in."""
    sighting: Sighting
    how: How


def _closed(state: SlamState, loops: list[Found], cfg: Config) -> SlamState:
    """The pose graph solved with loops that were found, already linked, and these written down as judged by it."""
    solved, weights = solve(state, cfg)
    if not weights:  # nothing was judged: what was found is forgotten, and may be found again
        for loop in loops:
            state = unlinked(state, loop.sighting.submap, loop.number)
        return state
    moved = distance(_world(state), _world(solved))
    made = tuple(
        Loop(
            frame=loop.number,
            first=loop.first,
            second=loop.sighting.submap,
            how=loop.how,
            inliers=loop.sighting.inliers,
            correction_m=moved[0],
            correction_rad=moved[1],
            weight=weights[_pair(loop.first, loop.sighting.submap)],
        )
        for loop in loops
    )
    judged = _judged(solved, weights)
    return judged._replace(loops=(*judged.loops, *made))


def closed_again(state: SlamState, cfg: Config) -> SlamState:
    """After the last frame: all keyframes are looked up once more, and the pose graph is solved by all links and
    surfaces, if it says more than which submap was begun from which."""
    if not cfg.loop.enabled:
        return state
    state, found = _looked_up(state, cfg) if cfg.loop.features else (state, [])
    begun = {(submap.parent, place) for place, submap in enumerate(state.submaps)}
    if begun.issuperset(linked_pairs(state)):
        return state
    return _closed(state, found, cfg)


def _looked_up(state: SlamState, cfg: Config) -> tuple[SlamState, list[Found]]:
    """All keyframes, by their images, in submaps far away that theirs is not linked with yet.

    What they were looked for in while the camera moved had fewer keyframes then, and had learned less. Of a pair of
    submaps only the first few are linked, each found without the others: they say how the two lie.
    """
    before, linked, found = state, set(linked_pairs(state)), list[Found]()
    for active, submap in enumerate(state.submaps):
        far = [p for p, n in enumerate(chain_distances(state, active)) if n >= cfg.loop.apart]
        own = [
            k for k in submap.keyframes if k.features is not None and state.records[k.number].submap == active
        ]
        for keyframe in own:
            known = [_pair(loop.first, loop.sighting.submap) for loop in found]
            places = [
                p for p in far if _pair(active, p) not in linked and known.count(_pair(active, p)) < LOOKED_UP
            ]
            # A keyframe that was linked a moment ago looks like this one, and would draw it to the same place
            sighting = recognise(before, keyframe, places, cfg)
            if sighting is not None:
                state = link(state, keyframe, sighting)
                found.append(Found(keyframe.number, active, sighting, "features"))
    return state, found


def _judged(state: SlamState, weights: dict[tuple[int, int], float]) -> SlamState:
    """With what the pose graph made of the loops that were known before."""
    loops = tuple(
        loop._replace(weight=loop.weight and weights.get(_pair(loop.first, loop.second), loop.weight))
        for loop in state.loops
    )
    return without_rejected(state, weights)._replace(loops=loops)


def solve(state: SlamState, cfg: Config) -> tuple[SlamState, dict[tuple[int, int], float]]:
    """Submap poses from all links and matched surfaces, and the weight of every linked pair. Fields stay as they are.

    Where no solution is found all stays as it was, and no pair is judged.

    Only pairs far apart along the chain may be rejected, and nearer ones, of which none was begun from the other, that
    share a frame with such a pair: all others were seen from a pose that tracking had brought there. They are judged
    by their shared frames alone, since surfaces that look alike match as well in the wrong place; the surfaces of
    those that are kept then make them exact.
    """
    from mipsjax.host.posegraph import (
        solve as solve_graph,
    )  # gtsam takes a second to load, and may not be needed

    places = linked_pairs(state)
    pairs = [pair_of(state.submaps, place, cfg) for place in places]
    shared = [{k.first.number for k in links(pair.first, pair.second)} for pair in pairs]
    away = {p: chain_distances(state, p) for p, _ in places}
    near = [away[j][k] < cfg.loop.apart for j, k in places]
    doubtful = set[int]().union(*(frames for frames, beside in zip(shared, near, strict=True) if not beside))
    sure = [
        beside and (pair.chained or doubtful.isdisjoint(frames))
        for pair, frames, beside in zip(pairs, shared, near, strict=True)
    ]
    frames = [pose_factor(pair, trusted, cfg) for pair, trusted in zip(pairs, sure, strict=True)]
    judged = solve_graph(np.stack([submap.T_world_sub for submap in state.submaps]), frames)
    if not judged.ok:
        return state, {}
    kept = [(pair, frame) for pair, frame, w in zip(pairs, frames, judged.weights, strict=True) if w]
    factors: list[Factor] = [frame for _, frame in kept]
    factors += [f for pair, _ in kept if (f := plane_factor(pair, True, state.camera, cfg)) is not None]
    found = solve_graph(judged.T_world_sub, factors, robust=False)
    for place, pose in enumerate(found.T_world_sub if found.ok else judged.T_world_sub):
        state = state.with_submap(place, T_world_sub=pose)
    return state, dict(zip(places, judged.weights.tolist(), strict=True))


def without_rejected(state: SlamState, weights: dict[tuple[int, int], float]) -> SlamState:
    """Without the frames shared by pairs that the pose graph has rejected, now or after it had kept them for a while.

    Such a frame stays a keyframe where it was tracked; one that was tracked in neither goes from both.
    """
    for (j, k), weight in weights.items():
        if weight:
            continue
        for shared in links(state.submaps[j], state.submaps[k]):
            number = shared.first.number
            # Where it was tracked, as the frame before it, and where it hangs, if another submap took over with it
            own = {record.submap for record in state.records[max(number - 1, 0) : number + 1]}
            for place in {j, k} - own:
                state = unlinked(state, place, number)
    return state


def _agrees(state: SlamState, place: int, cfg: Config) -> bool:
    """The newest frame has the same world pose by both of its submaps, within the tolerance."""
    newest = Link(state.submap.keyframes[-1], state.submaps[place].keyframes[-1])
    return max(misfit(state, state.active, place, newest)) < cfg.loop.tolerance


def _pair(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)


def _world(state: SlamState) -> Pose:
    return state.submap.T_world_sub @ last_pose(state)
