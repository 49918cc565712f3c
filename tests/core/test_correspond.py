"""Correspondences between submaps: planes in closed form, and two maps of a corner learned in two frames."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import planes
import pytest
from corner import CAMERA, CFG, VIEWS, WALLS, apart, pose, see, unprojected
from planes import REGRESSED, TAU, UNCERTAIN, plane

from mipsjax.core import mapping
from mipsjax.core.correspond import Matches, Surface, fixed_size, match, residuals, surface_points

pytestmark = pytest.mark.slow

COUNT = 64
SMALL = replace(planes.CFG, correspond=replace(planes.CFG.correspond, points=COUNT))
NORMAL, OFFSET = np.array([2.0, -1.0, 2.0]) / 3, 0.4
ROUNDING = 1e-5  # metres; psi is a mean of values of 0.1 with an error of 1e-8, coordinates are below 4
T_K_J = pose((20, -35, 10), (0.3, -0.2, 0.5))
T_WORLD_K = pose((10, 25, -5), (0.3, -0.2, 0.4))
FIT_STEPS = 250  # fewer than for the first map, whose accuracy other tests need


def near_plane(rng: np.random.Generator, spread: float) -> tuple[np.ndarray, np.ndarray]:
    """Random points within `spread` of the plane, and their distances."""
    x = rng.uniform(-1, 1, (COUNT, 3))
    s = rng.uniform(-spread, spread, COUNT)
    return (x - (x @ NORMAL - OFFSET - s)[:, None] * NORMAL[None]).astype(np.float32), s


def plane_in_j(T_k_j: np.ndarray) -> tuple[np.ndarray, float]:
    """Normal and offset in frame j of the plane that is NORMAL, OFFSET in k."""
    return NORMAL @ T_k_j[:3, :3], OFFSET - NORMAL @ T_k_j[:3, 3]


def surface_of_plane(normal, offset: float) -> Surface:
    """Exact points of a plane, without any field."""
    x = np.random.default_rng(1).uniform(-1, 1, (COUNT, 3))
    points = x - (x @ normal - offset)[:, None] * normal[None]
    normals = np.broadcast_to(normal, points.shape)
    return Surface(points.astype(np.float32), normals.astype(np.float32), np.ones(COUNT, bool))


def shifted(surface: Surface, by: float) -> Surface:
    return surface._replace(points=(surface.points + by * surface.normals).astype(np.float32))


@pytest.mark.parametrize("cfg", [SMALL, replace(REGRESSED, correspond=SMALL.correspond)])
def test_points_move_onto_a_plane_along_its_normal(cfg):
    start, s = near_plane(np.random.default_rng(0), 0.06)
    surface = surface_points(plane(NORMAL, OFFSET, cfg=cfg), start, np.ones(COUNT, bool), cfg)
    assert surface.mask.all()
    np.testing.assert_allclose(surface.points, start - s[:, None] * NORMAL[None], atol=ROUNDING)
    np.testing.assert_allclose(surface.normals, np.broadcast_to(NORMAL, (COUNT, 3)), atol=ROUNDING)


def test_what_is_no_surface_is_masked_and_finite():
    start, _ = near_plane(np.random.default_rng(0), 0.0)
    start[0] = np.nan
    start[1, 2] = np.inf
    start[2] += (0.3 * NORMAL).astype(np.float32)  # beyond the truncation: nothing pulls it back
    start[3] += (0.11 * NORMAL).astype(np.float32)  # it may come back, but from farther than the truncation
    mask = np.arange(COUNT) != 4
    surface = surface_points(plane(NORMAL, OFFSET), start, mask, SMALL)
    np.testing.assert_array_equal(surface.mask, np.arange(COUNT) > 4)
    assert not np.asarray(surface.points)[:5].any() and not np.asarray(surface.normals)[:5].any()
    assert all(np.isfinite(a).all() for a in surface)


def test_a_surface_that_is_uncertain_or_flat_is_none():
    start, _ = near_plane(np.random.default_rng(0), 0.0)
    assert planes.expected(np.zeros(1), UNCERTAIN)[1] > SMALL.correspond.max_entropy * np.log(5)
    for field in (plane(NORMAL, OFFSET, UNCERTAIN), plane(0 * NORMAL, 0.0)):
        assert not surface_points(field, start, np.ones(COUNT, bool), SMALL).mask.any()


@pytest.mark.parametrize("off", [0.0, 0.02, -0.05])
def test_a_match_is_the_foot_of_the_perpendicular(off):
    surface = shifted(surface_of_plane(*plane_in_j(T_K_J)), off)
    found = match(plane(NORMAL, OFFSET), T_K_J.astype(np.float32), surface, SMALL)
    x = surface.points.astype(np.float64) @ T_K_J[:3, :3].T + T_K_J[:3, 3]
    assert found.mask.all()
    np.testing.assert_allclose(found.q_k, x - off * NORMAL[None], atol=ROUNDING)
    np.testing.assert_allclose(found.distance, np.full(COUNT, abs(off)), atol=ROUNDING)
    # p_j lies off along its normal from where its match is
    np.testing.assert_allclose(
        residuals(surface, found, jnp.asarray(T_K_J, jnp.float32)), np.full(COUNT, off), atol=ROUNDING
    )


def none_of(found: Matches) -> bool:
    finite = all(np.isfinite(a).all() for a in found)
    return finite and not found.mask.any() and not np.asarray(found.q_k).any()


def test_what_does_not_match():
    exact, good = plane(NORMAL, OFFSET), surface_of_plane(*plane_in_j(T_K_J))
    T = T_K_J.astype(np.float32)
    assert match(exact, T, good, SMALL).mask.all()
    beyond = shifted(good, 1.3 * TAU)
    backward = good._replace(normals=-good.normals)
    slanted = good._replace(
        normals=(good.normals @ pose((0, 0, 50))[:3, :3] @ pose((50, 0, 0))[:3, :3]).astype(np.float32)
    )
    assert (np.sum(slanted.normals * good.normals, 1) < np.cos(SMALL.correspond.max_angle)).all()
    masked = good._replace(mask=np.zeros(COUNT, bool))
    for surface in (beyond, backward, slanted, masked):
        assert none_of(match(exact, T, surface, SMALL))
    for field in (plane(NORMAL, OFFSET, UNCERTAIN), plane(-NORMAL, -OFFSET), plane(0 * NORMAL, 0.0)):
        assert none_of(match(field, T, good, SMALL))
    assert none_of(match(exact, np.full((4, 4), np.nan, np.float32), good, SMALL))


def test_residuals_of_no_match_are_zero():
    surface = surface_of_plane(NORMAL, OFFSET)
    none = Matches(np.zeros((COUNT, 3), np.float32), np.zeros(COUNT, bool), np.zeros(COUNT, np.float32))
    assert not np.asarray(residuals(surface, none, jnp.eye(4))).any()


@pytest.mark.parametrize("count", [0, 1, COUNT - 1, COUNT, COUNT + 1, 5 * COUNT])
def test_any_number_of_points_becomes_a_fixed_one(count):
    points = np.arange(3.0 * count).reshape(count, 3)
    start, mask = fixed_size(points, SMALL)
    assert start.shape == (COUNT, 3) and start.dtype == np.float32 and mask.sum() == min(count, COUNT)
    kept = start[mask]
    assert len({tuple(row) for row in kept}) == len(kept)  # none twice
    assert {tuple(row) for row in kept} <= {tuple(row) for row in points}
    if count:
        np.testing.assert_array_equal(kept[[0, -1]], points[[0, -1 if count > 1 else 0]])


# Two learned maps of the same corner


def measured(T_sub_cam: np.ndarray) -> np.ndarray:
    """Every other pixel of every other row of the views, in the submap's frame."""
    v, u = np.mgrid[: CAMERA.height : 2, : CAMERA.width : 2].reshape(2, -1)
    pairs = zip(T_sub_cam, VIEWS, strict=True)
    return np.concatenate([unprojected(see(T_world_cam)[0], T, v, u) for T, T_world_cam in pairs])


