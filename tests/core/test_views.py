"""Depth images of keyframes as a map: distances against the exact planes, and the pose they hold alone."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corner import CAMERA, CFG, HOME, VIEWS, WALLS, apart, pose, see, unprojected

from mipsjax.core import evidence, solvers
from mipsjax.core import field as nf
from mipsjax.core.camera import Intrinsics, rays
from mipsjax.core.fit import draw_points
from mipsjax.core.views import Views, observed, own_normals, plane_errors, planes_at, seen_through

KEY = jax.random.key(11)
REACH = 0.1
INWARD = np.diag([1.0, -1.0, -1.0])  # of the walls x, y, z: x rises, y and z fall into the room
TRUTH = HOME @ pose((2.0, 1.0, -1.0), (0.03, 0.02, -0.02))
EXACT = 0.0  # growth of the noise


@pytest.fixture(scope="module")
def views() -> Views:
    return Views(np.stack([see(T)[0] for T in VIEWS[:3]]), VIEWS[:3].astype(np.float32))


@pytest.fixture(scope="module")
def on_walls() -> np.ndarray:
    """Points of the three walls that the first view sees, away from the edges between them."""
    depth = see(HOME)[0]
    v, u = (x.ravel() for x in np.mgrid[8 : CAMERA.height - 8 : 7, 8 : CAMERA.width - 8 : 7])
    points = unprojected(depth, HOME, v, u)
    clear = np.sort(np.abs(points - WALLS), axis=1)[:, 1] > 0.25
    return points[clear].astype(np.float32)


def test_normals_are_those_of_the_walls(views):
    v, u = (x.ravel() for x in np.mgrid[4 : CAMERA.height - 4 : 5, 4 : CAMERA.width - 4 : 5])
    planes = planes_at(jnp.asarray(views.depth[0]), v, u, CAMERA, EXACT)
    inward = np.asarray(planes.normal) @ HOME[:3, :3].T
    wall = np.abs(np.asarray(planes.point) @ HOME[:3, :3].T + HOME[:3, 3] - WALLS).argmin(1)
    expected = INWARD[wall]
    flat = np.asarray(planes.flat)
    assert flat.mean() > 0.8
    off = np.abs(inward[flat] - expected[flat]).max(1)
    # Differences of a float32 depth; next to an edge a neighbour may be on the other wall, nearly in the plane
    assert np.mean(off < 2e-3) > 0.98 and off.max() < 0.15


def test_a_frames_own_normals_have_little_noise_and_small_parts_have_some():
    """Of a wall that is 3 m away with a post in front of it, as wide as a few pixels."""
    camera, growth = Intrinsics(290.0, 290.0, 159.5, 119.5, 320, 240), 0.002
    depth = np.full((camera.height, camera.width), 3.0)
    depth[:, 100:107] = 2.0
    noise = growth * depth**2 * np.random.default_rng(0).standard_normal(depth.shape)
    depth = jnp.asarray(depth + noise, jnp.float32)
    v, u = (x.ravel() for x in np.mgrid[16 : camera.height - 16 : 5, 16 : camera.width - 16])
    p_cam = rays(v, u, camera) * depth[v, u][:, None]
    own = np.asarray(own_normals(depth, p_cam, camera, growth))
    near = np.asarray(planes_at(depth, v, u, camera, growth).normal)
    on_wall, on_post = (u < 80) | (u > 130), (u > 101) & (u < 105)
    known = np.linalg.norm(own, axis=1) > 0
    assert known[on_wall].mean() > 0.9 and known[on_post].mean() > 0.5
    assert np.std(own[known & on_wall, 0]) < 0.6 * np.std(near[known & on_wall, 0])


def test_distances_to_the_walls_are_exact(views, on_walls):
    """Points moved off the walls by a known length, towards the room or into the wall."""
    for offset in (0.0, 0.02, -0.03):
        wall = np.abs(on_walls - WALLS).argmin(1)
        inward = INWARD[wall]
        errors = plane_errors(
            views, jnp.asarray(on_walls + offset * inward, jnp.float32), CAMERA, REACH, EXACT
        )
        assert errors.mask[0].mean() > 0.8 and errors.mask.shape == (3, len(on_walls))
        found = np.asarray(errors.distance)[np.asarray(errors.mask)]
        np.testing.assert_allclose(np.median(found), offset, atol=1e-4)
        # A point may fall on the next wall near an edge
        assert np.mean(np.abs(found - offset) < 1e-3) > 0.95


def test_a_noisy_wall_is_a_plane_where_the_noise_is_said_to_be_that_large():
    """And an edge between two walls is none close by, where depth has no noise."""
    v, u = (x.ravel() for x in np.mgrid[4 : CAMERA.height - 4 : 3, 4 : CAMERA.width - 4 : 3])
    rng, growth, metres = np.random.default_rng(0), 0.002, 3.0
    noise = growth * metres**2 * rng.standard_normal((CAMERA.height, CAMERA.width))
    depth = jnp.asarray(metres + noise, jnp.float32)
    even = [float(planes_at(depth, v, u, CAMERA, g).flat.mean()) for g in (EXACT, growth)]
    # Middle and pixel differ by sqrt(1.5) of 18 mm: 5 mm hold both pairs for few, 41 mm for 19 in 20 each
    assert even[0] < 0.1 and even[1] > 0.8
    edge = jnp.asarray(0.5 + 0.02 * np.abs(np.arange(CAMERA.width) - 64.0), jnp.float32)
    across = jnp.broadcast_to(edge, depth.shape)
    assert not planes_at(across, np.array([48]), np.array([64]), CAMERA, growth).flat.any()


def test_what_is_not_seen_is_masked(views, on_walls):
    behind = jnp.asarray(on_walls - 20 * HOME[:3, 2], jnp.float32)
    assert not plane_errors(views, behind, CAMERA, REACH, EXACT).mask.any()
    wall = np.abs(on_walls - WALLS).argmin(1)
    off = jnp.asarray(on_walls + 0.15 * INWARD[wall], jnp.float32)  # the other walls are 25 cm away
    assert not plane_errors(views, off, CAMERA, REACH, EXACT).mask.any()
    empty = views._replace(depth=np.zeros_like(views.depth))
    errors = plane_errors(empty, jnp.asarray(on_walls), CAMERA, REACH, EXACT)
    assert not errors.mask.any() and jnp.all(jnp.isfinite(errors.normal))


def test_a_point_is_observed_where_a_view_measured_and_not_behind_it():
    depth = np.full((2, CAMERA.height, CAMERA.width), 2, np.float32)
    depth[:, :, : CAMERA.width // 2] = 0
    turned = pose((0, 180, 0), (0, 0, 0))
    views = Views(jnp.asarray(depth), jnp.asarray(np.stack([np.eye(4), turned]), jnp.float32))
    #          on it,         before it,  a little and far behind,       no depth,       out of view, behind the camera
    points = [(0.1, 0, 2), (0.1, 0, 1), (0.1, 0, 2.2), (0.1, 0, 2.4), (-0.1, 0, 2), (9, 0, 1), (0.1, 0, -2)]
    found = observed(views, jnp.asarray(points, jnp.float32), CAMERA, margin=0.3)
    # The last is seen by the view that is turned, in its half without depth
    np.testing.assert_array_equal(found, [True, True, True, False, False, False, False])
    assert not observed(views._replace(depth=0 * views.depth), jnp.ones((3, 3)), CAMERA, 0.3).any()


def test_a_view_saw_through_what_is_before_all_that_it_saw_around_there():
    camera = Intrinsics(100.0, 100.0, 15.5, 11.5, 32, 24)
    depth = np.full((1, 24, 32), 3.0, np.float32)
    depth[0, :, 20:] = 1.5  # something near on the right
    depth[0, :8] = 0.0  # nothing is known of what is above
    views = Views(jnp.asarray(depth), jnp.eye(4)[None])
    pixels = np.array([(10, 16), (10, 16), (10, 16), (10, 19), (10, 25), (3, 10), (10, 16)])
    metres = np.array([2.0, 2.85, 2.95, 2.0, 1.2, 2.0, 0.0])
    points = rays(jnp.asarray(pixels[:, 0]), jnp.asarray(pixels[:, 1]), camera) * metres[:, None]
    # The fourth is beside what is near; a noise of 2 mm at one metre makes 54 mm of three deviations at three
    exact = seen_through(views, points, camera, margin=0.1, noise_growth=0.0)
    assert exact.tolist() == [True, True, False, False, True, False, False]
    noisy = seen_through(views, points, camera, margin=0.1, noise_growth=0.002)
    assert noisy.tolist() == [True, False, False, False, True, False, False]
    assert not seen_through(views._replace(depth=0 * views.depth), points, camera, 0.1, 0.0).any()


def test_views_alone_hold_a_pose_that_the_map_does_not_know(views):
    """In a map that has learned nothing psi is about 0 everywhere and certain of nothing."""
    cfg = replace(CFG, track=replace(CFG.track, go=replace(CFG.track.go, view_weight=1.0)))
    field = nf.init(KEY, cfg.field)
    depth, color = see(TRUTH)
    points = draw_points(KEY, depth, color, cfg.track.go.pixels, CAMERA)
    start = (TRUTH @ pose((1.2, -1.2, 1.0), (0.012, -0.012, 0.01))).astype(np.float32)

    @jax.jit
    def end(given):
        return solvers.levenberg_marquardt(
            field,
            jnp.asarray(start),
            evidence.Evidence(points, given),
            "whole",
            cfg.track.go.steps,
            CAMERA,
            cfg,
        )

    metres, degrees = apart(np.asarray(end(views)), TRUTH)
    assert metres < 0.002 and degrees < 0.1  # the fresh networks pull a little at random
    none = Views(np.zeros((0, *depth.shape), np.float32), np.zeros((0, 4, 4), np.float32))
    assert apart(np.asarray(end(none)), TRUTH)[0] > 0.005, "without views nothing holds it"


def test_points_say_as_much_as_their_precision(views, monkeypatch):
    """To the map and to the views alike: without any, nothing moves the pose."""
    monkeypatch.setattr(evidence, "precisions", lambda points, cfg: 0.0 * points.mask)
    points = draw_points(KEY, *see(TRUTH), CFG.track.go.pixels, CAMERA)
    start = jnp.asarray(TRUTH @ pose((0, 0, 0), (0.01, 0, 0)), jnp.float32)
    field, steps = nf.init(KEY, CFG.field), CFG.track.go.steps
    end = solvers.levenberg_marquardt(
        field, start, evidence.Evidence(points, views), "whole", steps, CAMERA, CFG
    )
    np.testing.assert_array_equal(end, start)
