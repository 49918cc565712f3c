"""Pose graph: residuals against their definition, derivatives, scipy as an oracle, false loops, bad input."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mipsjax.core.rigid import angles
from mipsjax.loops import factors as fs
from mipsjax.loops import posegraph
from mipsjax.loops.factors import FactorError, PointToPlane, RelativePose
from mipsjax.loops.posegraph import solve

ROUNDING = 1e-9
"""A few hundred double operations on numbers up to a hundred."""
CONVERGED = 1e-6
"""Metres and radians: the solver stops at a relative decrease of 1e-10 of a squared error."""
DERIVATIVE = 1e-6
"""Central differences with a step of 1e-5 of functions with second and third derivatives near 10."""


def pose(rotvec, translation):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), translation
    return T


def random_pose(rng, metres=3.0, radians=2.0):
    return pose(rng.normal(size=3) * radians / 2, rng.normal(size=3) * metres)


def noise(rng, metres, radians):
    return pose(rng.normal(size=3) * radians, rng.normal(size=3) * metres)


def exp(xi):
    """In the order of GTSAM, by its own map: a wrong order in ours shows."""
    return gtsam.Pose3.Expmap(xi).matrix()


def relative(T, j, k):
    return np.linalg.inv(T[j]) @ T[k]


def ring(submaps):
    """Poses on a circle, looking outward, 4 m apart."""
    radius, turns = 2 / np.sin(np.pi / submaps), 2 * np.pi * np.arange(submaps) / submaps
    return np.stack([pose([0, 0, a], radius * np.array([np.cos(a), np.sin(a), 0.0])) for a in turns])


def chained(truth, rng, metres, radians):
    """Sequential edges with this noise on each axis, which they also claim, and the poses they give."""
    edges, T = [], [truth[0]]
    for k in range(1, len(truth)):
        measured = relative(truth, k - 1, k) @ noise(rng, metres, radians)
        edges.append(RelativePose(k - 1, k, measured, radians, metres, trusted=True))
        T.append(T[-1] @ measured)
    return np.stack(T), edges


def pose_edge(j, k, T_j_k, rng, metres=0.003, radians=0.001):
    return RelativePose(j, k, T_j_k @ noise(rng, metres, radians), radians, metres)


def wall_edge(j, k, T_j_k, rng, each=100, metres=0.003, sigma=0.01):
    """Points on three walls around the middle of both submaps."""
    n = np.repeat(np.eye(3), each, axis=0)
    p = T_j_k[:3, 3] / 2 + rng.uniform(-2, 2, n.shape) * (1 - n) + 1.5 * n
    T_k_j = np.linalg.inv(T_j_k)
    q = (p + rng.normal(size=(len(p), 1)) * metres * n) @ T_k_j[:3, :3].T + T_k_j[:3, 3]
    return PointToPlane(j, k, p, n, q, sigma)


def gross(rng):
    """A motion of 3 to 5 m and 60 to 120 degrees."""
    shift, turn = rng.normal(size=(2, 3))
    return pose(
        turn / np.linalg.norm(turn) * np.radians(rng.uniform(60, 120)),
        shift / np.linalg.norm(shift) * rng.uniform(3, 5),
    )


def plane_residuals(factor, T):
    """The definition, Eq. 20, point by point."""
    T_j_k = relative(T, factor.first, factor.second)
    moved = factor.q_second @ T_j_k[:3, :3].T + T_j_k[:3, 3]
    return np.sum((factor.p_first - moved) * factor.n_first, axis=1)


def random_planes(rng, points, **fields):
    n = rng.normal(size=(points, 3))
    p, q = rng.normal(size=(2, points, 3)) * 3
    return PointToPlane(0, 1, p, n / np.linalg.norm(n, axis=1, keepdims=True), q, 0.1, **fields)


def assert_same_poses(found, expected, tolerance):
    np.testing.assert_allclose(found, expected, atol=tolerance)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([1, 2, 12, 13, 14, 300]))
def test_compression_keeps_the_sum_of_squares_at_every_pose(seed, points):
    rng = np.random.default_rng(seed)
    factor = random_planes(rng, points)
    rows = fs.compress(factor.p_first, factor.n_first, factor.q_second)
    assert len(rows) == min(points, 13)
    for _ in range(3):
        T = np.stack([random_pose(rng), random_pose(rng)])
        found, _, _ = fs.plane_residual(rows, relative(T, 0, 1))
        assert np.sum(found**2) == pytest.approx(np.sum(plane_residuals(factor, T) ** 2), rel=ROUNDING)


@pytest.mark.parametrize("far", [False, True])
def test_what_no_pose_mends_is_chi_squared_of_the_points_alone(far):
    """N residuals less the six of the pose; a far start must not end in another minimum."""
    rng = np.random.default_rng(0)
    T = ring(4)
    factor = wall_edge(
        1, 3, relative(T, 1, 3) @ (gross(rng) if far else np.eye(4)), rng, metres=0.02, sigma=0.02
    )
    factor = factor._replace(effective_points=300.0)
    problem = posegraph._Problem(T, [factor], [posegraph._made(factor)])
    found = 2 * posegraph._error_alone(problem, 0)
    assert found == pytest.approx(294, abs=4 * np.sqrt(2 * 294))  # four standard deviations


@pytest.mark.parametrize("sigma", [0.002, 0.01, 0.05])
def test_a_true_loop_is_kept_whatever_its_points_claim(sigma):
    """Noise of 1 cm: how badly points fit their planes says nothing about the chain."""
    rng = np.random.default_rng(11)
    truth = ring(4)
    start, chain = chained(truth, rng, 0.1, 0.05)
    walls = wall_edge(0, 3, relative(truth, 0, 3), rng, metres=0.01, sigma=sigma)
    assert solve(start, [*chain, walls]).weights.all()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["pose", "planes", "few planes"])
def test_derivatives_of_every_factor_are_numerical_ones(kind, seed):
    rng = np.random.default_rng(seed)
    T = np.stack([random_pose(rng), random_pose(rng)])
    factor = random_planes(rng, 40 if kind == "planes" else 5)
    if kind == "pose":
        # near enough that the logarithm is smooth: its derivative jumps at an angle of pi
        factor = RelativePose(0, 1, relative(T, 0, 1) @ noise(rng, 0.5, 0.5), 0.2, 0.1)
    made = posegraph._made(factor)
    slope, right = made.linearize(posegraph._values(T)).jacobian()
    np.testing.assert_allclose(right, -whitened(made, T), atol=ROUNDING)
    step = 1e-5
    for column in range(12):
        xi = np.zeros((2, 6))
        xi.ravel()[column] = step
        ahead, behind = (np.stack([T[i] @ exp(s * xi[i]) for i in range(2)]) for s in (1, -1))
        numerical = (whitened(made, ahead) - whitened(made, behind)) / (2 * step)
        np.testing.assert_allclose(slope[:, column], numerical, atol=DERIVATIVE * np.abs(slope).max())


def whitened(made, T):
    return made.whitenedError(posegraph._values(T))


def test_the_pose_error_is_that_of_the_paper_in_another_frame():
    """Eq. 21: log(M T_s^-1 T_r), against GTSAM's log(M^-1 T_r^-1 T_s): Ad(M) takes one to minus the other."""
    rng = np.random.default_rng(5)
    T = np.stack([random_pose(rng), random_pose(rng)])
    M = relative(T, 0, 1) @ noise(rng, 0.3, 0.3)
    ours = whitened(posegraph._made(RelativePose(0, 1, M, 1.0, 1.0)), T)
    paper = gtsam.Pose3.Logmap(gtsam.Pose3(M @ relative(T, 1, 0)))
    np.testing.assert_allclose(gtsam.Pose3(M).AdjointMap() @ ours, -paper, atol=ROUNDING)