@pytest.fixture(scope="module")
def other_map(corner_frames) -> mapping.Learned:
    """The corner learned in another frame, from other parameters and draws."""
    moved = corner_frames._replace(
        T_sub_cam=(np.linalg.inv(T_WORLD_K) @ VIEWS).astype(np.float32), movable=np.zeros(len(VIEWS), bool)
    )
    submap = mapping.create(jax.random.key(5), CFG)
    submap, _, info = mapping.refine(submap, moved, jnp.int32(FIT_STEPS), jax.random.key(6), CAMERA, CFG)
    assert bool(info.ok)
    return submap


@pytest.fixture(scope="module")
def surface(corner_map) -> Surface:
    """Of the first map, whose frame is the world's."""
    return jax.device_get(surface_points(corner_map.field, *fixed_size(measured(VIEWS), CFG), CFG))


def test_a_learned_surface_is_on_the_walls(surface):
    assert surface.mask.mean() > 0.9
    away = np.abs(surface.points - WALLS)[surface.mask]
    # The finest cells are 5 cm; at the seams of the walls the field is round
    assert np.quantile(away.min(1), 0.9) < 0.006
    true = -np.sign(WALLS) * (away == away.min(1, keepdims=True))
    angle = np.arccos(np.clip(np.sum(true * surface.normals[surface.mask], 1), -1, 1))
    assert np.degrees(np.median(angle)) < 8 and np.degrees(np.quantile(angle, 0.9)) < 20


