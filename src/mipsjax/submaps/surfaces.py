"""Two submaps held together by the surfaces that both know: point-to-plane factors (Eqs. 19 and 20 of the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64

from mipsjax.config.sections import Config
from mipsjax.core import correspond, volume
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import transform
from mipsjax.loops.factors import PointToPlane, RelativePose
from mipsjax.submaps.bundle import unprojected
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.links import Link, SubmapPair, best_link, links, loose, sigmas
from mipsjax.submaps.state import Pose, Submap

EVERY = 3  # pixels between the measured points from which surface points are sought
ROUNDS = 4  # of matching and aligning: the pairs change as the submaps come closer
MATCHED = 0.5  # least share of the points in the other's box: less is another surface that happens to be near


class Pair(NamedTuple):
    """Two submaps, and the frame that says best how they lie."""

    first: Submap
    second: Submap
    link: Link
    ids: SubmapPair
    chained: bool
    """One was begun from the other."""


def pair_of(submaps: Sequence[Submap], ids: SubmapPair, cfg: Config) -> Pair:
    """The pair of two submaps that share a frame."""
    first, second = submaps[ids[0]], submaps[ids[1]]
    chained = second.parent == ids[0] or first.parent == ids[1]
    link = best_link(first, second, chained, cfg)
    assert link is not None
    return Pair(first, second, link, ids, chained)


def pose_factor(pair: Pair, trusted: bool, cfg: Config) -> RelativePose:
    """What the shared frame measures (Eq. 21).

    What is known to be loose of the frame's poses is added, so that a loop moves that and leaves what was tight.
    Along the chain of submaps it holds all the drift since the anchor. Elsewhere the frame was registered in a
    submap that it did not drift in.
    """
    turn, shift = sigmas(pair.link, cfg) if pair.chained else (cfg.loop.sigma_rotation, cfg.loop.sigma)
    T_first_second = pair.link.T_first_second
    return RelativePose(*pair.ids, T_first_second, turn, shift, trusted, loose(pair.link))


def plane_factor(pair: Pair, trusted: bool, camera: Intrinsics, cfg: Config) -> PointToPlane | None:
    """What the surfaces measure, from the pose of the shared frame; None where too little of them meets.

    Matching and aligning the two alone take turns: pairs found at the first pose need not be those of the last.
    None along the chain, too: there tracking has brought the surfaces together, drift and all, and a factor as tight as
    this would hold the drift where it is.
    """
    from mipsjax.loops.posegraph import solve  # gtsam takes a second to load, and one submap needs none

    if pair.chained:
        return None
    surface = _surface(pair, camera, cfg)
    prior = pose_factor(pair, True, cfg)._replace(first=0, second=1)
    T, found = pair.link.T_first_second, None
    for _ in range(ROUNDS):
        found = _matched(pair, surface, T, cfg)
        if found is None:
            return None
        T = solve(
            np.stack([np.eye(4), T]), [prior, found._replace(first=0, second=1, trusted=True)]
        ).T_world_sub[1]
    if found is None or _misfit(found, T) > cfg.loop.points_sigma:
        return None
    return found._replace(trusted=trusted)


def prepare(submap: Submap, camera: Intrinsics, cfg: Config) -> None:
    """Compiles what two submaps will need, on one submap and itself."""
    link = Link(submap.anchor, submap.anchor)
    itself = Pair(submap, submap, link, (SubmapId(0), SubmapId(0)), chained=False)
    _matched(itself, _surface(itself, camera, cfg), np.eye(4), cfg)


def _surface(pair: Pair, camera: Intrinsics, cfg: Config) -> correspond.Surface:
    """Of the first submap, in the frames that both share."""
    shared = [link.first for link in links(pair.first, pair.second)]
    measured = [unprojected(keyframe, camera, cfg.volume.far, EVERY, cfg) for keyframe in shared]
    start, mask = correspond.fixed_size(np.concatenate(measured), cfg)
    return correspond.surface_points(pair.first.learned.field, jnp.asarray(start), jnp.asarray(mask), cfg)


def _matched(
    pair: Pair, surface: correspond.Surface, T_first_second: Pose, cfg: Config
) -> PointToPlane | None:
    T_second_first = np.linalg.inv(T_first_second)
    matches = correspond.match(
        pair.second.learned.field, jnp.asarray(T_second_first, jnp.float32), surface, cfg
    )
    points, normals, mask, q, met = jax.device_get((*surface, matches.q_k, matches.mask))
    # What lies outside of the other's box is not missed there
    there = volume.inside(pair.second.box, transform(T_second_first, points.astype(np.float64)))
    expected = int((mask & there).sum())
    if met.sum() < max(cfg.loop.fewest_points, MATCHED * expected):
        return None
    p, n, q = (_kept(rows, met) for rows in (points, normals, q))
    return PointToPlane(*pair.ids, p, n, q, cfg.loop.points_sigma, effective_points=cfg.loop.effective_points)


def _kept(rows: np.ndarray, mask: Bool[np.ndarray, " N"]) -> Float64[np.ndarray, "M 3"]:
    return rows[mask].astype(np.float64)


def _misfit(factor: PointToPlane, T_first_second: Pose) -> float:
    """Median distance across the surface, metres."""
    q_first = transform(T_first_second, factor.q_second)
    return float(np.median(np.abs(np.sum((factor.p_first - q_first) * factor.n_first, 1))))
