"""Frames that two submaps share: the measurements between submaps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.config import Config
from mipsjax.host.held import Matrix, carried
from mipsjax.state import Keyframe, Pose, SlamState, Submap, distance, inverse

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
    """All of them, in the order of the first submap's keyframes."""
    others = {keyframe.number: keyframe for keyframe in second.keyframes}
    return [Link(k, others[k.number]) for k in first.keyframes if k.number in others]


def best_link(first: Submap, second: Submap, chained: bool, cfg: Config) -> Link | None:
    """The frame that says how two submaps lie. If one was begun from the other (`chained`), the one nearest to both
    anchors; of others, where frames are registered one by one, the one that the others agree with best, and of two the
    newer: the first of a loop starts from the whole drift."""
    found = links(first, second)
    if not found or chained:
        return min(found, key=lambda link: link.reach, default=None)
    if len(found) <= 2:
        return max(found, key=lambda link: link.first.number)
    return found[int(np.argmin(disagreement(found, cfg)))]


def disagreement(found: list[Link], cfg: Config) -> Float64[np.ndarray, " N"]:
    """Of each link, how far off it puts the shared frames: the median over all, in standard deviations."""
    firsts, seconds = (np.stack([k.T_sub_cam for k in side]) for side in zip(*found, strict=True))
    loop = cfg.loop
    medians = []
    for link in found:
        off = np.linalg.inv(firsts) @ link.T_first_second @ seconds
        cosine = (np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2
        turn, shift = np.arccos(np.clip(cosine, -1, 1)), np.linalg.norm(off[:, :3, 3], axis=1)
        medians.append(np.median(np.hypot(turn / loop.sigma_rotation, shift / loop.sigma)))
    return np.array(medians)


def linked_pairs(state: SlamState) -> list[tuple[int, int]]:
    """Pairs of submaps, the lower place first, that share a frame."""
    numbers = [{k.number for k in submap.keyframes} for submap in state.submaps]
    count = len(numbers)
    return [(j, k) for j in range(count) for k in range(j + 1, count) if numbers[j] & numbers[k]]


def joined(state: SlamState, start: int) -> set[int]:
    """Submaps that shared frames connect with one, itself among them: how these lie is known."""
    pairs = linked_pairs(state)
    reached, queue = {start}, [start]
    while queue:
        here = queue.pop()
        beside = {b if a == here else a for a, b in pairs if here in (a, b)} - reached
        reached |= beside
        queue += beside
    return reached


def unjoined(state: SlamState) -> list[int]:
    """Submaps that no shared frames connect with the first: where they lie is where a lost camera was seen last."""
    return sorted(set(range(len(state.submaps))) - joined(state, 0))


def chain(state: SlamState, start: int, end: int) -> list[int]:
    """Places of the submaps from one to another, each begun from the one before it or the other way round, both ends
    among them; empty between parts that were begun apart. Loops are no steps: what they join stays as far apart as it
    was."""
    up, down = _ancestry(state, start), _ancestry(state, end)
    if up[-1] != down[-1]:
        return []
    while len(up) > 1 and len(down) > 1 and up[-2] == down[-2]:
        up, down = up[:-1], down[:-1]
    return [*up, *down[-2::-1]]


def _ancestry(state: SlamState, place: int) -> list[int]:
    """A submap, the one it was begun from, and so on."""
    line = [place]
    while (parent := state.submaps[line[-1]].parent) is not None:
        line.append(parent)
    return line


def chain_distances(state: SlamState, start: int) -> list[float]:
    """Steps along the chain from one submap to each; infinite between parts that were begun apart."""
    ways = [chain(state, start, place) for place in range(len(state.submaps))]
    return [len(way) - 1 if way else float("inf") for way in ways]


def sigmas(link: Link, cfg: Config) -> tuple[float, float]:
    """Radians and metres by which a linked pose may be off, from the drift expected on the way to the anchors."""
    loop = cfg.loop
    turn, shift = loop.drift_rotation * link.reach, loop.drift * link.reach
    return float(np.hypot(loop.sigma_rotation, turn)), float(np.hypot(loop.sigma, shift))


def loose(link: Link) -> Matrix:
    """Covariance of a linked pose by what is known of the frame's pose in both submaps, for a tangent (rotation,
    translation) on its right, as the pose graph has it."""
    T_first_second = link.T_first_second
    left = link.first.covariance + carried(link.second.covariance, T_first_second)
    right = LOOSE**2 * carried(left, inverse(T_first_second))
    order = [3, 4, 5, 0, 1, 2]
    return right[np.ix_(order, order)]


def misfit(state: SlamState, first: int, second: int, link: Link) -> tuple[float, float]:
    """Metres and radians between a frame's world poses by its two submaps."""
    one, other = (
        state.submaps[place].T_world_sub @ keyframe.T_sub_cam
        for place, keyframe in zip((first, second), link, strict=True)
    )
    return distance(one, other)


def unlinked(state: SlamState, place: int, number: int) -> SlamState:
    """Without a frame as a keyframe of a submap; frames that hang on later keyframes go on hanging on them.

    An anchor stays, and so does a keyframe on which frames hang.
    """
    keyframes = state.submaps[place].keyframes
    gone = next((i for i, keyframe in enumerate(keyframes) if keyframe.number == number), 0)
    if not gone or any(r.submap == place and r.keyframe == gone for r in state.records):
        return state
    records = tuple(
        r._replace(keyframe=r.keyframe - 1) if r.submap == place and r.keyframe > gone else r
        for r in state.records
    )
    state = state._replace(records=records)
    return state.with_submap(place, keyframes=(*keyframes[:gone], *keyframes[gone + 1 :]))
