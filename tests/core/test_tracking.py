"""Tracking in the map of an analytic scene: how far off a start is still found, and what breaks cleanly."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from corner import ADAM, CAMERA, CFG, HOME, WALLS, apart, pose, see, unprojected
from planes import CFG as PLANE_CFG
from planes import plane

from mipsjax.core import equations, evidence, information, losses, solvers, tracking
from mipsjax.core import field as nf
from mipsjax.core.fit import draw_points, measure_fit
from mipsjax.core.photometric import Images
from mipsjax.core.rigid import transform
from mipsjax.core.views import Views, own_normals

pytestmark = pytest.mark.slow

KEY = jax.random.key(7)
WIDENING = np.float32(1)
TRUTH = HOME @ pose((2.0, 1.0, -1.0), (0.03, 0.02, -0.02))
"""Between the poses the map was learned from."""
NEAR = pose((1.2, -1.2, 1.0), (0.012, -0.012, 0.01))  # 2 degrees, 2 cm
FAR = [
    pose((8.0, -5.0, 3.0), (0.1, 0.1, -0.05)),  # 10 degrees, 15 cm
    pose((2.0, -9.0, -4.0), (-0.08, -0.12, 0.04)),
    pose((0.0, 10.0, 0.0), (0.15, 0.0, 0.0)),
    pose((-10.0, 0.0, 0.0), (0.0, -0.15, 0.0)),
]
# The field, not the method, is the limit: its finest cells are 5 cm, and every start ends at the same pose
TOLERANCE_M, TOLERANCE_DEG = 0.003, 0.15


@pytest.fixture(scope="module")
def frame() -> tuple[np.ndarray, np.ndarray]:
    return see(TRUTH)


@pytest.fixture(scope="module")
def points(frame) -> equations.Points:
    depth, color = frame
    return draw_points(KEY, depth, color, CFG.track.go.pixels, CAMERA)


@pytest.fixture(scope="module")
def lm(corner_map, points):
    """Levenberg-Marquardt alone, from a stack of starts."""
    one = partial(
        solvers.levenberg_marquardt,
        corner_map.field,
        seen=evidence.Evidence(points),
        part="whole",
        steps=CFG.track.go.steps,
        camera=CAMERA,
        cfg=CFG,
    )
    run = jax.jit(jax.vmap(lambda T: one(T)))
    return lambda starts: np.asarray(run(np.stack(starts).astype(np.float32)))


def track(field, frame, *candidates):
    depth, color = frame
    starts = np.stack(candidates).astype(np.float32)
    assert len(starts) == 2, "one shape, one compilation"
    return jax.device_get(tracking.track(field, depth, color, starts, WIDENING, KEY, CAMERA, CFG))


def test_points_are_those_of_the_depth_image(points, frame):
    inside = np.asarray(transform(jnp.asarray(TRUTH, jnp.float32), points.p_cam))
    assert np.abs(inside - WALLS).min(1).max() < 1e-5
    assert points.mask.all()


def test_pixels_without_depth_are_masked(frame):
    depth, color = frame
    depth = np.where(np.arange(CAMERA.width)[None] < 40, np.float32(0), depth)
    drawn = draw_points(KEY, depth, color, 300, CAMERA)
    assert 0.6 < np.mean(drawn.mask) < 0.8  # 88 of 128 columns
    np.testing.assert_array_equal(drawn.mask, drawn.p_cam[:, 2] > 0)


def test_the_map_is_accurate_enough_for_these_tests(corner_map, points):
    fit = measure_fit(corner_map.field, jnp.asarray(TRUTH, jnp.float32), points, "whole", CFG)
    assert float(fit.residual) < 0.01 and float(fit.known) > 0.95


@pytest.mark.parametrize("part", ["search", "whole"])
def test_the_normal_equations_against_automatic_derivatives(corner_map, points, part):
    """With weights of the robust cost alone, the slope is half the cost's gradient by a twist."""
    cfg = replace(CFG, track=replace(CFG.track, go=replace(CFG.track.go, uncertainty=False)))
    T = jnp.asarray(TRUTH @ NEAR, jnp.float32)

    def at(twist):
        return T @ jaxlie.SE3.exp(twist).as_matrix()

    def psi(twist):
        return nf.tsdf(corner_map.field, transform(at(twist), points.p_cam), CFG.field, part).psi

    @jax.jit
    def derivatives(twist):
        precision = equations.precisions(points, cfg)
        # A saturated point costs, but is not to pull
        pulls = jnp.abs(psi(twist)) < evidence.SATURATED * CFG.field.truncation

        def costs(xi):
            return precision * equations.robust_cost(psi(xi), cfg.track.go.robust)

        gradient = jax.grad(lambda xi: jnp.sum(pulls * costs(xi)))(twist)
        weight = precision * pulls / (1 + (psi(twist) / cfg.track.go.robust) ** 2)
        rows = jax.jacfwd(psi)(twist)
        expected = equations.System(jnp.sum(costs(twist)), rows.T * weight[None] @ rows, gradient / 2)
        return evidence.map_rows(corner_map.field, T, points, part, cfg).system(), expected

    for found, expected in zip(*derivatives(jnp.zeros(6)), strict=True):
        # Sums of 768 float32 numbers in another order, of which those of the slope partly cancel
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_points_count_by_the_noise_of_their_depth():
    z = jnp.array([0.5, 1.0, 2.0, 4.0, 0.0])
    points = equations.Points(jnp.stack([z, z, z], -1), jnp.zeros((5, 3)), z > 0)
    found = np.asarray(equations.precisions(points, CFG))
    assert found[-1] == 0 and found[:4].mean() == pytest.approx(1)
    noise = CFG.sensor.noise_growth * np.asarray(z[:4]) ** 2
    variance = CFG.sensor.noise_floor**2 + noise**2
    np.testing.assert_allclose(found[:4] * variance, found[0] * variance[0], rtol=1e-5)
    even = replace(CFG, sensor=replace(CFG.sensor, noise_growth=0.0))
    np.testing.assert_allclose(equations.precisions(points, even), points.mask)
    nothing = points._replace(mask=jnp.zeros(5, bool))
    np.testing.assert_array_equal(equations.precisions(nothing, CFG), 0)


