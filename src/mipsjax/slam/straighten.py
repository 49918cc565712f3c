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
from numpy.typing import ArrayLike

from mipsjax.config.sections import Config
from mipsjax.core import relative
from mipsjax.core.evidence import Landmarks
from mipsjax.core.rigid import angles, inverse, rigid
from mipsjax.images.following import follow
from mipsjax.loops.factors import RelativePose
from mipsjax.slam.landmarks import Seen, images_of, landmarks
from mipsjax.submaps.bundle import nearest
from mipsjax.submaps.ids import RecordId, SubmapId
from mipsjax.submaps.links import joined
from mipsjax.submaps.state import Keyframe, Pose, SlamState
from mipsjax.uncertainty.trust import ALLOWED, ALLOWED_TRACKED, MATCHED, of_pair, trusted

log = logging.getLogger(__name__)

FIRST = SubmapId(0)
GROUP = 16
"""Pairs that are measured in one call."""
AGREEING = 2
"""Pairs that lie near, for each keyframe, at least: measured once, it is known no better than as it was tracked."""
SIGMA_M, SIGMA_RAD = 0.001, 0.0005
"""Of a measured pair, beside what it states: two images of one place err together."""


class Node(NamedTuple):
    """One keyframe, whatever submaps it is of."""

    keyframe: Keyframe
    T_world_cam: Pose


class Pair(NamedTuple):
    """Two keyframes that may see the same, the earlier one first; indices in the list of all."""

    first: int
    second: int
    T_first_second: Pose
    """As they lie so far."""
    seen: Seen | None
    """Corners of the first in the second."""


def straightened(state: SlamState, cfg: Config) -> tuple[SlamState, float]:
    """With keyframes where they lie by each other, the first one as it was; submaps move with their anchors, and frames
    with the keyframes that they hang on. Also the trust in colour that was found right.

    Submaps that nothing joins to the first stay where they are, and so does all of a run of which few keyframes lie
    near others.
    """
    nodes = _keyframes(state)
    ids = [node.keyframe.id for node in nodes]
    poses = np.stack([node.T_world_cam for node in nodes])
    near, trust = list(_near(poses, cfg)), trusted(state.doubts, ALLOWED_TRACKED)
    if len(near) < AGREEING * len(nodes):
        return state, trust
    pairs = [_followed(nodes, *both, state, cfg) for both in near]
    # With all trust first: how far colour can be trusted follows from what it says by itself
    measured = _measured(nodes, pairs, 1.0, state, cfg)
    differences = [of_pair(measured, number) for number in range(len(pairs))]
    trust = trusted([difference for difference in differences if difference is not None], ALLOWED, trust)
    if trust < 1:
        measured = _measured(nodes, pairs, trust, state, cfg)
    factors = list(_pair_factors(pairs, measured, cfg))
    begins = next((i for i, keyframe_id in enumerate(ids) if keyframe_id >= state.first), 0)
    factors += _as_tracked(poses, {factor.second for factor in factors}, begins, cfg)
    factors += _link_factors(state, ids, cfg)
    solved = _solved(poses, factors)
    if solved is None:
        return state, trust
    log.info("%d keyframes in %d pairs; colour is trusted by %.2g", len(nodes), len(pairs), trust)
    return _moved(state, dict(zip(ids, solved, strict=True))), trust


def _solved(
    poses: Float64[np.ndarray, "N 4 4"], factors: list[RelativePose]
) -> Float64[np.ndarray, "N 4 4"] | None:
    """Where the keyframes lie by all of it; None, with a warning, where no solution is found."""
    from mipsjax.loops.posegraph import solve  # gtsam takes a second to load, and may not be needed

    solved = solve(poses, factors, robust=False)
    if not solved.ok:
        log.warning("keyframes could not be moved to where they lie by each other: they stay as tracked")
        return None
    return solved.T_world_sub


def _keyframes(state: SlamState) -> list[Node]:
    """All that are joined to the first submap, in the order of their ids: each once, as the submap has it in which
    it was tracked."""
    found: dict[RecordId, Node] = {}
    for submap_id in joined(state, FIRST):
        submap = state.submaps[submap_id]
        for keyframe in submap.keyframes:
            tracked_here = state.records[keyframe.id].submap == submap_id
            if tracked_here or keyframe.id not in found:
                found[keyframe.id] = Node(keyframe, submap.T_world_sub @ keyframe.T_sub_cam)
    return [found[keyframe_id] for keyframe_id in sorted(found)]


