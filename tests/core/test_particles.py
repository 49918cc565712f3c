"""The particle swarm: template, poses, fitness, and one step on a field known in closed form."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from mipsjax.config.sections import FieldConfig
from mipsjax.config.tracking import SearchConfig
from mipsjax.core import field as nf
from mipsjax.core import particles
from mipsjax.core.particles import Swarm

COUNT, PIXELS = 256, 40
FIELD = FieldConfig(
    encoding="frequency", octaves=1, hidden=(), color_hidden=(), coldness=1.0, normalised=False
)
SEARCH = SearchConfig(particles=COUNT, pixels=PIXELS, uncertainty=True)
RADII = np.array([0.05, 0.05, 0.05, 0.1, 0.1, 0.1], np.float32)


@pytest.fixture(scope="module")
def wall() -> nf.Field:
    """The distance to the plane z = 0 as a monotone function of z: without hidden layers the first three
    numbers of the encoding, the point itself, go straight into the classes."""
    field = nf.init(jax.random.key(0), FIELD)
    labels = np.linspace(-1, 1, FIELD.classes)
    weight = np.zeros(field.smooth.weights[0].shape, np.float32)
    weight[2] = 10 * labels  # psi is within 1 cm of z for |z| < 5 cm, and saturates beyond
    return field._replace(smooth=field.smooth._replace(weights=(jnp.array(weight),)))


@pytest.fixture(scope="module")
def plane_points() -> np.ndarray:
    """Points of the plane as a camera 1 m before it sees them, half of them masked out and far off."""
    p = np.random.default_rng(0).uniform(-0.7, 0.7, (PIXELS, 3)).astype(np.float32)
    p[:, 2] = 1
    p[PIXELS // 2 :] = 50
    return p


MASK = np.arange(PIXELS) < PIXELS // 2
TRUTH = np.eye(4, dtype=np.float32)
TRUTH[2, 3] = -1  # the camera looks along +z at the plane


@pytest.fixture(scope="module")
def fitness(plane_points):
    return jax.jit(lambda field, poses: particles.fitness(field, poses, plane_points, MASK, FIELD, SEARCH))


@pytest.fixture(scope="module")
def step(plane_points):
    return jax.jit(
        lambda swarm, template, field: particles.step(
            swarm, template, field, plane_points, MASK, FIELD, SEARCH
        )
    )


def test_the_template_is_uniform_in_the_unit_ball():
    drawn = particles.template(4096)
    assert drawn.shape == (4096, 6) and drawn.dtype == np.float32
    assert not drawn[0].any(), "particle 0 is the centre"
    radius = np.linalg.norm(drawn[1:].astype(np.float64), axis=1)
    assert radius.max() <= 1 + 1e-6
    # The volume within radius r grows as r^6. The seed is fixed, so this is not a matter of luck.
    assert kstest(radius**6, "uniform").pvalue > 0.01
    # A uniform 6-ball has the covariance I / 8; 4095 draws estimate it to about 1 / sqrt(4095) of itself
    np.testing.assert_allclose(np.cov(drawn[1:].T), np.eye(6) / 8, atol=0.01)
    np.testing.assert_allclose(drawn.mean(0), np.zeros(6), atol=0.02)


def test_the_template_depends_on_its_seed_alone():
    np.testing.assert_array_equal(particles.template(64, 3), particles.template(64, 3))
    assert (particles.template(64, 3)[1:] != particles.template(64, 4)[1:]).any()


small = st.floats(-0.5, 0.5, width=32)


@given(st.tuples(*[small] * 6))
def test_a_delta_is_a_rigid_motion(delta):
    q, t = np.array(delta[:3]), np.array(delta[3:])
    T = np.asarray(particles.delta_pose(jnp.array(delta, jnp.float32)), np.float64)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1, abs=1e-6)
    expected = Rotation.from_quat([*q, np.sqrt(1 - q @ q)]).as_matrix()
    np.testing.assert_allclose(T[:3, :3], expected, atol=1e-6)
    np.testing.assert_allclose(T[:3, 3], t, atol=0)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1.0, 5.0])
def test_deltas_of_any_size_are_rotations(size):
    """An imaginary part longer than 1 is no quaternion's: it is shortened, and its axis kept."""
    delta = size * np.array([2, -1, 2, 0, 0, 0], np.float32) / 3
    T = np.asarray(particles.delta_pose(delta), np.float64)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(T[:3, :3] @ [2, -1, 2], [2, -1, 2], atol=1e-5)


def poses_around(truth: np.ndarray, count: int) -> np.ndarray:
    return truth @ np.asarray(particles.delta_pose(particles.template(count) * RADII))