@pytest.mark.parametrize("axis", range(6))
def test_lm_corrects_every_direction(lm, axis):
    """2 cm along, or 2 degrees about, each axis both ways: a wrong column of the Jacobian shows here."""
    twist = np.zeros(6)
    twist[axis] = 2.0 if axis < 3 else 0.02
    starts = [TRUTH @ pose(s * twist[:3], s * twist[3:]) for s in (1, -1)]
    for T in lm(starts):
        metres, degrees = apart(T, TRUTH)
        assert metres < TOLERANCE_M and degrees < TOLERANCE_DEG


def test_track_converges_from_near_without_a_search(corner_map, frame):
    start = TRUTH @ NEAR
    T, info = track(corner_map.field, frame, start, start)
    metres, degrees = apart(T, TRUTH)
    assert metres < TOLERANCE_M and degrees < TOLERANCE_DEG
    assert info.ok and not info.searched
    assert info.after.residual < info.before.residual and info.after.known > 0.9


def test_the_smooth_field_has_no_part_where_the_fine_one_is_enough(corner_map, frame):
    """It is less exact: what a frame hardly holds it would move."""
    start = TRUTH @ NEAR
    assert corner_map.field.smooth is not None
    blank = corner_map.field._replace(smooth=jax.tree.map(jnp.zeros_like, corner_map.field.smooth))
    (T, info), (with_blank, _) = (track(field, frame, start, start) for field in (corner_map.field, blank))
    assert not info.searched
    np.testing.assert_array_equal(T, with_blank)


def test_the_order_of_candidates_does_not_matter_where_one_is_clearly_better(corner_map, frame):
    good, bad = TRUTH @ NEAR, TRUTH @ pose((0, 40, 0), (0.5, 0, 0))
    one, _ = track(corner_map.field, frame, good, bad)
    other, _ = track(corner_map.field, frame, bad, good)
    np.testing.assert_array_equal(one, other)
    assert apart(one, TRUTH)[0] < TOLERANCE_M


