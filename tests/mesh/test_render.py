"""Ray casting against planes and spheres whose depth is known in closed form, and the overview picture."""

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics
from mipsjax.errors import OutputError
from mipsjax.mesh import picture, render

CAMERA = Intrinsics(70.3, 71.9, 39.2, 30.7, 80, 60)
FLOAT32 = 1e-6
"""Relative rounding of the float32 depth image, with some room."""


def pose(seed=0):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = rng.normal(size=3)
    return T


def quad(corners):
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def tilted_plane(T_world_cam, normal, distance):
    """A large square in the plane normal . p_cam = distance, in world coordinates."""
    across = np.cross(normal, [0.3, 1.0, 0.2])
    along = np.cross(normal, across)
    middle = distance * np.asarray(normal) / np.dot(normal, normal)
    corners = middle + 50 * np.array([across + along, across - along, -across - along, along - across])
    return quad(corners @ T_world_cam[:3, :3].T + T_world_cam[:3, 3])


@pytest.mark.parametrize(("normal", "distance"), [((0.0, 0.0, 1.0), 2.5), ((0.3, -0.2, 1.0), 1.7)])
def test_depth_of_a_plane_is_exact(normal, distance):
    T = pose()
    seen = render.render_mesh(tilted_plane(T, normal, distance), T, CAMERA)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    np.testing.assert_allclose(seen.depth, distance / (rays @ np.array(normal)), rtol=FLOAT32)
    assert seen.depth.dtype == np.float32 and seen.color.shape == (60, 80, 3)


def test_what_is_behind_or_beside_is_not_seen():
    T = np.eye(4)
    behind = quad([[-1, -1, -2], [1, -1, -2], [1, 1, -2], [-1, 1, -2]])
    seen = render.render_mesh(behind, T, CAMERA, background=(1, 2, 3))
    assert not seen.depth.any() and (seen.color == (1, 2, 3)).all()


def test_the_nearest_surface_hides_the_others():
    near, far = (quad([[-5, -5, z], [5, -5, z], [5, 5, z], [-5, 5, z]]) for z in (1.0, 2.0))
    seen = render.render_mesh(trimesh.util.concatenate([far, near]), np.eye(4), CAMERA)
    np.testing.assert_allclose(seen.depth, 1.0, rtol=FLOAT32)


def test_unshaded_colours_are_interpolated_between_vertices():
    colors = np.array([[0, 0, 0], [200, 0, 0], [200, 100, 0], [0, 100, 0]], np.uint8)
    corners = [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
    plane = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], vertex_colors=colors, process=False)
    seen = render.render_mesh(plane, np.eye(4), CAMERA, shaded=False)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    expected = np.stack([100 + 100 * (u - CAMERA.cx) / CAMERA.fx, 50 + 50 * (v - CAMERA.cy) / CAMERA.fy], -1)
    hit = seen.depth > 0
    # the colour is rounded to whole numbers
    assert np.abs(seen.color[..., :2] - expected)[hit].max() <= 0.5 + 1e-3
    shaded = render.render_mesh(plane, np.eye(4), CAMERA)
    assert (shaded.color[hit] <= seen.color[hit]).all() and (shaded.color[hit] < seen.color[hit]).any()


def test_batches_do_not_change_the_image(monkeypatch):
    mesh = trimesh.creation.icosphere(subdivisions=3)
    T = np.eye(4)
    T[2, 3] = -3
    whole = render.render_mesh(mesh, T, CAMERA)
    monkeypatch.setattr(render, "RAYS_PER_BATCH", 100)
    for one, other in zip(whole, render.render_mesh(mesh, T, CAMERA), strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_empty_mesh_is_background():
    empty = trimesh.Trimesh()
    seen = render.render_mesh(empty, np.eye(4), CAMERA)
    assert not seen.depth.any() and (seen.color == 255).all()
    assert (picture.picture(empty, (40, 30)) == 255).all()


def test_degenerate_triangles_do_no_harm():
    corners = [[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
    mesh = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3], [0, 0, 1], [0, 1, 1]], process=False)
    seen = render.render_mesh(mesh, np.eye(4), CAMERA)
    assert np.isfinite(seen.depth).all() and (seen.depth[25:35, 35:45] > 0).all()


def test_up_is_against_the_cameras_down():
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("x", [[-100], [-80], [-90]], degrees=True).as_matrix()
    up = picture.up_direction(np.concatenate([T, np.full((1, 4, 4), np.nan)]))
    np.testing.assert_allclose(up, -T[2, :3, 1], atol=1e-9)
    np.testing.assert_array_equal(picture.up_direction(np.full((2, 4, 4), np.nan)), [0, -1, 0])


def room():
    """A box room with normals to the inside, floor z = 0, walls of one colour and a coloured floor."""
    box = trimesh.creation.box((4.0, 3.0, 2.5))
    box.invert()
    box.apply_translation([0, 0, 1.25])
    box.unmerge_vertices()
    floor = box.vertices[:, 2] < 1e-6
    floor &= np.repeat(np.abs(box.face_normals[:, 2]) > 0.9, 3)
    colors = np.where(floor[:, None], [250, 20, 20], [90, 90, 90]).astype(np.uint8)
    return trimesh.Trimesh(box.vertices, box.faces, vertex_colors=colors, process=False)


def test_level_turns_up_to_the_floors_normal():
    tilted = Rotation.from_rotvec([0.2, -0.1, 0.0]).apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(picture.level(room(), tilted), [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(picture.level(room(), -tilted), [0, 0, -1], atol=1e-9)


def test_one_looks_into_a_closed_room():
    image = picture.picture(room(), (160, 120), np.array([0.05, 0.02, 1.0]))
    assert image.shape == (120, 160, 3) and image.dtype == np.uint8
    red = (image[..., 0] > 2 * image[..., 1].astype(int)).mean()
    grey = ((image[..., 0] == image[..., 1]) & (image[..., 0] < 200)).mean()
    # the ceiling does not hide the floor, the far walls are there, and the margin is white
    assert red > 0.15 and grey > 0.05
    assert (image[[0, -1]] == 255).all() and (image[:, [0, -1]] == 255).all()


def test_a_closed_room_seen_upside_down_shows_the_ceiling():
    image = picture.picture(room(), (160, 120), np.array([0.0, 0.0, -1.0]))
    assert not (image[..., 0] > 2 * image[..., 1].astype(int)).any()


def test_saved_picture_is_a_png_of_the_same_pixels(tmp_path):
    picture.save_picture(tmp_path / "room.png", room(), np.array([0.0, 0.0, 1.0]), (80, 60))
    read = cv2.imread(str(tmp_path / "room.png"))[..., ::-1]
    np.testing.assert_array_equal(read, picture.picture(room(), (80, 60), np.array([0.0, 0.0, 1.0])))
    with pytest.raises(OutputError, match="cannot write"):
        picture.save_picture(tmp_path / "missing" / "room.png", room(), size=(8, 6))
