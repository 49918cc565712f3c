"""The camera: what a pixel sees must not change when the image is resized or cut."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, project, rays, unproject
from mipsjax.core.rigid import transform

CAMERA = Intrinsics(52.5, 51.3, 31.2, 22.9, 64, 48)
# Rays are quotients of numbers below 100 in float32: a few units in the last place
RAY_TOLERANCE = 1e-6


def all_rays(camera: Intrinsics) -> np.ndarray:
    """Ray of every pixel, as an image."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.asarray(rays(v.ravel(), u.ravel(), camera)).reshape(camera.height, camera.width, 3)


def test_rays_against_the_definition():
    u, v = 10, 40
    (ray,) = np.asarray(rays(jnp.array([v]), jnp.array([u]), CAMERA))
    np.testing.assert_allclose(ray, [(u - 31.2) / 52.5, (v - 22.9) / 51.3, 1.0], atol=RAY_TOLERANCE)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_pixel_of_a_smaller_image_looks_at_the_middle_of_those_it_covers(factor):
    small = CAMERA.resized(CAMERA.width // factor, CAMERA.height // factor)
    blocks = all_rays(CAMERA).reshape(small.height, factor, small.width, factor, 3)
    np.testing.assert_allclose(all_rays(small), blocks.mean((1, 3)), atol=RAY_TOLERANCE)


def test_resizing_there_and_back_is_exact_to_rounding():
    back = CAMERA.resized(27, 101).resized(CAMERA.width, CAMERA.height)
    np.testing.assert_allclose(back, CAMERA, rtol=1e-14)


def test_a_crop_sees_the_same_rays():
    left, top, width, height = 7, 5, 30, 20
    window = all_rays(CAMERA)[top : top + height, left : left + width]
    np.testing.assert_allclose(all_rays(CAMERA.cropped(left, top, width, height)), window, atol=RAY_TOLERANCE)


@pytest.mark.parametrize("every_px", [1, 2, 3, 5, 7])
def test_decimation_is_slicing(every_px):
    sliced = all_rays(CAMERA)[::every_px, ::every_px]
    decimated = all_rays(CAMERA.decimated(every_px))
    assert decimated.shape == sliced.shape
    np.testing.assert_allclose(decimated, sliced, atol=RAY_TOLERANCE)


@given(
    u=st.integers(0, CAMERA.width - 1),
    v=st.integers(0, CAMERA.height - 1),
    depth=st.floats(0.125, 8.0, width=32),
)
def test_projection_undoes_unprojection(u, v, depth):
    point = rays(jnp.array([v]), jnp.array([u]), CAMERA) * depth
    # A pixel number below 64 has a unit in the last place of 4e-6; four operations
    np.testing.assert_allclose(project(point, CAMERA)[0], [u, v], atol=2e-5)


def test_the_host_and_compiled_code_unproject_and_project_alike():
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].reshape(2, -1)
    depth = np.linspace(0.5, 4.0, len(u))
    p_cam = unproject(v, u, depth, CAMERA)
    assert p_cam.dtype == np.float64 and isinstance(project(p_cam, CAMERA), np.ndarray)
    np.testing.assert_allclose(project(p_cam, CAMERA), np.stack([u, v], 1), atol=1e-12)
    compiled = jax.jit(lambda v, u, d: unproject(v, u, d, CAMERA))(v, u, depth)
    assert compiled.dtype == np.float32
    # A few units in the last place of coordinates below 4 m
    np.testing.assert_allclose(compiled, p_cam, atol=2e-6)


def test_the_matrix_of_a_camera_projects():
    p_cam = np.array([[0.3, -0.2, 1.7], [-0.5, 0.1, 0.6]])
    u, v, w = CAMERA.matrix() @ p_cam.T
    np.testing.assert_allclose(project(p_cam, CAMERA), np.stack([u / w, v / w], 1), atol=1e-12)


def test_points_at_or_behind_the_camera_project_to_something_finite():
    points = jnp.array([[0.1, 0.1, 0.0], [0.1, 0.1, -2.0], [0.0, 0.0, 0.0]])
    assert np.isfinite(project(points, CAMERA)).all()


def test_transform_against_homogeneous_coordinates():
    rng = np.random.default_rng(0)
    T, points = np.eye(4), rng.normal(size=(9, 3))
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    expected = (T @ np.column_stack([points, np.ones(9)]).T).T[:, :3]
    np.testing.assert_allclose(transform(jnp.array(T), jnp.array(points)), expected, atol=2e-6)


@pytest.mark.parametrize(
    ("rows", "columns", "height", "width"), [(3, 5, 12, 20), (4, 6, 15, 23), (16, 24, 48, 64)]
)
def test_the_grid_reaches_every_pixel_over_its_shifts(rows, columns, height, width):
    seen = np.zeros((height, width), bool)
    fraction = (np.arange(8) + 0.5) / 8  # finer than a pixel in every cell above
    shifts = np.stack(np.meshgrid(fraction, fraction), -1).reshape(-1, 2).astype(np.float32)
    rows_v, columns_u = jax.vmap(lambda shift: pixel_grid(rows, columns, shift, height, width))(shifts)
    for v, u in zip(rows_v.tolist(), columns_u.tolist(), strict=True):
        assert len(set(zip(v, u, strict=True))) == rows * columns, "one pixel of a grid is not taken twice"
        seen[v, u] = True
    assert seen.all()


@pytest.mark.parametrize("shift", [0.0, 0.5, np.nextafter(np.float32(1), np.float32(0))])
def test_the_grid_stays_inside(shift):
    v, u = pixel_grid(7, 9, jnp.full(2, shift, jnp.float32), 31, 47)
    assert v.min() >= 0 and v.max() <= 30 and u.min() >= 0 and u.max() <= 46


def test_the_grid_of_the_paper():
    assert grid_shape(384, 480, 640) == (16, 24)


@given(pixels=st.integers(1, 4000), height=st.integers(40, 500), width=st.integers(40, 700))
def test_a_grid_has_at_most_the_wanted_pixels_and_most_of_them(pixels, height, width):
    rows, columns = grid_shape(pixels, height, width)
    assert 0 < rows * columns <= pixels
    assert rows * (columns + 1) > pixels
