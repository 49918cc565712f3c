"""Poses of all submaps from measurements between them: loop closure (Eq. 22 of the paper) on GTSAM.

A measurement comes from tracking, from matched features or from two fitted surfaces. An edge that repeats the
current estimate holds the drift where it is: none is added but where nothing else joins a pose to the others.

Sigmas decide. Closing a loop shares its error out over the edges in proportion to their variances, so those of
sequential edges have to be as large as drift really is. If they claim much less, a true loop is rejected as false.

False loops are rejected by truncated least squares: a factor costs its chi-squared if kept and a quantile if not.
Graduated non-convexity, GTSAM's `GncLMOptimizer`, seeks the same minimum but judges a factor by its own residual
alone. A chain is loose and a loop tight: of 243 rings closed by a true loop with three false ones beside it GNC lost
the true one in 217, since it drops whatever is far from the chain, drift or not. It cannot copy factors written in
Python either. So the set grows from the trusted factors, and a loop is judged by how much more all factors together
disagree once it is in: what it asks of the chain counts.

Departures: pose errors count squared (Eq. 22 adds norms without squares; rejection takes the part of a robust norm),
and a pose error is log(M^-1 T_a^-1 T_b), the same as Eq. 21 but for its sign, written in the frame of b.

Tangents are in GTSAM's order (rotation, translation), perturbations on the right: T exp(xi).
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri

from mipsjax.core.rigid import align_rigid
from mipsjax.loops.factors import (
    Factor,
    PointToPlane,
    Pose,
    RelativePose,
    check,
    compress,
    is_rigid,
    plane_residual,
    row_sigma,
)

log = logging.getLogger(__name__)

ANCHOR_SIGMA = 1e-3  # rad and m; only anchors fix the world frame, so any value gives the same poses
INLIER_PROBABILITY = 0.999  # share of true loops that is kept, if sigmas are right
GATE = float(chdtri(6, 1 - INLIER_PROBABILITY))  # of chi-squared: a pose has six degrees of freedom
TOLERANCE = 1e-10  # decrease of the error at which iterations end; poses are then good to micrometres
ROUNDING = 1e-9  # of an error, and absolute: two evaluations of the same poses differ by less

Poses = Float64[np.ndarray, "S 4 4"]


class Solution(NamedTuple):
    T_world_sub: Poses
    """The poses given, where `ok` is False."""
    weights: Float64[np.ndarray, "F"]
    """1 for a factor that was kept, 0 for one that was rejected as false."""
    error_before: float
    """Half the sum of squared residuals over sigma of the kept factors, at the poses given; where a factor has a Cauchy
    weight, its cost by that."""
    error_after: float
    """The same at the poses returned."""
    ok: bool
    """The solver ended at finite poses with no larger error."""


class _Fit(NamedTuple):
    """The best poses for some of the factors."""

    kept: Bool[np.ndarray, "F"]
    T_world_sub: Poses
    error: float


class _Problem(NamedTuple):
    T_start: Poses
    factors: Sequence[Factor]
    made: list[gtsam.NoiseModelFactor]
    """The same factors for GTSAM."""


def solve(T_world_sub: Poses, factors: Sequence[Factor], *, robust: bool = True) -> Solution:
    """Poses of all submaps that fit the factors best; with `robust`, after rejecting the false ones.

    The lowest-numbered submap of every connected part keeps its pose exactly, so submap 0 always stays. A part
    that hangs on rejected factors alone keeps its place, as does a direction that no factor measures.

    Raises:
        ValueError: a given pose is not a rigid motion.
        FactorError: a factor has a wrong index, shape, sigma or rotation, or is not finite.
    """
    # Checked before anything is solved: GTSAM carries NaN through without a word
    given = np.asarray(T_world_sub, np.float64)
    _check_poses(given)
    for factor in factors:
        check(factor, len(given))
    T_start = _matrices(_values(given), len(given))
    problem = _Problem(T_start, factors, [_made(factor) for factor in factors])
    kept = np.array([factor.trusted or not robust for factor in factors], bool)
    try:
        fit = _fit(problem, kept, T_start)
        if not kept.all():
            fit = _selected(problem, fit)
            log.info("pose graph: kept %d of %d factors", fit.kept.sum(), len(factors))
        before = _graph(problem, fit.kept).error(_values(T_start))
    except RuntimeError as trouble:  # GTSAM's word for a system that it cannot solve
        log.warning("pose graph not solved: %s", trouble)
        return Solution(given, kept.astype(np.float64), float("nan"), float("nan"), False)
    weights, T, after = fit.kept.astype(np.float64), fit.T_world_sub, fit.error
    if not np.isfinite(T).all() or not after <= before * (1 + ROUNDING) + ROUNDING:
        return Solution(given, weights, before, before, False)
    anchors = _anchors(problem, fit.kept)
    # Priors hold them to rounding only: here they are put back to the bit
    T[anchors] = given[anchors]
    return Solution(T, weights, before, after, True)


def _selected(problem: _Problem, trusted: _Fit) -> _Fit:
    """The trusted factors and those that together cost least by truncated least squares.

    From the factor that agrees best with the trusted ones to the one that agrees least. Where one that agrees with
    them is left out, because it contradicts those before it, the search is repeated with it in front.
    """
    candidates = np.flatnonzero(~trusted.kept).tolist()
    gates = {c: GATE + 2 * _error_alone(problem, c) for c in candidates}
    rises = {c: 2 * (_with(problem, trusted, c).error - trusted.error) for c in candidates}
    # From the one that agrees best: those that contradict it are then judged with it in place
    order = sorted(candidates, key=lambda c: rises[c] - gates[c])

    def cost(fit: _Fit) -> float:
        return 2 * fit.error + sum(gates[c] for c in candidates if not fit.kept[c])

    best = _grown(problem, trusted, order, gates)
    for c in [c for c in order if rises[c] < gates[c] and not best.kept[c]]:
        other = _grown(problem, trusted, [c, *(o for o in order if o != c)], gates)
        best = min(best, other, key=cost)
    return best


def _grown(problem: _Problem, fit: _Fit, order: Sequence[int], gates: dict[int, float]) -> _Fit:
    """With every factor, in this order, that raises chi-squared by less than its gate; until none does."""
    size = -1
    while size < fit.kept.sum():
        size = fit.kept.sum()
        for c in [c for c in order if not fit.kept[c]]:
            more = _with(problem, fit, c)
            if 2 * (more.error - fit.error) < gates[c]:
                fit = more
    return fit


def _with(problem: _Problem, fit: _Fit, position: int) -> _Fit:
    kept = fit.kept.copy()
    kept[position] = True
    return _fit(problem, kept, fit.T_world_sub)


def _fit(problem: _Problem, kept: Bool[np.ndarray, "F"], T: Poses) -> _Fit:
    """Levenberg-Marquardt from `T` on the kept factors."""
    graph = _graph(problem, kept)
    found = _optimised(graph, T)
    return _Fit(kept, found, graph.error(_values(found)))


def _error_alone(problem: _Problem, position: int) -> float:
    """What no pose can mend: points that do not lie on the planes they correspond to are no matter of the chain.

    The second start, the points on each other, keeps a far loop from ending in a worse minimum.
    """
    factor = problem.factors[position]
    if isinstance(factor, RelativePose):
        return 0.0
    alone = np.arange(len(problem.factors)) == position
    matched = problem.T_start.copy()
    T_first_second = align_rigid(factor.q_second.astype(np.float64), factor.p_first.astype(np.float64))
    matched[factor.second] = matched[factor.first] @ T_first_second
    return min(_fit(problem, alone, T).error for T in (problem.T_start, matched))


def _graph(problem: _Problem, kept: Bool[np.ndarray, "F"]) -> gtsam.NonlinearFactorGraph:
    """The kept factors and a prior on the anchor of every connected part."""
    graph = gtsam.NonlinearFactorGraph()
    for made, keep in zip(problem.made, kept, strict=True):
        if keep:
            graph.add(made)
    noise = gtsam.noiseModel.Isotropic.Sigma(6, ANCHOR_SIGMA)
    for anchor in np.unique(_anchors(problem, kept)):
        graph.add(gtsam.PriorFactorPose3(int(anchor), _pose3(problem.T_start[anchor]), noise))
    return graph


def _anchors(problem: _Problem, kept: Bool[np.ndarray, "F"]) -> Int[np.ndarray, "S"]:
    """For each submap, the lowest number in its part of the graph of kept factors."""
    submaps = len(problem.T_start)
    pairs = np.array([f[:2] for f, keep in zip(problem.factors, kept, strict=True) if keep], int)
    first, second = pairs.reshape(-1, 2).T
    edges = coo_matrix((np.ones(len(first)), (first, second)), shape=(submaps, submaps))
    _, part = connected_components(edges, directed=False)
    return np.unique(part, return_index=True)[1][part]


def _made(factor: Factor) -> gtsam.NoiseModelFactor:
    if isinstance(factor, PointToPlane):
        return _plane_factor(factor)
    noise = gtsam.noiseModel.Gaussian.Covariance(factor.covariance)
    if np.isfinite(factor.cauchy):
        weight = gtsam.noiseModel.mEstimator.Cauchy.Create(factor.cauchy)
        noise = gtsam.noiseModel.Robust.Create(weight, noise)
    return gtsam.BetweenFactorPose3(factor.first, factor.second, _pose3(factor.T_first_second), noise)


def _plane_factor(factor: PointToPlane) -> gtsam.CustomFactor:
    rows = compress(factor.p_first, factor.n_first, factor.q_second)

    def residual(this, values, jacobians):
        T_first_second = values.atPose3(factor.first).between(values.atPose3(factor.second)).matrix()
        found, by_first, by_second = plane_residual(rows, T_first_second)
        if jacobians is not None:
            jacobians[0], jacobians[1] = by_first, by_second
        return found

    noise = gtsam.noiseModel.Isotropic.Sigma(len(rows), row_sigma(factor))
    return gtsam.CustomFactor(noise, [factor.first, factor.second], residual)


def _optimised(graph: gtsam.NonlinearFactorGraph, T: Poses) -> Poses:
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(TOLERANCE)
    params.setAbsoluteErrorTol(TOLERANCE)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, _values(T), params)
    return _matrices(optimizer.optimize(), len(T))


def _values(T: Poses) -> gtsam.Values:
    values = gtsam.Values()
    for number, pose in enumerate(T):
        values.insert(number, _pose3(pose))
    return values


def _matrices(values: gtsam.Values, submaps: int) -> Poses:
    return np.stack([values.atPose3(number).matrix() for number in range(submaps)])


def _pose3(T: Pose) -> gtsam.Pose3:
    """With the nearest exact rotation."""
    return gtsam.Pose3(gtsam.Rot3.ClosestTo(T[:3, :3]), T[:3, 3])


def _check_poses(T_world_sub: Poses) -> None:
    if T_world_sub.ndim != 3 or len(T_world_sub) == 0:
        raise ValueError(f"submap poses must be an array S x 4 x 4, not {T_world_sub.shape}")
    for number, pose in enumerate(T_world_sub):
        if not is_rigid(pose):
            raise ValueError(f"the pose of submap {number} is not a rigid motion: {pose.tolist()}")