def test_the_error_is_half_of_chi_squared_of_the_independent_points():
    rng = np.random.default_rng(6)
    T = np.stack([random_pose(rng), random_pose(rng)])
    for points, weight in ((20, 1.0), (200, 50 / 200)):
        factor = random_planes(rng, points, trusted=True)
        expected = 0.5 * weight * np.sum((plane_residuals(factor, T) / factor.sigma) ** 2)
        assert solve(T, [factor]).error_before == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("kind", ["pose", "planes", "both"])
def test_exact_measurements_give_the_true_poses(kind):
    rng = np.random.default_rng(7)
    truth = np.stack([random_pose(rng) for _ in range(5)])
    pairs = [(0, 1), (1, 2), (3, 2), (3, 4), (0, 4)]
    factors = []
    for number, (j, k) in enumerate(pairs):
        if kind == "pose" or (kind == "both" and number % 2):
            factors.append(RelativePose(j, k, relative(truth, j, k), 0.01, 0.01))
        else:
            factors.append(wall_edge(j, k, relative(truth, j, k), rng, metres=0.0))
    start = truth.copy()
    start[1:] = [T @ noise(rng, 0.3, 0.15) for T in truth[1:]]
    found = solve(start, factors)
    assert found.ok and found.weights.all()
    assert_same_poses(found.T_world_sub, truth, CONVERGED)
    np.testing.assert_array_equal(found.T_world_sub[0], start[0])
    assert found.error_after < CONVERGED < found.error_before