@pytest.mark.parametrize("uncertainty", [True, False])
def test_fitness_against_a_loop_over_poses_and_points(wall, plane_points, uncertainty):
    """Eq. 11 with bounded weights, as a weighted mean."""
    search = replace(SEARCH, uncertainty=uncertainty)
    poses = poses_around(TRUTH, 30)
    costs = particles.fitness(wall, poses, plane_points, MASK, FIELD, search)
    for T, cost in zip(poses, costs, strict=True):
        made = nf.tsdf(wall, plane_points[MASK] @ T[:3, :3].T + T[None, :3, 3], FIELD, "search")
        psi, h = np.asarray(made.psi, np.float64), np.asarray(made.entropy, np.float64)
        weight = 1 / (h**2 + search.entropy_floor**2) if uncertainty else np.ones_like(h)
        # Sums of 20 float32 numbers; a cost near zero keeps an absolute error of (1e-7 m)^2
        assert float(cost) == pytest.approx(np.sum(weight * psi**2) / np.sum(weight), rel=1e-4, abs=1e-13)


@pytest.mark.parametrize("chunk", [1, 64, 700])
def test_fitness_does_not_depend_on_the_other_poses(wall, plane_points, monkeypatch, chunk):
    """However many there are, and however they fall into chunks: each alone, with a rest, all in one."""
    poses = poses_around(TRUTH, 700)
    alone = jnp.stack([particles.pose_cost(wall, T, plane_points, MASK, FIELD, SEARCH) for T in poses[::100]])
    monkeypatch.setattr(particles, "CHUNK_POINTS", chunk * PIXELS)
    # Traced anew: the size of a chunk is a constant of the compiled program
    fitness = particles.fitness.__wrapped__
    costs = fitness(wall, poses, plane_points, MASK, FIELD, SEARCH)
    # Sums of 20 float32 numbers in another order, as above
    np.testing.assert_allclose(costs[::100], alone, rtol=1e-5, atol=1e-13)


def test_on_a_gpu_all_particles_are_one_batch(wall, plane_points):
    poses = poses_around(TRUTH, 2 * particles.CHUNK_POINTS // PIXELS)
    traced = particles.fitness.trace(wall, poses, plane_points, MASK, FIELD, SEARCH)
    on_cpu, on_gpu = (traced.lower(lowering_platforms=(name,)).as_text() for name in ("cpu", "cuda"))
    # A loop over chunks on the one, no loop on the other; and no product in less than single precision on either
    assert "stablehlo.while" in on_cpu and "stablehlo.while" not in on_gpu
    products = [line for line in on_gpu.splitlines() if "dot_general" in line]
    assert products and all("HIGHEST" in line for line in products)


def test_fitness_without_a_point_is_finite(wall, plane_points):
    none = np.zeros(PIXELS, bool)
    assert np.isfinite(particles.fitness(wall, TRUTH[None], plane_points, none, FIELD, SEARCH)).all()


def off_by(delta) -> np.ndarray:
    return TRUTH @ np.asarray(particles.delta_pose(np.array(delta, np.float32)))


@pytest.mark.parametrize(
    "delta", [(0, 0, 0, 0, 0, 0.05), (0.03, 0, 0, 0, 0, 0), (0.02, -0.02, 0, 0, 0, -0.06), (0,) * 6]
)
def test_a_step_never_worsens_the_centre(wall, fitness, step, delta):
    swarm = Swarm(off_by(delta), jnp.float32(jnp.inf), jnp.asarray(RADII))
    costs = [float(fitness(wall, swarm.T_sub_cam[None])[0])]
    for seed in range(6):
        swarm = step(swarm, particles.template(COUNT, seed), wall)
        costs.append(float(fitness(wall, swarm.T_sub_cam[None])[0]))
        assert float(swarm.cost) == pytest.approx(costs[-1], rel=1e-4, abs=1e-12)
        assert (np.asarray(swarm.radii) > 0).all()
    # The cost of one pose, computed in another order, differs in the last places
    assert (np.diff(costs) <= 1e-12 + 1e-5 * np.array(costs[:-1])).all()
    # From 5 cm, six steps reach the millimetre
    assert costs[-1] < 0.003**2


@pytest.mark.fault(35)
def test_an_empty_advantage_set_keeps_the_centre_and_changes_the_radii(wall, step):
    swarm = Swarm(jnp.asarray(off_by((0, 0, 0, 0, 0, 0.05))), jnp.float32(jnp.inf), jnp.asarray(RADII))
    after = step(swarm, np.zeros((COUNT, 6), np.float32), wall)  # every particle is the centre
    np.testing.assert_array_equal(after.T_sub_cam, swarm.T_sub_cam)
    ratio = np.asarray(after.radii) / RADII
    assert (np.abs(ratio - 1) > 0.05).all() and (after.radii > 0).all()


@pytest.mark.fault(35)
def test_costs_that_are_not_numbers_leave_the_centre(wall, step):
    swarm = Swarm(jnp.asarray(off_by((0, 0, 0, 0, 0, 0.05))), jnp.float32(jnp.inf), jnp.asarray(RADII))
    broken = jax.tree.map(lambda a: jnp.full_like(a, jnp.nan), wall)
    after = step(swarm, particles.template(COUNT), broken)
    np.testing.assert_array_equal(after.T_sub_cam, swarm.T_sub_cam)
    assert np.isfinite(after.radii).all() and (after.radii > 0).all()
