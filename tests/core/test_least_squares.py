"""One statement of the robust pose problem: its derivative, and where optimistix ends on it."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corner import CAMERA, CFG, HOME, apart, pose, see

from mipsjax.core import evidence, least_squares, solvers
from mipsjax.core.equations import Prior, Rows
from mipsjax.core.fit import draw_points
from mipsjax.core.rigid import log, perturbed

pytestmark = pytest.mark.slow

KEY = jax.random.key(7)
UNIT = CFG.sensor.noise_floor
TRUTH = HOME @ pose((2.0, 1.0, -1.0), (0.03, 0.02, -0.02))
START = TRUTH @ pose((1.2, -1.2, 1.0), (0.012, -0.012, 0.01))  # 2 degrees, 2 cm


@pytest.fixture(scope="module")
def rows_of(corner_map):
    depth, color = see(TRUTH)
    points = draw_points(KEY, depth, color, CFG.track.go.pixels, CAMERA)
    sure = evidence.certainties(corner_map.field, jnp.asarray(START, jnp.float32), points, "whole", CFG)
    return lambda T: [evidence.map_rows(corner_map.field, T, points, "whole", CFG, sure)]


def test_its_slope_is_that_of_the_normal_equations(rows_of):
    T = jnp.asarray(START, jnp.float32)
    residuals = least_squares.robust_residuals(rows_of, T)
    twist = jnp.array([0.01, -0.02, 0.005, 0.02, -0.03, 0.01])
    value, jacobian = jax.jit(lambda x: (residuals(x), jax.jacfwd(residuals)(x)))(twist)
    system = rows_of(perturbed(T, twist))[0].system()
    np.testing.assert_allclose(jnp.sum(value**2), system.cost, rtol=1e-4)
    # By the twist at the start; that of the system is one at the pose that it leads to
    there = np.array([least_squares._in_camera(twist, axis) for axis in jnp.eye(6)])
    np.testing.assert_allclose(value @ jacobian, there @ system.slope, rtol=1e-3, atol=1e-5)


def test_the_motion_that_follows_from_a_change_of_the_twist():
    twist, change = jnp.array([0.1, -0.2, 0.3, 0.4, 0.5, -0.6]), jnp.array([0.3, 0.1, -0.2, 0.5, -0.4, 0.2])
    step = 1e-3
    here, there = (perturbed(jnp.eye(4), twist + s * change) for s in (-step, step))
    moved = jnp.linalg.inv(perturbed(jnp.eye(4), twist)) @ (there - here) / (2 * step)
    expected = [*moved[:3, 3], moved[2, 1], moved[0, 2], moved[1, 0]]
    # Single precision over a thousandth
    np.testing.assert_allclose(least_squares._in_camera(twist, change), expected, atol=1e-3)


def test_it_ends_where_our_steps_end(corner_map, rows_of):
    depth, color = see(TRUTH)
    points = draw_points(KEY, depth, color, CFG.track.go.pixels, CAMERA)
    T = jnp.asarray(START, jnp.float32)
    ours = solvers.levenberg_marquardt(
        corner_map.field, T, evidence.Evidence(points), "whole", 15, CAMERA, CFG
    )
    theirs = jax.jit(lambda T: least_squares.solve(rows_of, T, 15, UNIT))(T)
    metres, degrees = apart(np.asarray(theirs), np.asarray(ours))
    # The map is less certain at the start, by which theirs weighs points
    assert metres < 2e-3 and degrees < 0.05
    metres, degrees = apart(np.asarray(theirs), TRUTH)
    assert metres < 0.004 and degrees < 0.15  # the map, not the method, is the limit


def test_many_at_once_end_where_each_ends_alone(rows_of):
    starts = jnp.asarray(np.stack([START, TRUTH]), jnp.float32)
    one = partial(least_squares.solve, rows_of, steps=8, unit=UNIT)
    alone = np.stack([jax.jit(lambda T: one(T))(T) for T in starts])
    # Sums are rounded otherwise
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda T: one(T)))(starts), alone, atol=5e-5)


@pytest.mark.fault(36)
def test_a_pose_that_nothing_measures_stays_and_so_does_one_of_nan():
    T = jnp.asarray(START, jnp.float32)
    nothing = Rows(jnp.zeros(5), jnp.zeros((5, 6)), jnp.zeros(5), jnp.zeros(5))
    broken = nothing._replace(residual=jnp.full(5, jnp.nan), cost=jnp.full(5, jnp.nan))
    for rows in (nothing, broken):
        np.testing.assert_allclose(least_squares.solve(lambda _, rows=rows: [rows], T, 5, UNIT), T, atol=1e-6)


@pytest.mark.parametrize("steps", [0, 1])
def test_as_many_steps_as_are_asked_for(rows_of, steps):
    """One is more than none."""
    T = jnp.asarray(START, jnp.float32)
    end = jax.jit(lambda T: least_squares.solve(rows_of, T, steps, UNIT))(T)
    metres, _ = apart(np.asarray(end), START)
    assert (metres > 0.002) == (steps == 1)


def test_a_prior_draws_a_pose_along_what_it_holds():
    """Along the others it says nothing."""
    T, prior = jnp.asarray(TRUTH, jnp.float32), jnp.asarray(START, jnp.float32)

    def end(weight):
        rows = least_squares.prior_rows(Prior(prior, jnp.diag(jnp.array(weight))))
        return np.asarray(least_squares.solve(lambda T: [rows(T)], T, 10, UNIT))

    metres, degrees = apart(end([1.0, 1.0, 1.0, 4.0, 4.0, 4.0]), START)
    assert metres < 1e-4 and degrees < 0.01
    # Where it is, and not how it is turned
    shifted = end([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    assert apart(shifted, START)[0] < 1e-3 and apart(shifted, TRUTH)[1] < 0.1
    np.testing.assert_allclose(end([0.0] * 6), T, atol=1e-6)


def test_a_direction_that_is_weakly_held_is_followed():
    """A thousandth as firmly as the others, by few points."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(200, 3)) * (1.0, 1.0, 0.03)
    far = jnp.asarray(rng.normal(size=(200, 3)), jnp.float32)
    jacobian = jnp.concatenate([jnp.asarray(normals, jnp.float32), jnp.cross(far, normals)], -1)
    wanted = jnp.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0])

    def rows(T):
        error = jacobian @ (log(T) - wanted)
        return [Rows(error, jacobian, jnp.ones(200), error**2)]

    end = least_squares.solve(rows, jnp.eye(4), 10, UNIT)
    assert abs(float(end[2, 3]) - 0.05) < 0.005