def registered(field_k, surface_j: Surface, T_k_j: np.ndarray, rounds: int) -> np.ndarray:
    """An oracle in double precision: Gauss-Newton on Eq. 20 by numerical derivatives, matched anew each round."""

    def errors(T, found):
        q = np.linalg.inv(T) @ np.c_[found.q_k, np.ones(len(found.q_k))].astype(np.float64).T
        return np.sum((surface_j.points - q[:3].T) * surface_j.normals, 1)[found.mask]

    def turned(T, twist):
        return T @ pose(np.degrees(twist[3:]), twist[:3])

    step = 1e-5
    for _ in range(rounds):
        found = jax.device_get(match(field_k, T_k_j.astype(np.float32), surface_j, CFG))
        e = errors(T_k_j, found)
        columns = [(errors(turned(T_k_j, step * d), found) - e) / step for d in np.eye(6)]
        weight = 1 / np.sqrt(1 + (e / 0.02) ** 2)  # Cauchy: pairs across the seams of the walls
        twist = -np.linalg.lstsq(np.stack(columns, 1) * weight[:, None], e * weight)[0]
        T_k_j = turned(T_k_j, twist)
    return T_k_j


@pytest.mark.parametrize("direction", [(1, 1, -1), (-1, 1, 1)])
def test_matches_recover_the_pose_between_two_learned_maps(surface, other_map, direction):
    d = np.array(direction) / np.sqrt(3)
    truth = np.linalg.inv(T_WORLD_K)
    start = truth @ pose(1.0 * d, 0.02 * d)  # 1 degree about the world's origin, and 2 cm
    metres, degrees = apart(start, truth)
    assert metres > 0.019 and degrees > 0.99
    found = registered(other_map.field, surface, start, rounds=5)
    metres, degrees = apart(found, truth)
    # Both fields are a few millimetres off, not everywhere to the same side
    assert metres < 0.004 and degrees < 0.15


def test_matches_and_surfaces_compile_once_for_all_submaps(surface, corner_map, other_map):
    before = match._cache_size(), surface_points._cache_size()
    T = pose((0, 1, 0), (0.01, 0, 0)).astype(np.float32)
    points = fixed_size(measured(np.linalg.inv(T_WORLD_K) @ VIEWS), CFG)
    for field in (corner_map.field, other_map.field):
        for mask in (points[1], np.zeros_like(points[1])):
            match(field, T, jax.device_get(surface_points(field, points[0], mask, CFG)), CFG)
    after = match._cache_size(), surface_points._cache_size()
    assert after[1] == before[1] and after[0] <= before[0] + 1


def test_a_wrong_pose_has_few_matches(surface, other_map):
    truth = np.linalg.inv(T_WORLD_K)
    shares = []
    for T in (truth, truth @ pose((0, 60, 0), (0, 0, 1.0))):
        shares.append(np.mean(match(other_map.field, T.astype(np.float32), surface, CFG).mask))
    assert shares[0] > 0.8 and shares[1] < 0.2