def _near(poses: Float64[np.ndarray, "N 4 4"], cfg: Config) -> Iterator[tuple[int, int]]:
    """Indices of the keyframes that are measured against each other, the earlier one first."""
    wanted = cfg.pairs
    for second in range(1, len(poses)):
        shift = np.linalg.norm(poses[:second, :3, 3] - poses[second, :3, 3], axis=1)
        turn = angles(poses[:second, :3, :3].swapaxes(1, 2) @ poses[second, :3, :3])
        within = np.flatnonzero((shift < wanted.translation) & (turn < wanted.rotation))
        chosen = within[within >= second - wanted.before]
        farther_back = within[within < second - wanted.before]
        # A radian is as far as a metre, as elsewhere
        nearest = farther_back[np.argsort((shift + turn)[farther_back], kind="stable")][: wanted.others]
        # Which sorts by index, and so by time
        oldest = np.setdiff1d(farther_back, nearest)[: wanted.oldest]
        for first in sorted({*chosen.tolist(), *nearest.tolist(), *oldest.tolist()}):
            yield first, second


def _followed(nodes: list[Node], first: int, second: int, state: SlamState, cfg: Config) -> Pair:
    """Two keyframes, with the corners of the first that the second shows."""
    one, other = nodes[first], nodes[second]
    T_first_second = inverse(one.T_world_cam) @ other.T_world_cam
    corners, later = one.keyframe.corners, other.keyframe.corners
    if corners is None or later is None:
        return Pair(first, second, T_first_second, None)
    followed = follow(
        corners,
        later.grey,
        T_first_second,
        cfg.track.corners.fewest,
        state.camera,
        near=second - first <= cfg.pairs.before,  # farther back they may have drifted
    )
    seen = None if followed is None else Seen(corners, np.eye(4), followed)
    return Pair(first, second, T_first_second, seen)


def _measured(
    nodes: list[Node], pairs: list[Pair], trust: float, state: SlamState, cfg: Config
) -> relative.Relative:
    """What all pairs say, a fixed number of them in each call."""
    found = []
    for begin in range(0, len(pairs), GROUP):
        group = pairs[begin : begin + GROUP]
        filled = [group[i % len(group)] for i in range(GROUP)]
        starts = [pair.T_first_second if pair.seen is None else pair.seen.T_sub_cam for pair in filled]
        given = relative.Pairs(
            jnp.asarray(np.stack([nodes[pair.first].keyframe.depth for pair in filled])),
            jnp.asarray(np.stack([nodes[pair.second].keyframe.depth for pair in filled])),
            jnp.asarray(np.stack(starts), jnp.float32),
            jnp.asarray(np.stack([pair.T_first_second for pair in filled]), jnp.float32),
            jax.tree.map(lambda *parts: jnp.stack(parts), *(_landmarks(pair, state, cfg) for pair in filled)),
            _images(nodes, filled, state, cfg),
        )
        said = jax.device_get(relative.measure(given, np.float32(trust), state.camera, cfg))
        found.append(jax.tree.map(lambda part: part[: len(group)], said))  # noqa: B023 (called here)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *found)


def _landmarks(pair: Pair, state: SlamState, cfg: Config) -> Landmarks | None:
    return landmarks([] if pair.seen is None else [pair.seen], 1, state.camera, cfg)


def _images(nodes: list[Node], pairs: list[Pair], state: SlamState, cfg: Config) -> relative.Shown | None:
    """Of these pairs; they say nothing where one of both has no colour."""
    if not cfg.track.brightness.weight:
        return None
    blank, parts = np.zeros((state.camera.height, state.camera.width), np.uint8), []
    for pair in pairs:
        first, second = (nodes[index].keyframe.corners for index in (pair.first, pair.second))
        shown = [] if first is None or second is None else [(first, np.eye(4))]
        parts.append((blank if second is None else second.grey, images_of(shown, 1, state.camera, cfg)))
    seconds, firsts = zip(*parts, strict=True)
    return relative.Shown(
        jax.tree.map(lambda *of_pairs: jnp.stack(of_pairs), *firsts), jnp.asarray(np.stack(seconds))
    )


