"""Mesh metrics against planes and spheres, whose distances are known."""

import numpy as np
import pytest
import trimesh

from mipsjax.core.camera import Intrinsics
from mipsjax.errors import InputError
from mipsjax.metrics import surface

CAMERA = Intrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)
COUNT = 40_000


def square(z=0.0, half=1.0):
    corners = [[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]]
    return trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False)


def right_part(x, half=1.0):
    """The part of a square beyond x."""
    corners = [[x, -half, 0], [half, -half, 0], [half, half, 0], [x, half, 0]]
    return trimesh.Trimesh(corners, [[0, 2, 1], [0, 3, 2]], process=False)


def ball(radius):
    return trimesh.creation.icosphere(subdivisions=5, radius=radius)


def views(depth, z_camera=-2.0):
    """One camera on the z axis that looks along +z."""
    T = np.eye(4)
    T[2, 3] = z_camera
    return surface.Views(T[None], CAMERA, [depth])


def test_samples_are_even_seeded_and_on_the_surface():
    mesh = square()
    points = surface.sample_surface(mesh, COUNT, seed=4)
    np.testing.assert_array_equal(points, surface.sample_surface(mesh, COUNT, seed=4))
    assert np.abs(points - surface.sample_surface(mesh, COUNT, seed=5)).max() > 0
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=4, range=[[-1, 1], [-1, 1]])
    # each of 16 bins expects 2500, with a deviation of at most sqrt(2500)
    assert np.abs(counts - COUNT / 16).max() < 5 * np.sqrt(COUNT / 16)
    assert (points[:, 2] == 0).all()


def test_samples_ignore_how_finely_a_part_is_divided():
    mixed = trimesh.util.concatenate([square(0.0), square(5.0).subdivide().subdivide()])
    points = surface.sample_surface(mixed, 1000)
    assert (points[:, 2] > 2).sum() == 500  # stratified: each half of the area has half of the points


@pytest.mark.parametrize(
    "mesh", [trimesh.Trimesh(), trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)]
)
def test_no_surface_is_an_input_error(mesh):
    with pytest.raises(InputError, match="no surface"):
        surface.sample_surface(mesh)


def test_identical_surfaces():
    error = surface.compare_meshes(square(), square(), count=COUNT).all_of_it
    # nearest of 10,000 points a square metre: 5 mm on average
    assert error.accuracy_m < 0.006 and error.completeness_m < 0.006
    assert error.f_score == error.precision == error.completion_ratio == 1.0


@pytest.mark.parametrize("gap", [0.03, 0.08])
def test_concentric_spheres_are_their_gap_apart(gap):
    error = surface.compare_meshes(ball(1.0 + gap), ball(1.0), count=COUNT).all_of_it
    # points 1.8 cm apart: nearest neighbours are on average 9 mm aside, sqrt(gap^2 + 9 mm^2)
    assert error.accuracy_m == pytest.approx(gap, abs=0.002)
    assert error.accuracy_rms_m == pytest.approx(gap, abs=0.003)
    assert error.completeness_m == pytest.approx(gap, abs=0.002)
    assert error.f_score == (1.0 if gap < 0.05 else 0.0)


def test_half_a_reconstruction_is_precise_but_incomplete():
    error = surface.compare_meshes(right_part(0.0), square(), count=COUNT).all_of_it
    assert error.precision == 1.0
    # one half of width 1 and 5 cm beyond it of a width of 2
    assert error.completion_ratio == pytest.approx(0.525, abs=0.01)
    assert error.completeness_m == pytest.approx(0.25, abs=0.01)
    assert error.f_score == pytest.approx(2 * error.completion_ratio / (1 + error.completion_ratio))


def test_errors_ignore_a_common_rigid_motion():
    T = trimesh.transformations.rotation_matrix(1.1, [1, 2, 3])
    T[:3, 3] = [3, -1, 2]
    one, other = square(), square(0.02)
    before = surface.compare_meshes(one, other, count=2000).all_of_it
    after = surface.compare_meshes(
        one.copy().apply_transform(T), other.copy().apply_transform(T), count=2000
    ).all_of_it
    assert after == pytest.approx(before, abs=1e-9)


