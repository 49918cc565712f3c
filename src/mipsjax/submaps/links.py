"""Frames that two submaps share: the measurements between submaps."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.config.sections import Config
from mipsjax.core.rigid import distance, inverse, lengths
from mipsjax.submaps.ids import RecordId, SubmapId
from mipsjax.submaps.state import Keyframe, Pose, SlamState, Submap
from mipsjax.uncertainty.held import Matrix, carried

SubmapPair = tuple[SubmapId, SubmapId]
"""Two submaps, the one with the lower id first."""

LOOSE = 2.0  # times its stated deviation that a pose is taken to be off: a loop that comes late is not to be refused


class Link(NamedTuple):
    """One frame as a keyframe of two submaps."""

    first: Keyframe
    second: Keyframe

    @property
    def T_first_second(self) -> Pose:
        """Pose of the second submap in the first, as this frame measures it."""
        return self.first.T_sub_cam @ inverse(self.second.T_sub_cam)

    @property
    def reach(self) -> float:
        """Metres from the frame to the two anchors: drift within a submap grows with it."""
        return float(np.linalg.norm([k.T_sub_cam[:3, 3] for k in self]))


def links(first: Submap, second: Submap) -> list[Link]:
    """All frames that two submaps share, in the order of the first submap's keyframes."""
    others = {keyframe.id: keyframe for keyframe in second.keyframes}
    return [Link(k, others[k.id]) for k in first.keyframes if k.id in others]


def best_link(first: Submap, second: Submap, chained: bool, cfg: Config) -> Link | None:
    """The frame that says how two submaps lie. If one was begun from the other (`chained`), the one nearest to both
    anchors; of others, where frames are registered one by one, the one that the others agree with best, and of two the
    newer: the first of a loop starts from the whole drift."""
    found = links(first, second)
    if not found or chained:
        return min(found, key=lambda link: link.reach, default=None)
    # Of two, each is as far off by the other: there is no majority
    if len(found) <= 2:
        return max(found, key=lambda link: link.first.id)
    return found[int(np.argmin(disagreement(found, cfg)))]


def disagreement(found: list[Link], cfg: Config) -> Float64[np.ndarray, " N"]:
    """Of each link, how far off it puts the shared frames: the median over all, in standard deviations."""
    loop = cfg.loop
    firsts = np.stack([link.first.T_sub_cam for link in found])
    seconds = np.stack([link.second.T_sub_cam for link in found])
    medians = []
    for link in found:
        # Each shared frame as this link has it, seen from where the first submap has it
        off = np.linalg.inv(firsts) @ link.T_first_second @ seconds
        shift, turn = lengths(off)
        medians.append(np.median(np.hypot(turn / loop.sigma_rotation, shift / loop.sigma)))
    return np.array(medians)


def linked_pairs(state: SlamState) -> list[SubmapPair]:
    """Pairs of submaps that share a frame, in order."""
    shown = [{keyframe.id for keyframe in submap.keyframes} for submap in state.submaps]
    return [(j, k) for j, k in combinations(state.submap_ids, 2) if shown[j] & shown[k]]


def pair_of_ids(a: SubmapId, b: SubmapId) -> SubmapPair:
    """The pair of two submaps, whichever comes first."""
    return (a, b) if a < b else (b, a)


def joined(state: SlamState, start: SubmapId) -> set[SubmapId]:
    """The submaps that shared frames connect with one, itself among them: how these lie is known."""
    pairs = linked_pairs(state)
    reached, queue = {start}, [start]
    while queue:
        here = queue.pop()
        beside = {b if a == here else a for a, b in pairs if here in (a, b)} - reached
        reached |= beside
        queue += beside
    return reached


def unjoined(state: SlamState) -> list[SubmapId]:
    """Submaps that no shared frames connect with the first: where they lie is where a lost camera was seen last."""
    return sorted(set(state.submap_ids) - joined(state, SubmapId(0)))


def chain(state: SlamState, start: SubmapId, end: SubmapId) -> list[SubmapId]:
    """The submaps on the way from one to another, each begun from the one before it or the other way round, both ends
    among them; empty between parts that were begun apart. Loops are no steps: what they join stays as far apart as it
    was."""
    up, down = _ancestry(state, start), _ancestry(state, end)
    # Two roots: one of both was begun where the camera had been lost
    if up[-1] != down[-1]:
        return []
    # What lies above the nearest common ancestor is on no way between them
    while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:
        up, down = up[:-1], down[:-1]
    return [*up, *down[-2::-1]]


def _ancestry(state: SlamState, submap_id: SubmapId) -> list[SubmapId]:
    """A submap, the one it was begun from, and so on."""
    line = [submap_id]
    while (parent := state.submaps[line[-1]].parent) is not None:
        line.append(parent)
    return line


def chain_distances(state: SlamState, start: SubmapId) -> list[float]:
    """Steps along the chain from one submap to each, by id; infinite between parts that were begun apart."""
    ways = [chain(state, start, submap_id) for submap_id in state.submap_ids]
    return [len(way) - 1 if way else float("inf") for way in ways]


def sigmas(link: Link, cfg: Config) -> tuple[float, float]:
    """Radians and metres by which a linked pose may be off, from the drift expected on the way to the anchors."""
    loop = cfg.loop
    turn, shift = loop.drift_rotation * link.reach, loop.drift * link.reach
    # Registration and drift err independently: squares add up
    return float(np.hypot(loop.sigma_rotation, turn)), float(np.hypot(loop.sigma, shift))


def loose(link: Link) -> Matrix:
    """Covariance of a linked pose by what is known of the frame's pose in both submaps, for a tangent (rotation,
    translation) on its right, as the pose graph has it."""
    T_first_second = link.T_first_second
    left = link.first.covariance + carried(link.second.covariance, T_first_second)
    right = LOOSE**2 * carried(left, inverse(T_first_second))
    order = [3, 4, 5, 0, 1, 2]
    return right[np.ix_(order, order)]


def misfit(state: SlamState, first: SubmapId, second: SubmapId, link: Link) -> tuple[float, float]:
    """Metres and radians between a frame's world poses by its two submaps."""
    one = state.submaps[first].T_world_sub @ link.first.T_sub_cam
    other = state.submaps[second].T_world_sub @ link.second.T_sub_cam
    return distance(one, other)


def is_needed(state: SlamState, submap_id: SubmapId, record_id: RecordId) -> bool:
    """Whether a keyframe of a submap cannot be deleted: it is the anchor, or a frame hangs on it."""
    if state.submaps[submap_id].anchor.id == record_id:
        return True
    return any(r.submap == submap_id and r.keyframe == record_id for r in state.records)


def unlinked(state: SlamState, submap_id: SubmapId, record_id: RecordId) -> SlamState:
    """The state in which a frame is no keyframe of a submap; as it was where the submap needs that keyframe."""
    if is_needed(state, submap_id, record_id):
        return state
    keyframes = tuple(k for k in state.submaps[submap_id].keyframes if k.id != record_id)
    return state.with_submap(submap_id, keyframes=keyframes)