@pytest.mark.parametrize(("metres", "share", "left"), [(0.085, (0.93, 0.99), False), (0.01, (0, 0.8), True)])
def test_the_first_candidate_is_left_for_one_that_fits_clearly_better(
    corner_map, frame, points, metres, share, left
):
    """Metres along the view. Shares keep off `track.rest`: `track` draws other points than these."""
    first, other = (TRUTH @ pose((0, 0, 0), (0, 0, d)) for d in (0.1, metres))
    misfit, misfit_other = (
        measure_fit(corner_map.field, jnp.asarray(T, jnp.float32), points, "search", CFG).residual
        for T in (first, other)
    )
    assert share[0] < misfit_other / misfit < share[1]
    begun = track(corner_map.field, frame, first, other)[1].before
    alone = track(corner_map.field, frame, *[other if left else first] * 2)[1].before
    assert begun.residual == alone.residual


@pytest.mark.parametrize("offset", range(len(FAR)))
def test_the_search_recovers_what_lm_alone_does_not(corner_map, frame, lm, offset):
    start = TRUTH @ FAR[offset]
    assert apart(start, TRUTH)[0] > 0.14
    (alone,) = lm([start])
    assert apart(alone, TRUTH)[0] > 0.02, "too easy a start shows nothing"
    T, info = track(corner_map.field, frame, start, start)
    metres, degrees = apart(T, TRUTH)
    assert info.searched
    assert metres < TOLERANCE_M and degrees < TOLERANCE_DEG


def test_adam_converges_from_a_small_offset(corner_map, points):
    """The paper's optimiser on d2t and colour; with steps of 1 cm and 0.57 degrees it ends near the truth."""
    start = TRUTH @ pose((0.5, -0.5, 0.3), (0.01, -0.005, 0.01))
    run = jax.jit(partial(solvers.adam, corner_map.field, points=points, trust=1.0, key=KEY, cfg=ADAM))
    T = np.asarray(run(start.astype(np.float32)))
    before, after = apart(start, TRUTH), apart(T, TRUTH)
    assert after[0] < 0.5 * before[0] and after[1] < 0.7 * before[1]
    assert after[0] < 0.005


@pytest.mark.fault(35, 36)
def test_a_broken_map_leaves_the_candidate(corner_map, frame):
    broken = jax.tree.map(lambda a: jnp.full_like(a, jnp.nan), corner_map.field)
    start = (TRUTH @ NEAR).astype(np.float32)
    T, info = track(broken, frame, start, start)
    np.testing.assert_array_equal(T, start)
    assert not info.ok


def test_a_frame_without_depth_gives_a_finite_pose(corner_map, frame):
    depth, color = frame
    start = TRUTH @ NEAR
    T, info = track(corner_map.field, (np.zeros_like(depth), color), start, start)
    assert np.isfinite(T).all() and info.after.known == 0 and np.isfinite(info.after.residual)


def test_tracking_is_deterministic(corner_map, frame):
    start = TRUTH @ FAR[0]
    one, other = (track(corner_map.field, frame, start, start) for _ in range(2))
    for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_is_known_and_what_is_only_not_contradicted(corner_map, points):
    """Far away the field may say anything, but is certain of nothing."""
    T = jnp.asarray(TRUTH, jnp.float32)
    here = measure_fit(corner_map.field, T, points, "whole", CFG)
    assert here.known > 0.95 and 0.5 < here.confirmed <= here.known
    elsewhere = T.at[:3, 3].add(jnp.array([30.0, 40.0, 50.0]))
    there = measure_fit(corner_map.field, elsewhere, points, "whole", CFG)
    assert there.confirmed < CFG.guard.confirmed < here.confirmed


def test_registration_says_how_firmly_the_surface_holds_the_frame(corner_map, frame):
    depth, _ = frame
    seen = unprojected(depth, TRUTH, *np.mgrid[: CAMERA.height, : CAMERA.width])
    # Its middle: where walls meet, the field is round
    back = (np.abs(seen[..., 2] - WALLS[2]) < 1e-3) & (np.abs(seen - WALLS)[..., :2].min(-1) > 0.3)
    assert 0.1 < back.mean() < 0.9

    views = Views(jnp.asarray(depth)[None], jnp.asarray(TRUTH, jnp.float32)[None])

    def register(depth):
        guess = jnp.asarray(TRUTH @ NEAR, jnp.float32)
        return jax.device_get(tracking.register(corner_map.field, depth, guess, CAMERA, CFG, views))

    corner, wall = register(depth), register(np.where(back, depth, np.float32(0)))
    assert corner.overlap > 0.5 and corner.inliers > 0.95 and wall.inliers > 0.95
    metres, degrees = apart(TRUTH, corner.T_sub_cam)
    assert metres < TOLERANCE_M and degrees < TOLERANCE_DEG
    # Along a wall the frame slides freely but for the waves of a field with cells of 5 cm, in a corner it does not
    assert corner.held > 10 * CFG.loop.held and wall.held < 0.2 * corner.held