def test_observed_needs_frustum_measurement_and_no_occluder():
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, :10] = 0.0
    points = np.array(
        [
            [0.0, 0.0, 0.0],  # on the measured surface
            [0.0, 0.0, 0.015],  # within the tolerance behind it
            [0.0, 0.0, 0.03],  # hidden
            [0.0, 0.0, -1.0],  # in free space in front of it
            [0.0, 0.0, -3.0],  # behind the camera
            [5.0, 0.0, 0.0],  # beside the image
            [-1.2, 0.0, 0.0],  # where nothing was measured
        ]
    )
    expected = [True, True, False, True, False, False, False]
    np.testing.assert_array_equal(surface.observed(points, views(depth)), expected)
    shifted = views(depth)._replace(T_world_cam=np.full((1, 4, 4), np.nan))
    assert not surface.observed(points, shifted).any()


def test_only_the_observed_reference_counts():
    """Two squares behind each other: the far one is hidden, so its absence is no fault; a floater is."""
    seen = views(np.full((48, 64), 2.0, np.float32))
    reference = trimesh.util.concatenate([square(0.0, 0.9), square(1.0, 0.9)])
    unculled = surface.compare_meshes(square(0.0, 0.9), reference, count=COUNT)
    assert unculled.all_of_it.completion_ratio == pytest.approx(0.5, abs=0.01)
    assert unculled.observed_part is None and unculled.reference_kept == 1.0
    culled = surface.compare_meshes(square(0.0, 0.9), reference, seen, count=COUNT)
    assert culled.all_of_it.completion_ratio == 1.0
    assert culled.reference_kept == pytest.approx(0.5, abs=0.01)
    invented = trimesh.util.concatenate([square(0.0, 0.9), square(0.5, 0.9)])
    both = surface.compare_meshes(invented, reference, seen, count=COUNT)
    assert both.observed_part is not None
    assert both.all_of_it.precision == pytest.approx(0.5, abs=0.01)
    assert both.observed_part.precision == 1.0


def test_views_that_see_nothing_are_an_input_error():
    with pytest.raises(InputError, match="see nothing"):
        surface.compare_meshes(square(), square(), views(np.zeros((48, 64), np.float32)), count=100)


def test_depth_l1_of_a_shifted_plane_and_a_hole():
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 0.0
    error = surface.depth_l1(square(0.03, 5.0), views(depth))
    assert error.mean_m == pytest.approx(0.03, abs=1e-6) and error.uncovered == 0.0
    assert error.pixels == 48 * 32
    half = surface.depth_l1(right_part(-0.64, 5.0), views(depth))
    # of 32 columns with depth, x = (u - 31.5) / 50 * 2 is above -0.64 in 16
    assert half.uncovered == 0.5 and half.mean_m == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(InputError, match="no pixel"):
        surface.depth_l1(square(-3.0), views(depth))


def test_psnr_of_a_known_difference():
    plane = square(0.0, 5.0)
    plane.visual = trimesh.visual.ColorVisuals(plane, vertex_colors=np.full((4, 3), 100, np.uint8))
    seen = views(np.zeros((48, 64), np.float32))
    image = np.full((48, 64, 3), 110, np.uint8)
    error = surface.color_psnr(plane, seen.T_world_cam, CAMERA, [image])
    assert error.psnr_db == pytest.approx(20 * np.log10(255 / 10))
    assert error.pixels == 48 * 64 and error.uncovered == 0.0
    assert surface.color_psnr(plane, seen.T_world_cam, CAMERA, [image - 10]).psnr_db == np.inf
    with pytest.raises(InputError, match="covers no pixel"):
        surface.color_psnr(square(-3.0), seen.T_world_cam, CAMERA, [image])
