"""After the last frame: keyframes measured against each other, and moved to where these measurements agree.

Tracking hangs each frame on the map and on the frames just before it. What the map has wrong is handed on: a submap
turns or bends within itself, and no loop between submaps sees that. Here two keyframes that saw the same say how they
lie by their own images alone, each keyframe is measured against several, and one graph of all of them moves them, and
with the anchors their submaps.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from mipsjax.bundle import nearest
from mipsjax.config import Config
from mipsjax.core import relative
from mipsjax.core.solvers import Landmarks
from mipsjax.host.corners import follow
from mipsjax.host.factors import RelativePose
from mipsjax.host.metrics import angles
from mipsjax.host.trust import differing, trusted
from mipsjax.landmarks import Seen, landmarks
from mipsjax.links import joined
from mipsjax.state import Keyframe, Pose, SlamState, inverse, rigid

log = logging.getLogger(__name__)

GROUP = 16
"""Pairs that are measured in one call."""
MATCHED = 0.3
"""Least share of the later frame's points on surfaces of the earlier one, where no corners join the two."""
SIGMA_M, SIGMA_RAD = 0.001, 0.0005
"""Of a measured pair, beside what it states: two images of one place err together."""


class Pair(NamedTuple):
    """Two keyframes that may see the same, the earlier one first; places in the list of all."""

    first: int
    second: int
    T_first_second: Pose
    """As they lie so far."""
    seen: Seen | None
    """Corners of the first in the second."""


def straightened(state: SlamState, cfg: Config) -> tuple[SlamState, float]:
    """With keyframes where they lie by each other, the first one as it was; submaps move with their anchors, and frames
    with the keyframes that they hang on. Also the trust in corners that was found right.

    Submaps that nothing joins to the first stay where they are.
    """
    numbers, nodes = _keyframes(state)
    poses = np.stack([T for _, T in nodes])
    pairs = [_followed(nodes, *places, state, cfg) for places in _near(poses, cfg)]
    if not pairs:
        return state, 1.0
    measured = _measured(nodes, pairs, 1.0, state, cfg)
    differences = [differing(measured, place, 1.0) for place in range(len(pairs))]
    trust = trusted([difference for difference in differences if difference is not None])
    if trust < 1:
        measured = _measured(nodes, pairs, trust, state, cfg)
    factors = list(_pair_factors(pairs, measured, cfg))
    factors += _as_tracked(poses, {factor.second for factor in factors}, cfg)
    factors += _link_factors(state, numbers, cfg)
    from mipsjax.host.posegraph import solve  # gtsam takes a second to load, and may not be needed

    solved = solve(poses, factors, robust=False)
    moved = np.linalg.norm(solved.T_world_sub[:, :3, 3] - poses[:, :3, 3], axis=1)
    log.info(
        "%d keyframes measured in %d pairs, corners trusted by %.2g, moved by %.1f cm at most",
        len(nodes),
        len(pairs),
        trust,
        100 * moved.max(),
    )
    return _moved(state, dict(zip(numbers, solved.T_world_sub, strict=True))), trust


def _keyframes(state: SlamState) -> tuple[list[int], list[tuple[Keyframe, Pose]]]:
    """All that are joined to the first submap, in the order of their numbers: each once, as the submap has it in which
    it was tracked, and its pose in the world."""
    places = joined(state, 0)
    found = {}
    for place in places:
        submap = state.submaps[place]
        for keyframe in submap.keyframes:
            own = state.records[keyframe.number].submap == place
            if own or keyframe.number not in found:
                found[keyframe.number] = keyframe, submap.T_world_sub @ keyframe.T_sub_cam
    numbers = sorted(found)
    return numbers, [found[number] for number in numbers]


def _near(poses: Float64[np.ndarray, "N 4 4"], cfg: Config) -> Iterator[tuple[int, int]]:
    """Places of the keyframes that are measured against each other, the earlier one first."""
    wanted = cfg.pairs
    for second in range(1, len(poses)):
        shift = np.linalg.norm(poses[:second, :3, 3] - poses[second, :3, 3], axis=1)
        turn = angles(poses[:second, :3, :3].swapaxes(1, 2) @ poses[second, :3, :3])
        within = np.flatnonzero((shift < wanted.translation) & (turn < wanted.rotation))
        chosen = within[within >= second - wanted.before]
        rest = within[within < second - wanted.before]
        # A radian is as far as a metre, as elsewhere
        nearest = rest[np.argsort((shift + turn)[rest], kind="stable")][: wanted.others]
        oldest = np.setdiff1d(rest, nearest)[: wanted.oldest]
        for first in sorted({*chosen.tolist(), *nearest.tolist(), *oldest.tolist()}):
            yield first, second