def test_a_bare_wall_leaves_a_frame_free_whatever_noise_says(frame):
    """The normals of a noisy depth image point everywhere; the normal equations take that for a hold along the wall."""
    wall = plane((0, 0, -1), -2.0, cfg=PLANE_CFG)
    rng = np.random.default_rng(0)

    def noisy():
        return (2 + 0.004 * rng.standard_normal((CAMERA.height, CAMERA.width))).astype(np.float32)

    views = Views(jnp.asarray(np.stack([noisy()] * 2)), jnp.tile(jnp.eye(4), (2, 1, 1)))
    depth = noisy()
    seen = draw_points(KEY, depth, np.zeros((*frame[0].shape, 3), np.uint8), 2304, CAMERA)
    p_sub = np.asarray(seen.p_cam)
    seen_by = evidence.Evidence(seen, views, landmarks_of(np.eye(4), p_sub))
    T = jnp.eye(4)
    normals = own_normals(jnp.asarray(depth), seen.p_cam, CAMERA, PLANE_CFG.sensor.noise_growth)
    found = jax.jit(lambda: information.information(wall, T, seen_by, normals, CAMERA, PLANE_CFG))()
    surfaces, corners = (
        np.asarray(part) * PLANE_CFG.sensor.noise_floor**2 for part in (found.surfaces, found.corners)
    )
    # The points are 2 m away, where a depth is worth less than close by
    surfaces = surfaces / float(losses.precision(jnp.float32(2.0), PLANE_CFG.sensor))
    normals = jax.jit(
        lambda: (
            evidence.map_rows(wall, T, seen, "whole", PLANE_CFG).system().hessian
            + evidence.view_rows(T, seen, views, CAMERA, PLANE_CFG).system().hessian
        )
    )()
    # Two shifts along the wall and a turn about its normal are free
    assert np.linalg.eigvalsh(surfaces)[2] < 0.02 * np.linalg.eigvalsh(normals)[2]
    np.testing.assert_allclose(np.linalg.eigvalsh(surfaces)[3:], np.linalg.eigvalsh(normals)[3:], rtol=0.1)
    assert np.linalg.eigvalsh(surfaces + corners)[0] > 10 * np.linalg.eigvalsh(normals)[0]