def test_scipy_finds_the_same_poses():
    """Independent residuals and parameters (a rotation vector and a translation a pose)."""
    rng = np.random.default_rng(8)
    truth = ring(4)
    start, chain = chained(truth, rng, 0.1, 0.05)
    factors = [*chain, pose_edge(0, 3, relative(truth, 0, 3), rng, 0.05, 0.02)]
    factors.append(wall_edge(1, 3, relative(truth, 1, 3), rng))

    def poses(x):
        return np.stack([truth[0], *(pose(v[:3], v[3:]) for v in x.reshape(-1, 6))])

    def residuals(x):
        T, out = poses(x), []
        for f in factors:
            if isinstance(f, RelativePose):
                e = gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(f.T_first_second) @ relative(T, *f[:2])))
                out.append(e / np.repeat([f.sigma_rotation, f.sigma_translation], 3))
            else:
                out.append(plane_residuals(f, T) / f.sigma * np.sqrt(f.effective_points / len(f.p_first)))
        return np.concatenate(out)

    x = np.concatenate([[*Rotation.from_matrix(T[:3, :3]).as_rotvec(), *T[:3, 3]] for T in start[1:]])
    best = least_squares(residuals, x, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    found = solve(start, factors, robust=False)
    assert found.error_after == pytest.approx(best.cost, rel=1e-6)
    assert_same_poses(found.T_world_sub, poses(best.x), 10 * CONVERGED)  # two solvers' tolerances


def test_the_world_frame_does_not_matter():
    rng = np.random.default_rng(9)
    truth = ring(5)
    start, chain = chained(truth, rng, 0.1, 0.05)
    factors = [*chain, wall_edge(0, 4, relative(truth, 0, 4), rng)]
    moved = random_pose(rng, 20.0)
    assert_same_poses(
        solve(moved @ start, factors).T_world_sub, moved @ solve(start, factors).T_world_sub, 10 * CONVERGED
    )


def test_more_points_of_one_surface_weigh_no_more():
    rng = np.random.default_rng(10)
    truth = ring(4)
    start, chain = chained(truth, rng, 0.05, 0.02)
    walls = wall_edge(0, 3, relative(truth, 0, 3), rng, metres=0.05, sigma=0.05)
    double = walls._replace(
        **{name: np.repeat(getattr(walls, name), 2, axis=0) for name in ("p_first", "n_first", "q_second")}
    )
    once, twice = (solve(start, [*chain, w]) for w in (walls, double))
    assert_same_poses(once.T_world_sub, twice.T_world_sub, 10 * CONVERGED)
    more = solve(start, [*chain, walls._replace(effective_points=100.0)])
    assert np.abs(more.T_world_sub - once.T_world_sub).max() > 100 * CONVERGED


def closing(submaps, edge, seed, false_loops):
    """Start and end errors of the last submap, in metres and radians, and the weights of the loops."""
    rng = np.random.default_rng(seed)
    truth = ring(submaps)
    # a whole of 0.5 m and 10 degrees on each axis, so that the noise of the loop is under 1 % of it
    start, chain = chained(truth, rng, 0.5 / np.sqrt(submaps - 1), np.radians(10) / np.sqrt(submaps - 1))
    loops = [edge(0, submaps - 1, relative(truth, 0, submaps - 1), rng)]
    pairs = [(j, k) for j in range(submaps) for k in range(j + 2, submaps)]
    for i in rng.choice(len(pairs), false_loops, replace=False):
        loops.append(edge(*pairs[i], relative(truth, *pairs[i]) @ gross(rng), rng))
    found = solve(start, [*chain, *loops])
    assert found.ok
    return error(start, truth), error(found.T_world_sub, truth), found.weights[submaps - 1 :]


def error(T, truth):
    """Of the last submap, metres and radians."""
    turned = truth[-1:, :3, :3].swapaxes(1, 2) @ T[-1:, :3, :3]
    return np.array([np.linalg.norm(T[-1, :3, 3] - truth[-1, :3, 3]), angles(turned)[0]])


@pytest.mark.parametrize("edge", [pose_edge, wall_edge])
@pytest.mark.parametrize("submaps", [4, 6, 10])
@pytest.mark.parametrize("seed", range(3))
def test_a_loop_removes_its_error_among_false_ones_too(submaps, edge, seed):
    before, after, weights = closing(submaps, edge, seed, false_loops=0)
    assert weights.all()
    assert (after < 0.05 * before).all()
    _, among_false, weights = closing(submaps, edge, seed, false_loops=3)
    np.testing.assert_array_equal(weights, [1, 0, 0, 0])
    assert (among_false < 0.1 * before).all()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.fault(37)
def test_five_false_loops_of_twelve(seed):
    rng = np.random.default_rng(seed)
    truth = np.concatenate([ring(10), ring(10)])  # two rounds
    start, chain = chained(truth, rng, 0.1, 0.03)
    loops = [pose_edge(j, j + 10, relative(truth, j, j + 10), rng) for j in range(7)]
    loops += [
        pose_edge(j, k, relative(truth, j, k) @ gross(rng), rng)
        for j, k in ((0, 5), (2, 9), (3, 17), (8, 12), (4, 19))
    ]
    shuffled = rng.permutation(12)
    found = solve(start, [*chain, *(loops[i] for i in shuffled)])
    np.testing.assert_array_equal(found.weights[19:], shuffled < 7)
    alone = solve(start, [*chain, *loops[:7]], robust=False)
    assert_same_poses(found.T_world_sub, alone.T_world_sub, 10 * CONVERGED)
    spoiled = solve(start, [*chain, *loops], robust=False)
    assert (
        spoiled.weights.all()
        and error(spoiled.T_world_sub, truth)[0] > 5 * error(found.T_world_sub, truth)[0]
    )


def test_a_robust_measurement_that_is_far_off_counts_for_little():
    """Three that agree to a millimetre, and one that is 3 m off; what is left of its pull is noise of the others."""
    rng = np.random.default_rng(22)
    truth = ring(3)
    wrong = relative(truth, 0, 2) @ gross(rng)
    edges = [pose_edge(j, k, relative(truth, j, k), rng) for j, k in ((0, 1), (1, 2), (0, 2))]
    edges.append(pose_edge(0, 2, wrong, rng))
    off = []
    for scale in (np.inf, 3.0):
        found = solve(truth, [edge._replace(cauchy=scale) for edge in edges], robust=False)
        assert found.ok
        off.append(error(found.T_world_sub, truth)[0])
    assert off[0] > 0.5 and off[1] < 0.01


def test_an_agreeing_measurement_counts_in_full_however_robust():
    rng = np.random.default_rng(23)
    truth = ring(3)
    edges = [pose_edge(j, k, relative(truth, j, k), rng) for j, k in ((0, 1), (1, 2), (0, 2))]
    whole, robust = (
        solve(truth, [edge._replace(cauchy=scale) for edge in edges], robust=False)
        for scale in (np.inf, 100.0)
    )
    # The Cauchy weight of a residual of two deviations is 0.9996
    assert_same_poses(robust.T_world_sub, whole.T_world_sub, 1e-5)


def test_a_loop_moves_what_was_loose_and_leaves_what_was_tight():
    """One of the edges of a ring slid along its x, and says so."""
    rng = np.random.default_rng(21)
    truth = ring(8)
    start, chain = chained(truth, rng, 0.005, 0.001)
    slide = pose([0, 0, 0], [0.5, 0, 0])
    added = np.zeros((6, 6))
    added[3, 3] = 0.5**2
    slid = chain[3]._replace(T_first_second=chain[3].T_first_second @ slide, added=added)
    edges = [*chain[:3], slid, *chain[4:]]
    for k in range(4, 8):
        start[k] = start[k - 1] @ edges[k - 1].T_first_second
    found = solve(start, [*edges, pose_edge(0, 7, relative(truth, 0, 7), rng)])
    assert found.weights.all()
    off = np.linalg.norm((found.T_world_sub - truth)[:, :3, 3], axis=1)
    assert off.max() < 0.05, "of half a metre"


def test_three_true_loops_outvote_one_that_repeats_the_drift():
    """The false one agrees with the chain exactly and comes first; each true one contradicts it."""
    rng = np.random.default_rng(12)
    truth = ring(8)
    start, chain = chained(truth, rng, 0.1, 0.03)
    drift = RelativePose(0, 7, relative(start, 0, 7), 0.001, 0.003)
    true = [pose_edge(j, k, relative(truth, j, k), rng) for j, k in ((0, 7), (0, 6), (1, 7))]
    np.testing.assert_array_equal(solve(start, [*chain, drift, *true]).weights[7:], [0, 1, 1, 1])
    assert solve(start, [*chain, drift]).weights.all()


def test_a_trusted_factor_is_never_rejected():
    rng = np.random.default_rng(13)
    truth = ring(5)
    start, chain = chained(truth, rng, 0.05, 0.02)
    false = pose_edge(0, 4, relative(truth, 0, 4) @ gross(rng), rng)
    assert solve(start, [*chain, false]).weights[-1] == 0
    assert solve(start, [*chain, false._replace(trusted=True)]).weights[-1] == 1


@pytest.mark.fault(38)
def test_every_connected_part_keeps_its_lowest_submap():
    rng = np.random.default_rng(14)
    truth = np.stack([random_pose(rng) for _ in range(7)])
    start = np.stack([T @ noise(rng, 0.1, 0.05) for T in truth])
    factors = [
        pose_edge(j, k, relative(truth, j, k), rng)._replace(trusted=True)
        for j, k in ((0, 4), (5, 2), (6, 5))
    ]
    found = solve(start, factors)
    assert found.ok
    for kept in (0, 1, 2, 3):  # anchors of 0-4 and 2-5-6, and two submaps that nothing measures
        np.testing.assert_array_equal(found.T_world_sub[kept], start[kept])
    for f in factors:
        assert_same_poses(relative(found.T_world_sub, *f[:2]), f.T_first_second, CONVERGED)


@pytest.mark.fault(38)
def test_no_system_without_an_anchor_is_solved(monkeypatch):
    """Sequential edges in two parts, a true loop and a false one between them, a submap apart."""
    rng = np.random.default_rng(20)
    truth = np.stack([random_pose(rng) for _ in range(6)])
    start, chain = chained(truth, rng, 0.05, 0.02)
    loops = [
        pose_edge(0, 3, relative(truth, 0, 3), rng),
        pose_edge(1, 4, relative(truth, 1, 4) @ gross(rng), rng),
    ]
    weakest, optimised = [], posegraph._optimised

    def watched(graph, T):
        hessian, _ = graph.linearize(posegraph._values(T)).hessian()
        weakest.append(np.linalg.eigvalsh(hessian)[0])
        return optimised(graph, T)

    monkeypatch.setattr(posegraph, "_optimised", watched)
    assert solve(start, [chain[0], chain[1], chain[3], *loops]).ok
    # A free part has eigenvalues of rounding; the weakest mode of these parts has 20
    assert len(weakest) > 3 and min(weakest) > 1


@pytest.mark.fault(38)
def test_a_part_that_hung_on_a_false_loop_stays():
    rng = np.random.default_rng(15)
    truth = ring(6)
    start, chain = chained(truth, rng, 0.05, 0.02)
    del chain[2]  # now 0-1-2 and 3-4-5
    true, false = (
        pose_edge(0, 4, relative(truth, 0, 4), rng),
        pose_edge(1, 5, relative(truth, 1, 5) @ gross(rng), rng),
    )
    trusted = [*chain, true._replace(trusted=True)]
    assert_same_poses(
        solve(start, [*trusted, false]).T_world_sub, solve(start, trusted).T_world_sub, 10 * CONVERGED
    )
    found = solve(start, [*chain, true, false])
    assert found.ok and found.weights[-2:].sum() == 1  # nothing says which, but both cannot be


def test_a_direction_that_nothing_measures_keeps_its_place():
    """One plane fixes a distance and two angles; the submap must not slide along it or turn in it."""
    rng = np.random.default_rng(16)
    p = np.column_stack([rng.uniform(-1, 1, (60, 2)), np.ones(60)])
    n = np.tile([0.0, 0.0, 1.0], (60, 1))
    start = np.stack([np.eye(4), pose([0, 0, 0.3], [0.5, -0.2, 0.0])])
    T_k_j = np.linalg.inv(start[1])
    q = p @ T_k_j[:3, :3].T + T_k_j[:3, 3] + [0, 0, 0.1]
    for trusted in (True, False):
        found = solve(start, [PointToPlane(0, 1, p, n, q, 0.01, trusted)])
        assert found.ok and found.weights.all()
        assert_same_poses(found.T_world_sub[1], pose([0, 0, 0.3], [0.5, -0.2, -0.1]), CONVERGED)


GOOD_POSE = RelativePose(2, 1, np.eye(4), 0.1, 0.1)
GOOD_PLANES = random_planes(np.random.default_rng(17), 20)._replace(first=2, second=1)
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])
HOLED = np.where(np.eye(20, 3) > 0, np.nan, GOOD_PLANES.p_first)


