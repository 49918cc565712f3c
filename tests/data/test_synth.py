"""Synthetic sequences: geometry against closed forms, conventions, speeds, sensor, determinism, files."""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from mipsjax.config.sections import InputConfig
from mipsjax.core.camera import Intrinsics
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Sequence
from mipsjax.data.synth import __main__ as synth_main
from mipsjax.data.synth import open_synth
from mipsjax.data.synth.__main__ import main
from mipsjax.data.synth.build import assemble, ball, block, hollow, post
from mipsjax.data.synth.catalog import FPS, SPECS
from mipsjax.data.synth.mesh import reference_mesh
from mipsjax.data.synth.path import CameraPath, SpeedLimits, speeds, spline_path
from mipsjax.data.synth.render import pixel_rays, render
from mipsjax.data.synth.rooms import PAINTS, living_room
from mipsjax.data.synth.scene import Scene
from mipsjax.data.synth.sensor import SensorModel, depth_sigma, incidence, measured_color, measured_depth
from mipsjax.errors import ConfigError, InputError, OutputError

pytestmark = pytest.mark.slow

ALL = slice(None)
SMALL = Intrinsics(65.625, 65.625, 39.5, 29.5, 80, 60)

distance = jax.jit(lambda scene, points: scene.distance(points))
color_of = jax.jit(lambda scene, points: scene.color(points))
normal = jax.jit(jax.vmap(jax.grad(lambda point, scene: scene.distance(point)), in_axes=(0, None)))


@lru_cache(maxsize=1)
def ball_in_box() -> Scene:
    """A box of 4 x 3 x 4 m with a ball of radius 0.5 m in its middle, and nothing else."""
    walls = hollow((-2.0, -2.0), (2.0, 2.0), 0.0, 3.0, ("parquet", "plaster", "ceiling"))
    return assemble(
        PAINTS, [walls], [ball((0.0, 0.0), 1.0, 0.5, "red")], [], [((0.0, 2.5, 0.0), (1.0, 1.0, 1.0))]
    )


@lru_cache(maxsize=1)
def tiny() -> Sequence:
    return open_synth("tiny", ALL, InputConfig())


def pose(place: tuple[float, float, float]) -> np.ndarray:
    """A camera looking along +z."""
    T_world_cam = np.eye(4)
    T_world_cam[:3, 3] = place
    return T_world_cam


def free_points(scene: Scene, count: int, seed: int) -> np.ndarray:
    low, high = np.asarray(scene.bounds)
    points = np.random.default_rng(seed).uniform(low, high, (count, 3)).astype(np.float32)
    return points[np.asarray(distance(scene, points)) > 0.0]