def _pair_factors(pairs: list[Pair], measured: relative.Relative, cfg: Config) -> Iterator[RelativePose]:
    """Of pairs that corners or enough surfaces join."""
    for number, pair in enumerate(pairs):
        T_first_second = np.asarray(measured.T_first_second[number])
        added = _covariance(measured.surfaces[number] + measured.colour[number])
        held = pair.seen is not None or measured.matched[number] >= MATCHED
        if added is None or not held or not np.isfinite(T_first_second).all():
            continue
        yield RelativePose(
            pair.first,
            pair.second,
            rigid(T_first_second),
            SIGMA_RAD,
            SIGMA_M,
            added=added,
            cauchy=cfg.pairs.robust,
        )


def _covariance(information: ArrayLike) -> Float64[np.ndarray, "6 6"] | None:
    """The inverse, for a tangent (rotation, translation) as the pose graph has it; None of what has none, where the
    rounding of single precision exceeds what little holds a pair."""
    firm = np.asarray(information, np.float64)
    if not np.isfinite(firm).all() or np.linalg.eigvalsh(firm)[0] <= 0:
        return None
    covariance, order = np.linalg.inv(firm), [3, 4, 5, 0, 1, 2]
    # Symmetric again after rounding, as the pose graph demands
    covariance = (covariance + covariance.T)[np.ix_(order, order)] / 2
    return covariance if np.linalg.eigvalsh(covariance)[0] > 0 else None


def _as_tracked(
    poses: Float64[np.ndarray, "N 4 4"], measured: set[int], begins: int, cfg: Config
) -> Iterator[RelativePose]:
    """Keyframes that no pair joins to an earlier one stay where they are beside the one before; the first of this
    recording, of index `begins`, beside the nearest, since nothing tracked the camera from an earlier one to it."""
    for second in sorted(set(range(1, len(poses))) - measured):
        first = second - 1
        if second == begins:
            first = int(np.argmin(np.linalg.norm(poses[:second, :3, 3] - poses[second, :3, 3], axis=1)))
        between = inverse(poses[first]) @ poses[second]
        yield RelativePose(first, second, between, cfg.loop.sigma_rotation, cfg.loop.sigma)


def _link_factors(state: SlamState, ids: list[RecordId], cfg: Config) -> Iterator[RelativePose]:
    """Of frames that were registered in another submap, beside its keyframe that is nearest to them: a loop that was
    closed stays closed where its keyframes are too far apart for a pair."""
    index = {keyframe_id: i for i, keyframe_id in enumerate(ids)}
    for submap_id in sorted(joined(state, FIRST)):
        submap = state.submaps[submap_id]
        own = [k for k in submap.keyframes if state.records[k.id].submap == submap_id]
        for keyframe in submap.keyframes:
            tracked_in = state.records[keyframe.id].submap
            begun = tracked_in == submap.parent or state.submaps[tracked_in].parent == submap_id
            if tracked_in == submap_id or begun or not own:
                continue
            (beside,) = nearest(own, keyframe.T_sub_cam, 1)
            yield RelativePose(
                index[beside.id],
                index[keyframe.id],
                inverse(beside.T_sub_cam) @ keyframe.T_sub_cam,
                cfg.loop.sigma_rotation,
                cfg.loop.sigma,
                cauchy=cfg.pairs.robust,
            )


def _moved(state: SlamState, T_world_cam: dict[RecordId, Pose]) -> SlamState:
    """The state with keyframes at these poses, and submaps where their anchors are."""
    for submap_id in joined(state, FIRST):
        keyframes = state.submaps[submap_id].keyframes
        T_world_sub = T_world_cam[keyframes[0].id]
        there = (k._replace(T_sub_cam=inverse(T_world_sub) @ T_world_cam[k.id]) for k in keyframes[1:])
        state = state.with_submap(submap_id, keyframes=(keyframes[0], *there), T_world_sub=T_world_sub)
    return state