@pytest.mark.parametrize(
    "bad",
    [
        *(GOOD_POSE._replace(sigma_rotation=s) for s in (0.0, -0.1, np.nan, np.inf, 1e-200)),
        *(GOOD_POSE._replace(sigma_translation=s) for s in (0.0, -0.1, np.nan, np.inf)),
        *(
            GOOD_POSE._replace(T_first_second=T)
            for T in (MIRROR, 2 * np.eye(4), np.eye(4) * np.nan, np.eye(3))
        ),
        GOOD_POSE._replace(T_first_second=pose([0, 0, 0], [np.inf, 0, 0])),
        *(
            GOOD_POSE._replace(added=c)
            for c in (-np.eye(6), np.full((6, 6), np.nan), np.eye(3), np.eye(6, k=1))
        ),
        *(GOOD_POSE._replace(cauchy=k) for k in (0.0, -1.0, np.nan)),
        *(GOOD_PLANES._replace(sigma=s) for s in (0.0, -0.1, np.nan)),
        *(GOOD_PLANES._replace(effective_points=s) for s in (0.0, -1.0, np.nan)),
        GOOD_PLANES._replace(p_first=HOLED),
        GOOD_PLANES._replace(q_second=HOLED),
        GOOD_PLANES._replace(n_first=HOLED),
        GOOD_PLANES._replace(n_first=2 * GOOD_PLANES.n_first),
        GOOD_PLANES._replace(q_second=GOOD_PLANES.q_second[:-1]),
        GOOD_PLANES._replace(p_first=np.zeros((0, 3)), n_first=np.zeros((0, 3)), q_second=np.zeros((0, 3))),
    ],
)
@pytest.mark.fault(39)
def test_a_bad_factor_is_refused_by_the_names_of_its_submaps(bad):
    with pytest.raises(FactorError, match="between submaps 2 and 1") as raised:
        solve(ring(4), [bad])
    assert raised.value.pair == (2, 1)