def unprojected(sequence: Sequence, position: int) -> tuple[np.ndarray, np.ndarray]:
    """World points of a frame, from the documented conventions alone, and their colours."""
    frame, k = sequence[position], sequence.intrinsics
    assert frame.depth is not None and frame.color is not None and sequence.T_world_cam is not None
    v, u = np.mgrid[: k.height, : k.width]
    p_cam = (
        np.stack([(u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(u.shape)], axis=-1) * frame.depth[..., None]
    )
    T_world_cam = sequence.T_world_cam[position]
    p_world = p_cam.reshape(-1, 3) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    return p_world, frame.color.reshape(-1, 3)


# Scene


def test_distance_agrees_with_closed_forms() -> None:
    points = free_points(ball_in_box(), 2000, seed=0)
    to_ball = np.linalg.norm(points - [0.0, -1.5, 0.0], axis=1) - 0.5
    to_wall = np.min(
        [2.0 - np.abs(points[:, 0]), 2.0 - np.abs(points[:, 2]), -points[:, 1], points[:, 1] + 3.0], axis=0
    )
    np.testing.assert_allclose(distance(ball_in_box(), points), np.minimum(to_ball, to_wall), atol=2e-6)


def test_distance_of_turned_box_and_cylinder() -> None:
    walls = hollow((-9.0, -9.0), (9.0, 9.0), 0.0, 9.0, ("parquet", "plaster", "ceiling"))
    box = block((2.0, 0.0), 1.0, (2.0, 1.0, 0.4), "oak", rounding=0.1, turn_deg=90.0)
    scene = assemble(PAINTS, [walls], [box], [post((-2.0, 0.0), 1.0, 0.5, 1.0, "oak")], [])
    points = np.array(
        [[2.0, -1.5, 1.3], [2.5, -1.5, 0.0], [2.0, -2.4, 0.0], [-2.0, -1.5, 0.9], [-2.3, -2.3, 0.4]]
    )
    np.testing.assert_allclose(distance(scene, jnp.asarray(points)), [0.3, 0.3, 0.4, 0.4, 0.3], atol=1e-6)


def test_gradient_has_unit_length_away_from_creases() -> None:
    points = jnp.asarray(free_points(living_room(), 4000, seed=1))
    length = np.linalg.norm(normal(points, living_room()), axis=1)
    # Creases are surfaces of measure zero, but rounding puts a few draws on them
    assert np.mean(np.abs(length - 1.0) < 1e-3) > 0.995


def test_distance_is_a_lower_bound() -> None:
    """A step of the length of the distance in any direction stays in free space."""
    points = free_points(living_room(), 4000, seed=2)
    direction = np.random.default_rng(3).standard_normal(points.shape).astype(np.float32)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    moved = points + np.asarray(distance(living_room(), points))[:, None] * direction
    # float32 coordinates of a few metres round at 2e-7
    assert np.min(distance(living_room(), moved)) > -2e-6


def test_carved_boxes_join_without_a_wall_between() -> None:
    """Along a line through the door recess the distance is positive up to the door."""
    x = np.linspace(1.0, 2.67, 200, dtype=np.float32)
    line = np.stack([x, np.full_like(x, -1.5), np.full_like(x, 0.9)], axis=1)
    assert np.min(distance(living_room(), line)) > 5e-3


def test_color_is_within_range_and_textured() -> None:
    color = np.asarray(color_of(living_room(), jnp.asarray(free_points(living_room(), 4000, seed=4))))
    assert color.min() >= 0.0 and color.max() <= 1.0
    assert np.all(color.std(axis=0) > 0.05)


# Rendering


def test_depth_agrees_with_closed_form_of_plane_and_sphere() -> None:
    image = render(ball_in_box(), SMALL, pose((0.1, -1.4, -1.8))[None])
    v, u = np.mgrid[:60, :80]
    ray = np.stack([(u - 39.5) / 65.625, (v - 29.5) / 65.625, np.ones(u.shape)], axis=-1)
    to_walls = [
        (np.sign(ray[..., i]) * half - start) / ray[..., i]
        for i, half, start in ((0, 2.0, 0.1), (2, 2.0, -1.8))
    ]
    to_floor = np.where(ray[..., 1] > 0.0, 1.4 / ray[..., 1], -1.6 / ray[..., 1])
    offset = np.array([0.1, 0.1, -1.8])
    a, b, c = np.sum(ray * ray, axis=-1), ray @ offset, offset @ offset - 0.25
    square = b * b - a * c
    to_ball = np.where(square > 0.0, (-b - np.sqrt(np.maximum(square, 0.0))) / a, np.inf)
    expected = np.min([*to_walls, to_floor, to_ball], axis=0)
    # Rays within float32 rounding of the sphere's outline may go either way
    clear = np.abs(square) > 1e-4
    assert np.max(np.abs(image.depth - expected)[clear]) < 1e-4


@pytest.mark.parametrize("position", [0, 9])
def test_unprojected_depth_lies_on_the_surface(position: int) -> None:
    """Poses are camera-to-world with OpenCV axes: nothing else would land on the exact geometry."""
    p_world, _ = unprojected(tiny(), position)
    assert np.max(np.abs(distance(living_room(), jnp.asarray(p_world, jnp.float32)))) < 3e-4


def test_nothing_stands_before_the_rendered_surface() -> None:
    """No ray passes through a surface: all points before the hit are free."""
    T_world_cam = SPECS["tiny"].path().poses(np.array([7.0]))[0]
    depth = render(living_room(), SMALL, T_world_cam[None]).depth.ravel()
    rays = pixel_rays(jnp.asarray(T_world_cam, jnp.float32), jnp.array(SMALL[:4]), 60, 80)
    for fraction in np.linspace(0.0, 0.995, 40):
        points = jnp.stack(rays.at(jnp.asarray(depth * fraction, jnp.float32)), axis=-1)
        assert np.min(distance(living_room(), points)) > -1e-5


def test_neighbouring_frames_agree() -> None:
    """Points of one frame, seen in another, have that frame's depth and colour wherever not hidden there."""
    sequence = tiny()
    assert sequence.T_world_cam is not None
    p_world, color = unprojected(sequence, 0)
    other, k = sequence[12], sequence.intrinsics
    assert other.depth is not None and other.color is not None
    T_cam_world = np.linalg.inv(sequence.T_world_cam[12])
    x, y, z = (p_world @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]).T
    u, v = np.round(k.fx * x / z + k.cx).astype(int), np.round(k.fy * y / z + k.cy).astype(int)
    inside = (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    seen = other.depth[v[inside], u[inside]]
    assert inside.mean() > 0.7
    # The nearest pixel is up to half a pixel aside, 1/131 of the depth, on slanted surfaces more
    agrees = np.abs(seen - z[inside]) < 0.03 * z[inside]
    assert agrees.mean() > 0.93
    difference = np.abs(other.color[v[inside], u[inside]].astype(float) - color[inside])[agrees]
    assert np.median(difference) < 6.0


def test_blur_smooths_colour_and_leaves_depth() -> None:
    sharp = open_synth("room-fast", slice(40, 41), InputConfig(working_width=80))[0]
    blurred = open_synth("room-fast+blur", slice(40, 41), InputConfig(working_width=80))[0]
    assert sharp.color is not None and blurred.color is not None
    np.testing.assert_array_equal(sharp.depth, blurred.depth)
    along_x = [np.abs(np.diff(image.astype(float), axis=1)).mean() for image in (blurred.color, sharp.color)]
    assert along_x[0] < 0.9 * along_x[1]
    # Light is only moved: the mean stays
    assert abs(sharp.color.mean() - blurred.color.mean()) < 3.0


# Paths


@pytest.mark.parametrize(
    ("name", "linear", "angular"), [("room", (0.2, 0.4), (0.2, 0.5)), ("room-fast", (1.0, 4.0), (0.9, 2.2))]
)
def test_speeds(name: str, linear: tuple[float, float], angular: tuple[float, float]) -> None:
    poses = open_synth(name, ALL, InputConfig()).T_world_cam
    assert poses is not None
    for found, (low, high) in zip(speeds(poses, 1.0 / FPS), (linear, angular), strict=True):
        assert low <= found.min() and found.max() <= high
    if name == "room-fast":
        slow, fast = np.percentile(speeds(poses, 1.0 / FPS)[0], [5, 95])
        assert slow < 1.3 and fast > 3.0


@pytest.mark.parametrize("name", ["room", "room-fast"])
def test_path_keeps_clear_of_surfaces(name: str) -> None:
    sequence = open_synth(name, ALL, InputConfig())
    assert sequence.T_world_cam is not None
    places = jnp.asarray(sequence.T_world_cam[:, :3, 3], jnp.float32)
    assert np.min(distance(living_room(), places)) > 0.4


@pytest.mark.parametrize("name", ["room", "room-fast"])
def test_depth_in_view_is_that_of_a_room(name: str) -> None:
    sequence = open_synth(name, slice(0, None, 20), InputConfig(working_width=80))
    depth = np.stack([np.asarray(sequence[position].depth) for position in range(len(sequence))])
    assert depth.min() > 0.5
    assert np.mean((depth > 0.8) & (depth < 4.5)) > 0.99


@pytest.mark.parametrize("name", list(SPECS))
def test_path_is_long_enough_for_its_frames(name: str) -> None:
    path = SPECS[name].path()
    assert path.closed or (SPECS[name].frames - 1) / FPS <= path.duration


def test_slow_path_comes_back() -> None:
    poses = open_synth("room", ALL, InputConfig()).T_world_cam
    assert poses is not None
    assert np.linalg.norm(poses[-1, :3, 3] - poses[0, :3, 3]) < 0.2


def test_poses_are_rigid_and_upright() -> None:
    poses = open_synth("room-fast", ALL, InputConfig()).T_world_cam
    assert poses is not None
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (200, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    # The image's y axis points down, along gravity +y
    assert np.all(rotations[:, 1, 1] > 0.7)


def open_path() -> CameraPath:
    places = np.array([[0.0, -1.5, 0.0], [1.0, -1.4, 0.2], [2.0, -1.5, -0.1], [3.0, -1.6, 0.0]])
    limits = SpeedLimits(linear=(0.0, 2.0), angular=(0.0, 9.0))
    return spline_path(
        places, places + np.array([0.0, 0.2, 3.0]), limits, lambda s: np.ones_like(s), closed=False
    )


def test_open_path_passes_its_places_at_the_wished_pace() -> None:
    path = open_path()
    poses = path.poses(np.linspace(0.0, path.duration, 300))
    np.testing.assert_allclose(poses[[0, -1], :3, 3], [[0.0, -1.5, 0.0], [3.0, -1.6, 0.0]], atol=1e-9)
    linear, _ = speeds(poses, path.duration / 299)
    np.testing.assert_allclose(linear, 1.0, atol=1e-3)
    np.testing.assert_array_equal(path.poses(np.array([-1.0]))[0], path.poses(np.array([0.0]))[0])


# Sensor


def constant_depth(metres: float) -> np.ndarray:
    return np.full((120, 160), metres, np.float32)


WIDE = Intrinsics(131.25, 131.25, 79.5, 59.5, 160, 120)


@pytest.mark.parametrize("metres", [0.6, 1.2, 2.5, 4.0])
def test_noise_grows_with_range_as_specified(metres: float) -> None:
    model = SensorModel()
    error = measured_depth(model, constant_depth(metres), WIDE, np.random.default_rng(5)) - metres
    step = model.disparity_step * metres**2
    # Rounding to a step adds its variance, step^2 / 12, on average over depths; at one depth, with noise not
    # much wider than a step, the error depends on where the steps lie
    sigma = np.sqrt(depth_sigma(model, np.array(metres)) ** 2 + step**2 / 12.0)
    assert np.std(error) == pytest.approx(sigma, rel=0.12)
    assert abs(np.mean(error)) < 0.3 * sigma


def test_depth_is_quantised_in_disparity() -> None:
    depth = measured_depth(SensorModel(), constant_depth(3.0), WIDE, np.random.default_rng(6))
    inverse = 1.0 / (depth * SensorModel().disparity_step)
    np.testing.assert_allclose(inverse, np.round(inverse), atol=1e-4)
    assert len(np.unique(depth)) < 12


def test_range_limits_edges_and_grazing_views_are_lost() -> None:
    model, rng = SensorModel(), np.random.default_rng(7)
    assert not measured_depth(model, constant_depth(0.3), WIDE, rng).any()
    assert not measured_depth(model, constant_depth(7.0), WIDE, rng).any()
    step = constant_depth(1.0)
    step[:, 80:] = 2.0
    lost = measured_depth(model, step, WIDE, rng) == 0.0
    assert 0.4 < lost[:, 79:81].mean() < 0.7
    assert not lost[:, :70].any()


def test_incidence_of_a_slanted_plane() -> None:
    """z = 2 + x: the normal (1, 0, -1) is 45 degrees off the optical axis."""
    v, u = np.mgrid[:120, :160]
    x = (u - WIDE.cx) / WIDE.fx
    depth = (2.0 / (1.0 - x)).astype(np.float32)
    ray = np.stack([x, (v - WIDE.cy) / WIDE.fy, np.ones(x.shape)], axis=-1)
    expected = np.arccos((1.0 - x) / (np.sqrt(2.0) * np.linalg.norm(ray, axis=-1)))
    inner = (slice(1, -1), slice(1, -1))
    # Central differences of the points stay in the plane; float32 depth rounds them
    np.testing.assert_allclose(incidence(depth, WIDE)[inner], expected[inner], atol=2e-3)


def test_colour_noise_has_its_sigma() -> None:
    color = np.full((120, 160, 3), 128, np.uint8)
    noisy = measured_color(SensorModel(exposure_sigma=0.0), color, np.random.default_rng(8))
    # Rounding to whole values adds 1/12
    assert np.std(noisy) == pytest.approx(np.sqrt(4.0 + 1.0 / 12.0), rel=0.02)


# Sequence


def test_is_a_sequence() -> None:
    sequence = tiny()
    assert isinstance(sequence, Sequence)
    frame = sequence[3]
    assert frame.color is not None and frame.depth is not None
    assert frame.color.shape == (60, 80, 3) and frame.color.dtype == np.uint8
    assert frame.depth.shape == (60, 80) and frame.depth.dtype == np.float32
    assert (frame.number, frame.timestamp, frame.problem) == (3, 3 / FPS, "")
    assert len(sequence) == 16 and 10.0 < frame.color.mean() < 240.0
    with pytest.raises(IndexError):
        sequence[16]


@pytest.mark.parametrize("name", ["tiny", "tiny+noise", "tiny+noise+blur"])
def test_same_name_same_bits(name: str) -> None:
    """In any order, in any selection, after leaving the cache."""
    whole, part = open_synth(name, ALL, InputConfig()), open_synth(name, slice(2, 15, 4), InputConfig())
    late = [part[position] for position in (3, 0)]
    for frame, position in zip(late, (14, 2), strict=True):
        np.testing.assert_array_equal(frame.color, whole[position].color)
        np.testing.assert_array_equal(frame.depth, whole[position].depth)
        assert frame.number == position and frame.timestamp == whole.timestamps[position]


def test_noise_differs_between_frames_and_from_clean() -> None:
    noisy = open_synth("tiny+noise", ALL, InputConfig())
    clean = tiny()[0].depth
    first, second = noisy[0].depth, noisy[1].depth
    assert first is not None and second is not None and clean is not None
    assert not np.array_equal(first, second)
    measured = first > 0.0
    assert 0.8 < measured.mean() < 1.0
    # A few pixels at edges jump between surfaces; noise at 4 m is 3 cm
    assert np.median(np.abs(first - clean)[measured]) < 0.02


def test_depth_outside_the_range_of_the_input_is_no_measurement() -> None:
    near, far = 1.5, 3.0
    depth = open_synth("tiny", ALL, InputConfig(depth_min=near, depth_max=far))[0].depth
    assert depth is not None
    assert (depth == 0.0).any() and np.all((depth == 0.0) | ((depth >= near) & (depth <= far)))


def test_working_width_decimates() -> None:
    whole = open_synth("tiny", slice(5, 6), InputConfig())
    half = open_synth("tiny", slice(5, 6), InputConfig(working_width=40))
    assert half.intrinsics == whole.intrinsics.decimated(2)
    full_depth, half_depth = whole[0].depth, half[0].depth
    assert full_depth is not None and half_depth is not None
    # The same rays, so the same depth to rounding, but for a few on outlines
    assert np.mean(np.abs(full_depth[::2, ::2] - half_depth) < 1e-4) > 0.999


@pytest.mark.parametrize("name", ["nowhere", "room+snow", "room+noise+noise", "", "room-fast+"])
def test_unknown_names_are_refused_with_the_known_ones(name: str) -> None:
    with pytest.raises(InputError, match=r"room, room-fast, tiny"):
        open_synth(name, ALL, InputConfig())


@pytest.mark.parametrize("frames", [slice(16, None), slice(5, 5), slice(None, None, -1)])
def test_empty_selections_are_refused(frames: slice) -> None:
    with pytest.raises(InputError, match="it has 16"):
        open_synth("tiny", frames, InputConfig())


# Mesh and files


def test_mesh_of_ball_in_box_is_exact() -> None:
    mesh = reference_mesh(ball_in_box(), voxel_m=0.08)
    assert mesh.is_watertight
    assert np.max(np.abs(distance(ball_in_box(), jnp.asarray(mesh.vertices, jnp.float32)))) < 2e-6
    box, sphere = sorted(mesh.split(), key=lambda part: part.volume)
    # Normals point into free space: outwards from the ball, inwards from the walls, whose volume is negative.
    # Cut edges and corners: 44 m of edge at 45 degrees take less than half a voxel squared each metre
    assert box.volume == pytest.approx(-48.0, abs=44 * 0.5 * 0.08**2)
    # Facets of 8 cm lie up to (8 cm)^2 / (8 x 0.5 m) = 1.6 mm inside the ball: 1 % of its volume
    assert sphere.volume == pytest.approx(np.pi / 6.0, rel=0.02)
    visual: Any = sphere.visual
    red = np.asarray(visual.vertex_colors)[:, :3].mean(axis=0)
    assert red[0] > 1.5 * red[1]


def test_mesh_of_room_is_on_the_surface() -> None:
    mesh = reference_mesh(living_room(), voxel_m=0.12)
    off = np.abs(distance(living_room(), jnp.asarray(mesh.vertices, jnp.float32)))
    # Cells of 12 cm hold several creases of a chair's leg, and there a correction may miss
    assert np.quantile(off, 0.99) < 1e-5 and np.max(off) < 0.02
    np.testing.assert_allclose(mesh.bounds[[0, 1], 1], [-2.6, 0.0], atol=1e-4)


def test_export_round_trip(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "room"
    assert main(["tiny", str(out), "--frames", "2:9:3", "--voxel", "0.12"]) == 0
    assert "3 frames" in capsys.readouterr().out
    frames = [tiny()[index] for index in (2, 5, 8)]
    listed = [
        line.split() for line in (out / "depth.txt").read_text().splitlines() if not line.startswith("#")
    ]
    for (time, file), frame in zip(listed, frames, strict=True):
        assert float(time) == pytest.approx(frame.timestamp, abs=1e-6)
        raw = cv2.imread(str(out / file), cv2.IMREAD_UNCHANGED)
        color = cv2.imread(str(out / file.replace("depth", "rgb")))
        assert raw is not None and color is not None and frame.depth is not None
        assert raw.dtype == np.uint16
        # Half a unit of 1/5000 m
        np.testing.assert_allclose(raw / 5000.0, frame.depth, atol=1.001e-4)
        np.testing.assert_array_equal(color[..., ::-1], frame.color)
    camera = json.loads((out / "camera.json").read_text())
    assert camera == {**tiny().intrinsics._asdict(), "depth_scale": 5000.0, "fps": FPS}
    assert isinstance(trimesh.load(out / "mesh.ply"), trimesh.Trimesh)


def test_exported_folder_opens_as_the_same_sequence(tmp_path: Path) -> None:
    assert main(["tiny+noise", str(tmp_path / "room"), "--frames", "0:12:4", "--no-mesh"]) == 0
    sequence = open_sequence(tmp_path / "room")
    original = open_synth("tiny+noise", slice(0, 12, 4), InputConfig())
    assert sequence.layout == "tum" and sequence.intrinsics == original.intrinsics
    assert sequence.T_world_cam is not None and original.T_world_cam is not None
    np.testing.assert_allclose(sequence.T_world_cam, original.T_world_cam, atol=1e-7)
    depth, expected = sequence[2].depth, original[2].depth
    assert depth is not None and expected is not None
    np.testing.assert_allclose(depth, expected, atol=1.001e-4)


def test_errors_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["nowhere", str(tmp_path / "new")]) == InputError.exit_code
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").write_text("")
    assert main(["tiny", str(tmp_path / "full")]) == OutputError.exit_code
    (tmp_path / "file").write_text("")
    assert main(["tiny", str(tmp_path / "file" / "new")]) == OutputError.exit_code
    assert main(["tiny"]) == ConfigError.exit_code
    assert main(["tiny", str(tmp_path / "new"), "--voxel", "small"]) == ConfigError.exit_code
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 5 and all(line.startswith("error: ") for line in errors)


@pytest.mark.parametrize("voxel", ["0", "-1", "nan", "inf", "1e-9", "1e9"])
def test_export_refuses_cells_of_no_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], voxel: str
) -> None:
    assert main(["tiny", str(tmp_path / "new"), f"--voxel={voxel}"]) == ConfigError.exit_code
    assert "--voxel" in capsys.readouterr().err and not (tmp_path / "new").exists()


def test_export_that_is_interrupted_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(synth_main, "export_tum", interrupted)
    assert main(["tiny", str(tmp_path / "new")]) == 130
    assert capsys.readouterr().err == "interrupted: the folder is not whole\n"
