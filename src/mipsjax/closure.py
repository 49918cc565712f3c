"""Loops: finding a known place again, and moving the submaps so that it is one place (Section 3.5 of the paper)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mipsjax.bundle import MATCH, mapping_camera
from mipsjax.config import Config
from mipsjax.core import correspond
from mipsjax.host.factors import Factor, PointToPlane, RelativePose
from mipsjax.host.features import Features, similar
from mipsjax.host.registration import relative_pose
from mipsjax.links import Link, best_link, disagreement, hops, linked_pairs, links, sigmas
from mipsjax.state import How, Keyframe, Loop, Pose, SlamState, Submap, distance, last_pose
from mipsjax.territory import Sighting, link, sight

EVERY = 3  # pixels between measured points from which surface points are sought


def recognise(state: SlamState, keyframe: Keyframe, places: list[int], cfg: Config) -> Sighting | None:
    """The frame in one of some submaps, by its image: similar keyframes, matched features, then the field itself."""
    stored = [
        (place, k) for place in places for k in state.submaps[place].keyframes if k.features is not None
    ]
    if keyframe.features is None or not stored:
        return None
    database: list[Features] = [k.features for _, k in stored if k.features is not None]
    for i in similar(keyframe.features, database, cfg.loop.candidates):
        place, other = stored[i]
        seed = int(np.random.default_rng((cfg.seed, MATCH, keyframe.number, i)).integers(2**31))
        match = relative_pose(keyframe.features, database[i], state.camera, seed)
        if match.ok:
            found = sight(state, place, keyframe, other.T_sub_cam @ match.T_other_current, cfg)
            if found is not None:
                return found
    return None


def close(state: SlamState, sightings: list[Sighting], before: SlamState, cfg: Config) -> SlamState:
    """After a new keyframe of the active submap: loops are looked for, and the pose graph is solved where it disagrees.

    `sightings` are the submaps in whose box the frame was found, `before` the state without their links.
    """
    keyframe = state.submap.keyframes[-1]
    away = hops(before, before.active)
    loops: list[tuple[Sighting, How]] = [
        (found, "box") for found in sightings if away[found.submap] >= cfg.loop.apart
    ]
    if cfg.loop.features:
        taken = {found.submap for found in sightings}
        far = [p for p, n in enumerate(away) if n >= cfg.loop.apart and p not in taken]
        found = recognise(state, keyframe, far, cfg)
        if found is not None:
            state = link(state, keyframe, found)
            loops.append((found, "features"))
    seen = [found.submap for found in sightings] + [found.submap for found, how in loops if how == "features"]
    if not loops and all(_agrees(state, place, cfg) for place in seen):
        return state
    suspects = {_pair(loop.first, loop.second) for loop in state.loops}
    suspects |= {_pair(state.active, found.submap) for found, _ in loops}
    solved, weights = solve(state, suspects, cfg)
    moved = distance(_world(state), _world(solved))
    made = tuple(
        Loop(
            frame=keyframe.number,
            first=state.active,
            second=found.submap,
            how=how,
            inliers=found.inliers,
            correction_m=moved[0],
            correction_rad=moved[1],
            weight=weights[_pair(state.active, found.submap)],
        )
        for found, how in loops
    )
    for loop in made:
        if not loop.weight:
            solved = _unlinked(solved, loop.second, keyframe.number)
    return solved._replace(loops=(*state.loops, *made))


def solve(
    state: SlamState, suspects: set[tuple[int, int]], cfg: Config
) -> tuple[SlamState, dict[tuple[int, int], float]]:
    """Submap poses from all links and matched surfaces, and the weight of every linked pair. Fields stay as they are.

    Only `suspects`, pairs that met by a loop, may be rejected: all other links were seen from a pose that tracking
    had brought there.
    """
    from mipsjax.host.posegraph import (
        solve as solve_graph,
    )  # gtsam takes a second to load; most runs need none

    pairs, factors, owner = linked_pairs(state), [], []
    for pair in pairs:
        for factor in _factors(state, *pair, pair not in suspects, cfg):
            factors.append(factor)
            owner.append(pair)
    poses = np.stack([submap.T_world_sub for submap in state.submaps])
    found = solve_graph(poses, factors)
    weights = {pair: 1.0 for pair in pairs}
    for pair, weight in zip(owner, found.weights, strict=True):
        weights[pair] = min(weights[pair], float(weight))
    for place, pose in enumerate(found.T_world_sub):
        state = state.with_submap(place, T_world_sub=pose)
    return state, weights


def _factors(state: SlamState, j: int, k: int, trusted: bool, cfg: Config) -> list[Factor]:
    """What is measured between two submaps: their best shared frame, and surfaces that both know around it."""
    first, second = state.submaps[j], state.submaps[k]
    shared = best_link(first, second)
    assert shared is not None
    turn, shift = sigmas(shared, cfg)
    factors: list[Factor] = [RelativePose(j, k, shared.T_first_second, turn, shift, trusted)]
    p_first, n_first, q_second = _matched(first, second, shared, state, cfg)
    if len(p_first) >= cfg.loop.fewest_points:
        sigma, count = cfg.loop.points_sigma, cfg.loop.effective_points
        factors.append(PointToPlane(j, k, p_first, n_first, q_second, sigma, trusted, count))
    return factors


def _matched(
    first: Submap, second: Submap, shared: Link, state: SlamState, cfg: Config
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Surface points of the first submap in frames that both share, their normals, and the second's points."""
    measured = np.concatenate([_unprojected(link.first, state, cfg) for link in links(first, second)])
    start, mask = correspond.fixed_size(measured, cfg)
    surface = correspond.surface_points(first.learned.field, start, mask, cfg)
    T_second_first = jnp.asarray(np.linalg.inv(shared.T_first_second), jnp.float32)
    matches = correspond.match(second.learned.field, T_second_first, surface, cfg)
    surface, matches = jax.device_get((surface, matches))
    kept = matches.mask
    p, n, q = (np.asarray(a[kept], np.float64) for a in (surface.points, surface.normals, matches.q_k))
    return p, n, q


def _unprojected(keyframe: Keyframe, state: SlamState, cfg: Config) -> Float[np.ndarray, "N 3"]:
    """Measured points of a keyframe, submap frame, metres; one in `EVERY` pixels each way is plenty."""
    camera = mapping_camera(state.camera, cfg)
    v, u = (x.ravel() for x in np.mgrid[0 : camera.height : EVERY, 0 : camera.width : EVERY])
    depth = keyframe.depth[v, u].astype(np.float64)
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], 1)
    p_cam = (ray * depth[:, None])[(depth > 0) & (depth < cfg.volume.far)]
    return p_cam @ keyframe.T_sub_cam[:3, :3].T + keyframe.T_sub_cam[:3, 3]


def _agrees(state: SlamState, place: int, cfg: Config) -> bool:
    """The newest frame has the same world pose by both of its submaps, within the tolerance."""
    newest = Link(state.submap.keyframes[-1], state.submaps[place].keyframes[-1])
    return disagreement(state, state.active, place, newest) < cfg.loop.tolerance


def _unlinked(state: SlamState, place: int, number: int) -> SlamState:
    """Without a frame as a keyframe of a submap it turned out not to show."""
    kept = tuple(k for k in state.submaps[place].keyframes if k.number != number)
    return state.with_submap(place, keyframes=kept)


def _pair(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)


def _world(state: SlamState) -> Pose:
    return state.submap.T_world_sub @ last_pose(state)