@pytest.mark.parametrize(("first", "second"), [(0, 4), (-1, 2), (1, 1)])
def test_a_factor_needs_two_submaps(first, second):
    with pytest.raises(FactorError, match=f"between submaps {first} and {second}"):
        solve(ring(4), [GOOD_POSE._replace(first=first, second=second)])


@pytest.mark.parametrize("bad", [np.nan * np.eye(4), MIRROR, 2 * np.eye(4)])
def test_a_bad_pose_is_refused_by_its_number(bad):
    T = ring(4)
    T[2] = bad
    with pytest.raises(ValueError, match="pose of submap 2"):
        solve(T, [])


def test_poses_need_the_right_shape():
    for T in (np.zeros((0, 4, 4)), np.eye(4)):
        with pytest.raises(ValueError, match="S x 4 x 4"):
            solve(T, [])


def test_without_factors_nothing_moves():
    for T in (ring(3), ring(3)[:1]):
        found = solve(T, [])
        assert found.ok and len(found.weights) == 0 and found.error_after < ROUNDING
        np.testing.assert_array_equal(found.T_world_sub, T)


def test_poses_in_single_precision_will_do():
    rng = np.random.default_rng(18)
    truth = ring(4)
    start, chain = chained(truth, rng, 0.1, 0.05)
    rough = start.astype(np.float32).astype(np.float64)
    found = solve(rough, [*chain, pose_edge(0, 3, relative(truth, 0, 3), rng)])
    np.testing.assert_array_equal(found.T_world_sub[0], rough[0])
    R = found.T_world_sub[1:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (3, 1, 1)), atol=ROUNDING)


def not_finite(graph, T):
    return np.full_like(T, np.nan)


def refused(graph, T):
    raise RuntimeError("indeterminate linear system")


def moved_apart(graph, T):
    return np.stack([pose([0, 0, 0], [3 * i, 0, 0]) @ pose_i for i, pose_i in enumerate(T)])


@pytest.mark.parametrize("solver", [not_finite, refused, moved_apart])
@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.fault(36)
def test_a_solver_that_fails_changes_nothing(monkeypatch, solver, robust):
    rng = np.random.default_rng(19)
    truth = ring(4)
    start, chain = chained(truth, rng, 0.1, 0.05)
    monkeypatch.setattr(posegraph, "_optimised", solver)
    found = solve(start, [*chain, pose_edge(0, 3, relative(truth, 0, 3), rng)], robust=robust)
    assert not found.ok
    np.testing.assert_array_equal(found.T_world_sub, start)