def _followed(
    nodes: list[tuple[Keyframe, Pose]], first: int, second: int, state: SlamState, cfg: Config
) -> Pair:
    """Two keyframes, with the corners of the first that the second shows."""
    (one, T_world_one), (other, T_world_other) = nodes[first], nodes[second]
    guess = inverse(T_world_one) @ T_world_other
    if one.corners is None or other.corners is None:
        return Pair(first, second, guess, None)
    fewest = cfg.track.corners.fewest
    followed = follow(one.corners, other.corners.grey, guess, fewest, state.camera, near=True)
    seen = None if followed is None else Seen(one.corners, np.eye(4), followed)
    return Pair(first, second, guess if seen is None else seen.T_sub_cam, seen)


def _measured(
    nodes: list[tuple[Keyframe, Pose]], pairs: list[Pair], trust: float, state: SlamState, cfg: Config
) -> relative.Relative:
    """What all pairs say, a fixed number of them in each call."""
    found = []
    for begin in range(0, len(pairs), GROUP):
        group = pairs[begin : begin + GROUP]
        filled = [group[i % len(group)] for i in range(GROUP)]
        given = relative.Pairs(
            jnp.asarray(np.stack([nodes[pair.first][0].depth for pair in filled])),
            jnp.asarray(np.stack([nodes[pair.second][0].depth for pair in filled])),
            jnp.asarray(np.stack([pair.T_first_second for pair in filled]), jnp.float32),
            jax.tree.map(lambda *parts: jnp.stack(parts), *(_landmarks(pair, state, cfg) for pair in filled)),
        )
        said = jax.device_get(relative.measure(given, np.float32(trust), state.camera, cfg))
        found.append(jax.tree.map(lambda part: part[: len(group)], said))  # noqa: B023 (called here)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def _landmarks(pair: Pair, state: SlamState, cfg: Config) -> Landmarks | None:
    return landmarks([] if pair.seen is None else [pair.seen], 1, state.camera, cfg)


def _pair_factors(pairs: list[Pair], measured: relative.Relative, cfg: Config) -> Iterator[RelativePose]:
    """Of pairs that corners or enough surfaces join."""
    order = [3, 4, 5, 0, 1, 2]  # of a tangent: that of the graph is (rotation, translation)
    for place, pair in enumerate(pairs):
        T, matched = np.asarray(measured.T_first_second[place]), float(measured.matched[place])
        information = np.asarray(measured.surfaces[place] + measured.corners[place], np.float64)
        if not (np.isfinite(T).all() and np.isfinite(information).all()):
            continue
        if pair.seen is None and matched < MATCHED:
            continue
        covariance = np.linalg.inv(information)
        added = (covariance + covariance.T)[np.ix_(order, order)] / 2
        yield RelativePose(
            pair.first, pair.second, rigid(T), SIGMA_RAD, SIGMA_M, added=added, robust=cfg.pairs.robust
        )


def _as_tracked(poses: Float64[np.ndarray, "N 4 4"], joined: set[int], cfg: Config) -> Iterator[RelativePose]:
    """Keyframes that no pair joins to an earlier one stay where they are beside the one before."""
    for second in sorted(set(range(1, len(poses))) - joined):
        between = inverse(poses[second - 1]) @ poses[second]
        yield RelativePose(second - 1, second, between, cfg.loop.sigma_rotation, cfg.loop.sigma)


def _link_factors(state: SlamState, numbers: list[int], cfg: Config) -> Iterator[RelativePose]:
    """Of frames that were registered in another submap, beside its keyframe that is nearest to them: a loop that was
    closed stays closed where its keyframes are too far apart for a pair."""
    places = {number: place for place, number in enumerate(numbers)}
    for submap in sorted(joined(state, 0)):
        keyframes = state.submaps[submap].keyframes
        own = [k for k in keyframes if state.records[k.number].submap == submap]
        for keyframe in keyframes:
            tracked = state.records[keyframe.number].submap
            begun = tracked == state.submaps[submap].parent or state.submaps[tracked].parent == submap
            if tracked == submap or begun or not own:
                continue
            (beside,) = nearest(own, keyframe.T_sub_cam, 1)
            yield RelativePose(
                places[beside.number],
                places[keyframe.number],
                inverse(beside.T_sub_cam) @ keyframe.T_sub_cam,
                cfg.loop.sigma_rotation,
                cfg.loop.sigma,
                robust=cfg.pairs.robust,
            )


def _moved(state: SlamState, T_world_cam: dict[int, Pose]) -> SlamState:
    """With keyframes of these numbers at these poses, and submaps where their anchors are."""
    for place in joined(state, 0):
        keyframes = state.submaps[place].keyframes
        T_world_sub = T_world_cam[keyframes[0].number]
        there = (k._replace(T_sub_cam=inverse(T_world_sub) @ T_world_cam[k.number]) for k in keyframes[1:])
        state = state.with_submap(place, keyframes=(keyframes[0], *there), T_world_sub=T_world_sub)
    return state