@pytest.mark.parametrize("roof", [False, True])
def test_bumps_that_were_learned_hold_nothing_and_what_is_there_does(roof):
    """A wall 2 m away, and one with a ridge from floor to ceiling, which holds a camera to either side. Views of it
    have bumps of 5 mm, as a map that was learned from noise."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    x, y = 2 * (u - CAMERA.cx) / CAMERA.fx, 2 * (v - CAMERA.cy) / CAMERA.fy
    exact = 2 - 0.3 * roof * np.maximum(0, 1 - np.abs(x) / 0.4)
    bumps = 0.005 * np.sin(2 * np.pi * x / 0.25) * np.sin(2 * np.pi * y / 0.25)
    noisy = exact + 0.004 * np.random.default_rng(0).standard_normal(exact.shape)

    def hessian(frame, map_, own):
        depth, views = jnp.asarray(frame, jnp.float32), jnp.asarray(map_, jnp.float32)[None]
        points = draw_points(KEY, depth, np.zeros((*exact.shape, 3), np.uint8), 2304, CAMERA)
        rows = evidence.view_rows(jnp.eye(4), points, Views(views, jnp.eye(4)[None]), CAMERA, PLANE_CFG)
        if not own:
            return np.asarray(rows.system().hessian)
        normals = own_normals(depth, points.p_cam, CAMERA, PLANE_CFG.sensor.noise_growth)
        return np.asarray(information.steady_hessian([rows], points, normals))

    true, as_it_is, steady = (
        hessian(exact, exact, False),
        hessian(noisy, exact + bumps, False),
        hessian(noisy, exact + bumps, True),
    )
    # Across the wall, and up and down it
    assert as_it_is[1, 1] > 20 * max(steady[1, 1], true[1, 1])
    np.testing.assert_allclose(steady[0, 0], true[0, 0], rtol=0.3, atol=0.02 * as_it_is[0, 0])
    np.testing.assert_allclose(steady[2, 2], true[2, 2], rtol=0.2)


def test_steps_end_where_they_are_short():
    """Each takes a fifth of the way to a pose: it ends a few steps of that length before it, and not at it."""

    def system(T):
        there = equations.prior_system(T, equations.Prior(TRUTH, jnp.eye(6)))
        return there._replace(hessian=5 * there.hessian)

    start = jnp.asarray(TRUTH @ NEAR, jnp.float32)
    some, many = (jax.jit(lambda T, n=n: equations.descend(system, T, n))(start) for n in (60, 200))
    np.testing.assert_array_equal(some, many)
    metres, degrees = apart(many, TRUTH)
    # What is left is four times the last step
    assert equations.SETTLED < np.hypot(metres, np.radians(degrees)) < 5 * equations.SETTLED


def test_the_motion_prior_counts_where_nothing_else_holds_a_frame(corner_map, points):
    away = jnp.asarray(TRUTH @ pose((0, 0, 0), (0.03, 0, 0)), jnp.float32)

    def end(points):
        weak = (CFG.sensor.noise_floor / CFG.track.prior) ** 2 * jnp.eye(6)
        seen_by = evidence.Evidence(points, prior=equations.Prior(away, weak))
        start = jnp.asarray(TRUTH, jnp.float32)
        return solvers.levenberg_marquardt(corner_map.field, start, seen_by, "whole", 10, CAMERA, CFG)

    nothing = points._replace(mask=jnp.zeros_like(points.mask))
    assert apart(end(nothing), away)[0] < 1e-4 and apart(end(points), TRUTH)[0] < TOLERANCE_M


def test_the_last_alignment_moves_a_frame_as_far_as_corners_had_left_it_open(corner_map, frame):
    """One that they did not hold, one that they held to a tenth of a millimetre, one held along the camera's x axis
    alone, and one without any depth."""
    depth, _ = frame
    start = jnp.asarray(np.stack([TRUTH @ NEAR] * 4), jnp.float32)
    depths = jnp.asarray(np.stack([depth, depth, depth, np.zeros_like(depth)]))
    none, along_x = np.zeros((6, 6)), np.diag([1.0, 0, 0, 0, 0, 0])
    firm = np.stack([none, 1e8 * np.eye(6), 1e8 * along_x, none]).astype(np.float32)
    cfg = replace(CFG, track=replace(CFG.track, go=replace(CFG.track.go, final_steps=10)))
    ends = tracking.align(corner_map.field, depths, start, jnp.asarray(firm), CAMERA, cfg)
    free, held, partly, blind = np.asarray(ends)
    assert apart(free, TRUTH)[0] < TOLERANCE_M
    assert apart(held, start[1])[0] < 0.2 * apart(start[1], TRUTH)[0]
    moved = np.linalg.inv(start[2]) @ partly
    assert abs(moved[0, 3]) < 0.001 and np.linalg.norm(moved[1:3, 3]) > 0.01
    np.testing.assert_allclose(blind, start[3], atol=1e-6)


def test_what_no_keyframe_observed_does_not_count_in_registration(corner_map, frame):
    """The submap's keyframe saw the left half; the right half of the frame shows a wall moved by what it made up."""
    depth, _ = frame
    left = np.arange(CAMERA.width)[None] < CAMERA.width / 2
    views = Views(jnp.asarray(np.where(left, depth, 0))[None], jnp.asarray(TRUTH, jnp.float32)[None])
    moved = np.where(left, depth, depth - np.float32(0.08))
    guess = jnp.asarray(TRUTH @ NEAR, jnp.float32)
    found = jax.device_get(tracking.register(corner_map.field, moved, guess, CAMERA, CFG, views))
    metres, degrees = apart(TRUTH, found.T_sub_cam)
    assert metres < TOLERANCE_M and degrees < TOLERANCE_DEG
    assert 0.3 < found.overlap < 0.6 and found.inliers > 0.95


