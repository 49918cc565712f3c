"""Loops: finding a known place again, and moving the submaps so that it is one place (Section 3.5 of the paper).

In three steps. `propose` collects where the newest keyframe was found; `judge` says what of it is believed, by the pose
graph where something disagrees; `commit` makes the new state. The first two leave the state as it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core.rigid import distance
from mipsjax.loops.factors import Factor
from mipsjax.submaps import surfaces
from mipsjax.submaps.astray import with_covariances
from mipsjax.submaps.ids import RecordId, SubmapId
from mipsjax.submaps.links import (
    SubmapPair,
    chain_distances,
    is_needed,
    linked_pairs,
    links,
    misfit,
    pair_of_ids,
    unlinked,
)
from mipsjax.submaps.proposals import (
    Expected,
    Proposal,
    by_box,
    loop_candidates,
    proposed,
    sight,
    with_links,
)
from mipsjax.submaps.recognition import recognise
from mipsjax.submaps.state import How, Loop, Pose, SlamState, last_pose
from mipsjax.submaps.surfaces import pair_of, plane_factor, pose_factor

LOOKED_UP = 3  # keyframes after the last frame that may join a pair of submaps


class Judgement(NamedTuple):
    """What becomes of proposals, and of what was known before them."""

    accepted: tuple[Proposal, ...]
    """The proposals that become links."""
    dropped: tuple[tuple[SubmapId, RecordId], ...]
    """Keyframes of submaps that are deleted: older links, which turned out false."""
    T_world_sub: tuple[Pose, ...]
    """Where each submap lies."""
    loops: tuple[Loop, ...]
    """All loops that were ever found, the new ones last."""


def prepare(state: SlamState, cfg: Config) -> None:
    """Compiles, on the first submap alone, what the first meeting of two submaps will need."""
    sight(state, SubmapId(0), state.submap.anchor, Expected(np.eye(4)), cfg)
    if cfg.loop.enabled:
        surfaces.prepare(state.submap, state.camera, cfg)


def propose(state: SlamState, cfg: Config) -> list[Proposal]:
    """The submaps in which the newest keyframe of the active one was found: by boxes, and at most one by its image.

    By its image it is looked for only where a link would close a loop.
    """
    proposals = by_box(state, cfg)
    if not (cfg.loop.enabled and cfg.loop.features):
        return proposals
    keyframe, found_in = state.submap.keyframes[-1], {proposal.second for proposal in proposals}
    elsewhere = [s for s in loop_candidates(state, state.active, cfg) if s not in found_in]
    sighting = recognise(state, keyframe, elsewhere, cfg)
    if sighting is not None:
        proposals.append(proposed(state, state.active, keyframe, sighting, How.FEATURES))
    return proposals


def judge(state: SlamState, proposals: Sequence[Proposal], cfg: Config) -> Judgement:
    """The judgement on what `propose` gave. The pose graph is solved where a loop closes or the state disagrees.

    A loop is a first link between submaps that are far apart along the chain.
    """
    if not cfg.loop.enabled:
        return _accepting(state, proposals)
    far = loop_candidates(state, state.active, cfg)
    loops = {proposal.pair for proposal in proposals if proposal.second in far}
    if not loops and all(_agrees(state, proposal, cfg) for proposal in proposals):
        return _accepting(state, proposals)
    return _by_pose_graph(state, proposals, loops, cfg)


def commit(state: SlamState, judgement: Judgement, cfg: Config) -> SlamState:
    """The state after a judgement: with the accepted links, without the dropped keyframes, submaps where they lie."""
    # Where nothing is joined or parted anew, submaps are as far off as they were
    changed = judgement.accepted or judgement.dropped or judgement.loops != state.loops
    state = with_links(state, judgement.accepted)
    for submap_id, keyframe_id in judgement.dropped:
        state = unlinked(state, submap_id, keyframe_id)
    for submap_id, T_world_sub in zip(state.submap_ids, judgement.T_world_sub, strict=True):
        state = state.with_submap(submap_id, T_world_sub=T_world_sub)
    state = state._replace(loops=judgement.loops)
    return with_covariances(state, cfg) if changed else state


def closed_again(state: SlamState, cfg: Config) -> SlamState:
    """The state after the last frame, with all keyframes looked up once more and the pose graph solved by all links
    and surfaces, if they say more than which submap was begun from which."""
    if not cfg.loop.enabled:
        return state
    proposals = propose_again(state, cfg) if cfg.loop.features else []
    pairs = linked_pairs(with_links(state, proposals))
    if all(state.submaps[second].parent == first for first, second in pairs):
        return commit(state, _accepting(state, proposals), cfg)
    loops = {proposal.pair for proposal in proposals}
    return commit(state, _by_pose_graph(state, proposals, loops, cfg), cfg)


def propose_again(state: SlamState, cfg: Config) -> list[Proposal]:
    """All keyframes, by their images, in submaps far away that theirs is not linked with yet.

    What they were looked for in while the camera moved had fewer keyframes then, and had learned less. Of a pair of
    submaps only the first few are proposed, each found without the others: they say how the two lie.
    """
    proposals, of_pair, candidate = list[Proposal](), Counter[SubmapPair](), state
    for submap_id in state.submap_ids:
        far = loop_candidates(state, submap_id, cfg)
        for keyframe in state.submaps[submap_id].keyframes:
            if keyframe.features is None or state.records[keyframe.id].submap != submap_id:
                continue
            wanted = [other for other in far if of_pair[pair_of_ids(submap_id, other)] < LOOKED_UP]
            # In the state without proposals: a keyframe that was found a moment ago looks like this one, and would
            # draw it to the same place
            sighting = recognise(state, keyframe, wanted, cfg)
            if sighting is None:
                continue
            proposal = proposed(candidate, submap_id, keyframe, sighting, How.FEATURES)
            candidate = with_links(candidate, [proposal])
            of_pair[proposal.pair] += 1
            proposals.append(proposal)
    return proposals


def _accepting(state: SlamState, proposals: Sequence[Proposal]) -> Judgement:
    """The judgement that takes these proposals as they are, and leaves all else."""
    poses = tuple(submap.T_world_sub for submap in state.submaps)
    return Judgement(tuple(proposals), (), poses, state.loops)


def _by_pose_graph(
    state: SlamState, proposals: Sequence[Proposal], loops: Collection[SubmapPair], cfg: Config
) -> Judgement:
    """The judgement of the pose graph on the state as it would be with all proposals; `loops` are the pairs of submaps
    that these would join in a loop."""
    candidate = with_links(state, proposals)
    solved, weights = solve(candidate, cfg)
    if not weights:
        # Nothing was judged: what would close a loop is forgotten, and may be found again
        return _accepting(state, [proposal for proposal in proposals if proposal.pair not in loops])
    rejected = rejected_keyframes(candidate, weights)
    fresh = {(proposal.second, proposal.link.second.id) for proposal in proposals}
    accepted = [p for p in proposals if (p.second, p.link.second.id) not in rejected]
    metres, radians = distance(_world_pose(candidate), _world_pose(solved))
    found = [
        Loop(
            record=proposal.link.first.id,
            first=proposal.first,
            second=proposal.second,
            how=proposal.how,
            inliers=proposal.inliers,
            correction_m=metres,
            correction_rad=radians,
            weight=weights[proposal.pair],
        )
        for proposal in proposals
        if proposal.pair in loops
    ]
    return Judgement(
        accepted=tuple(accepted),
        dropped=tuple(one for one in rejected if one not in fresh),
        T_world_sub=tuple(submap.T_world_sub for submap in solved.submaps),
        loops=(*_weighed(state.loops, weights), *found),
    )


def _weighed(loops: Sequence[Loop], weights: dict[SubmapPair, float]) -> list[Loop]:
    """Loops that were known before, with what the pose graph makes of them now. One that was rejected stays so."""
    weighed = []
    for loop in loops:
        now = weights.get(pair_of_ids(loop.first, loop.second), loop.weight)
        weighed.append(loop._replace(weight=now if loop.weight else loop.weight))
    return weighed


def solve(state: SlamState, cfg: Config) -> tuple[SlamState, dict[SubmapPair, float]]:
    """Submap poses from all links and matched surfaces, and the weight of every linked pair. Fields stay as they are.

    Where no solution is found all stays as it was, and no pair is judged.

    Only pairs far apart along the chain may be rejected, and nearer ones, of which none was begun from the other, that
    share a frame with such a pair: all others were seen from a pose that tracking had brought there. They are judged
    by their shared frames alone, since surfaces that look alike match as well in the wrong place; the surfaces of
    those that are kept then make them exact.
    """
    # gtsam takes a second to load, and a run of one submap needs none
    from mipsjax.loops.posegraph import solve as solve_graph

    ids = linked_pairs(state)
    pairs = [pair_of(state.submaps, pair, cfg) for pair in ids]
    trusted = _vouched_for(state, pairs, cfg)
    frames = [pose_factor(pair, sure, cfg) for pair, sure in zip(pairs, trusted, strict=True)]
    judged = solve_graph(np.stack([submap.T_world_sub for submap in state.submaps]), frames)
    if not judged.ok:
        return state, {}
    factors, planes = list[Factor](), list[Factor]()
    for pair, frame, weight in zip(pairs, frames, judged.weights, strict=True):
        if not weight:
            continue
        factors.append(frame)
        plane = plane_factor(pair, True, state.camera, cfg)
        if plane is not None:
            planes.append(plane)
    found = solve_graph(judged.T_world_sub, factors + planes, robust=False)
    # Where surfaces leave it without a solution, that by shared frames alone
    poses = found.T_world_sub if found.ok else judged.T_world_sub
    for submap_id, T_world_sub in zip(state.submap_ids, poses, strict=True):
        state = state.with_submap(submap_id, T_world_sub=T_world_sub)
    return state, dict(zip(ids, judged.weights.tolist(), strict=True))


def _vouched_for(state: SlamState, pairs: Sequence[surfaces.Pair], cfg: Config) -> list[bool]:
    """Which linked pairs tracking vouches for, so that the pose graph may not reject them."""
    away = {first: chain_distances(state, first) for first in {pair.ids[0] for pair in pairs}}
    near = [away[pair.ids[0]][pair.ids[1]] < cfg.loop.apart for pair in pairs]
    shared = [{link.first.id for link in links(pair.first, pair.second)} for pair in pairs]
    doubtful = set[RecordId]()
    for frames, is_near in zip(shared, near, strict=True):
        if not is_near:
            doubtful |= frames
    return [
        is_near and (pair.chained or doubtful.isdisjoint(frames))
        for pair, frames, is_near in zip(pairs, shared, near, strict=True)
    ]


def rejected_keyframes(state: SlamState, weights: dict[SubmapPair, float]) -> list[tuple[SubmapId, RecordId]]:
    """The keyframes of submaps that go because the pose graph has rejected the pair that shares them, now or after it
    had kept them for a while.

    Such a frame stays a keyframe where it was tracked; one that was tracked in neither goes from both.
    """
    rejected = list[tuple[SubmapId, RecordId]]()
    for pair, weight in weights.items():
        if weight:
            continue
        for shared in links(state.submaps[pair[0]], state.submaps[pair[1]]):
            frame = shared.first.id
            if any((submap_id, frame) in rejected for submap_id in pair):
                continue  # another rejected pair has taken it from one of the two: they share it no more
            # Where it was tracked, as the frame before it, and where it hangs, if another submap took over with it
            own = {record.submap for record in state.records[max(frame - 1, 0) : frame + 1]}
            rejected += [(s, frame) for s in pair if s not in own and not is_needed(state, s, frame)]
    return rejected


def _agrees(state: SlamState, proposal: Proposal, cfg: Config) -> bool:
    """Whether the frame would have the same world pose by both submaps, within the tolerance."""
    return max(misfit(state, proposal.first, proposal.second, proposal.link)) < cfg.loop.tolerance


def _world_pose(state: SlamState) -> Pose:
    """Camera-to-world pose of the last frame."""
    return state.submap.T_world_sub @ last_pose(state)