def test_a_frame_without_colour_is_tracked_as_if_colour_were_not_wanted(corner_map, frame):
    """By the map from the start, and not first by depth images of keyframes alone, which are 10 cm off here."""
    depth, color = frame
    off = jnp.asarray(TRUTH @ pose((0, 0, 0), (0.1, 0, 0)), jnp.float32)[None]
    starts = np.stack([TRUTH @ NEAR] * 2).astype(np.float32)
    grey, poses = np.zeros((2, *depth.shape), np.uint8), np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    none = Images(grey, np.ones((2, *depth[::2, ::2].shape), np.float32), poses, np.zeros(2, bool))

    def end(images):
        given = corner_map.field, depth, color, starts, WIDENING, KEY, CAMERA, CFG, Views(depth[None], off)
        return jax.device_get(tracking.track(*given, images=images))[0]

    # What is left is how XLA rounds in two programs
    np.testing.assert_allclose(end(none), end(None), atol=1e-6)


def test_the_robust_cost():
    psi = np.linspace(-0.1, 0.1, 11)
    cost = np.asarray(equations.robust_cost(jnp.asarray(psi), 0.02))
    np.testing.assert_allclose(cost, 0.02**2 * np.log1p((psi / 0.02) ** 2), rtol=1e-5)
    assert (cost <= psi**2 + 1e-9).all() and (np.diff(cost[5:]) > 0).all()


def landmarks_of(T_sub_cam, p_sub, noise=0.0, axes=None) -> evidence.Landmarks:
    """Where points of the submap are seen from a pose; those behind the camera are fillers."""
    p_cam = np.asarray(transform(jnp.asarray(np.linalg.inv(T_sub_cam), jnp.float32), p_sub))
    mask = p_cam[:, 2] > 0.1
    ray = p_cam[:, :2] / np.where(mask, p_cam[:, 2], 1)[:, None]
    ray = ray + noise * np.random.default_rng(0).normal(size=ray.shape)
    axes = jnp.asarray(np.tile(np.eye(2), (len(mask), 1, 1)) if axes is None else axes, jnp.float32)
    return evidence.Landmarks(jnp.asarray(p_sub), jnp.asarray(ray, jnp.float32), axes, jnp.asarray(mask))


def test_the_equations_of_landmarks_against_automatic_derivatives(points):
    p_sub = transform(jnp.asarray(TRUTH, jnp.float32), points.p_cam)
    landmarks = landmarks_of(TRUTH, p_sub, noise=2 / CAMERA.fx)
    T = jnp.asarray(TRUTH @ pose((0.5, 0.3, -0.4), (0.01, -0.02, 0.01)), jnp.float32)

    def cost(twist):
        moved = T @ jaxlie.SE3.exp(twist).as_matrix()
        return evidence.landmark_system(moved, landmarks, CAMERA, CFG).cost

    found = jax.jit(lambda: evidence.landmark_system(T, landmarks, CAMERA, CFG))()
    expected = jax.jit(jax.grad(cost))(jnp.zeros(6)) / 2
    np.testing.assert_allclose(found.slope, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max())
    # Positive definite: points of three walls leave no direction free
    assert np.linalg.eigvalsh(np.asarray(found.hessian))[0] > 0


def test_landmarks_hold_what_surfaces_leave_free():
    """In front of one wall the camera slides; points painted on it say where it is."""
    wall = plane((0, 0, -1), -2.0, cfg=PLANE_CFG)
    depth = np.full((CAMERA.height, CAMERA.width), 2, np.float32)
    seen = draw_points(KEY, depth, np.zeros((*depth.shape, 3), np.uint8), 300, CAMERA)
    landmarks = landmarks_of(np.eye(4), np.asarray(seen.p_cam))
    start = jnp.asarray(pose((0, 0, 3), (0.03, -0.02, 0)), jnp.float32)

    def end(landmarks):
        seen_by = evidence.Evidence(seen, landmarks=landmarks)
        return solvers.levenberg_marquardt(wall, start, seen_by, "whole", 10, CAMERA, PLANE_CFG)

    without, held = apart(end(None), np.eye(4)), apart(end(landmarks), np.eye(4))
    assert without[0] > 0.03 and without[1] > 2.5
    assert held[0] < 0.002 and held[1] < 0.1  # exact input: what is left is float32 and the last step
