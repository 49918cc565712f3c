"""Meshing against analytic fields: a sphere, a plane and a box room seen from inside."""

import logging
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from mipsjax.errors import OutputError
from mipsjax.mesh import lattice, meshing
from mipsjax.mesh.ply import export_ply, restore_uncertainty

VOXEL = 0.02
RADIUS = 0.83
CENTRE = np.array([0.013, -0.27, 0.41])
ROOM = np.array([2.0, 1.4, 1.1])
"""Half extents of the room in metres; multiples of neither voxel nor tile."""


def sphere(points):
    """Solid sphere: positive outside. The entropy is x, to have something to compare with."""
    distance = np.linalg.norm(points - CENTRE, axis=1) - RADIUS
    return np.clip(distance, -0.1, 0.1).astype(np.float32), points[:, 0].astype(np.float32)


def room(points):
    """Free space inside a box: positive inside."""
    distance = (ROOM - np.abs(points)).min(axis=1)
    return distance.astype(np.float32), np.full(len(points), 0.3, np.float32)


def on_sphere(count=60_000, seed=0):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return CENTRE + RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def on_room():
    box = trimesh.creation.box(2 * ROOM)
    return np.asarray(box.sample(80_000, seed=3))


def test_sphere_is_accurate_closed_and_faces_free_space():
    mesh = meshing.extract(sphere, on_sphere(), VOXEL)
    off = np.linalg.norm(mesh.vertices - CENTRE, axis=1) - RADIUS
    # linear interpolation of a distance along an edge errs by at most voxel^2 / (8 R), the nudge 20 um
    assert np.abs(off).max() < VOXEL / 100
    # a sphere of 1.7 m spans several tiles in each direction: closed means that they are joined
    assert np.ptp(mesh.vertices, axis=0).min() > 2 * lattice.TILE * VOXEL
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.euler_number == 2
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=2e-3)


def test_room_normals_point_inside():
    mesh = meshing.extract(room, on_room(), VOXEL)
    assert mesh.is_watertight
    # free space is inside, so the enclosed volume counts negative; edges are cut by half a voxel at most
    assert mesh.volume == pytest.approx(-8 * np.prod(ROOM), rel=0.02)
    distance = np.abs((ROOM - np.abs(mesh.vertices)).min(axis=1))
    assert distance.max() < VOXEL / 4


def test_a_noisy_field_is_joined_without_seams():
    """Ambiguous cells, many components and zero values exactly on the lattice: still closed after joining."""
    waves = np.array([[31.0, 7.0, 3.0], [5.0, 41.0, 11.0], [13.0, 3.0, 37.0]])

    def field(points):
        return np.sin(points @ waves.T).sum(axis=1).round(2) * 0.02, np.zeros(len(points))

    grid = np.stack(np.meshgrid(*[np.arange(-0.5, 0.5, 0.02)] * 3, indexing="ij"), -1).reshape(-1, 3)
    mesh = meshing.extract(field, grid, VOXEL, margin_m=0.01, min_component_m2=0.0)
    edges, count = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    middle = mesh.vertices[edges].mean(axis=1)
    inner = np.abs(middle).max(axis=1) < 0.45
    assert inner.sum() > 5_000
    assert (count[inner] == 2).all()


def test_the_same_surface_whatever_the_tiling(monkeypatch):
    whole = meshing.extract(sphere, on_sphere(), VOXEL)
    monkeypatch.setattr(lattice, "TILE", 16)
    monkeypatch.setattr(lattice, "QUERY_POINTS", 1000)
    small = meshing.extract(sphere, on_sphere(), VOXEL)
    assert len(small.vertices) == len(whole.vertices) and len(small.faces) == len(whole.faces)
    distance, index = KDTree(whole.vertices).query(small.vertices)
    # float32 rounding of the coordinates in a tile, 4e-6 voxels, and of the result
    assert distance.max() < 1e-6 and len(np.unique(index)) == len(index)


def test_unobserved_space_is_neither_queried_nor_meshed():
    seen = on_sphere()
    seen = seen[seen[:, 2] > CENTRE[2] + 0.1]
    asked = []

    def query(points):
        asked.append(points)
        return sphere(points)

    margin = 0.05
    mesh = meshing.extract(query, seen, VOXEL, margin)
    # a point may be rounded to the lattice by half a cell diagonal; mesh vertices lie between queried ones
    limit = margin + VOXEL * np.sqrt(3) / 2
    for points in (np.concatenate(asked), mesh.vertices):
        distance, _ = KDTree(seen).query(points)
        assert distance.max() <= limit + 1e-6
    assert not mesh.is_watertight and mesh.vertices[:, 2].min() > CENTRE[2] + 0.1 - limit


def test_each_lattice_vertex_is_queried_once():
    asked = []

    def query(points):
        asked.append(points)
        return sphere(points)

    mesh = meshing.extract(query, on_sphere(), VOXEL)
    lattice = np.concatenate(asked)[: -len(mesh.vertices)]
    assert len(np.unique(np.rint(lattice / VOXEL), axis=0)) == len(lattice)


@pytest.mark.fault(53)
def test_values_that_cannot_be_trusted_leave_holes_not_nans():
    def query(points):
        tsdf, entropy = sphere(points)
        tsdf[points[:, 0] > 0.5] = np.nan
        entropy = np.where(points[:, 1] > 0.1, 2.0, 0.1)
        return tsdf, entropy

    mesh = meshing.extract(query, on_sphere(), VOXEL, max_entropy=1.0)
    assert len(mesh.faces) > 1000 and np.isfinite(mesh.vertices).all()
    assert mesh.vertices[:, 0].max() <= 0.5 and mesh.vertices[:, 1].max() <= np.float32(0.1)


def test_band_leaves_out_the_jump_behind_a_surface():
    """A field truncated at tau that jumps back to +tau 5 cm behind the surface, inside the margin."""

    def query(points):
        distance = -points[:, 2] - 0.003
        return np.where(distance < -0.05, 0.1, np.where(distance < -0.02, -0.1, distance)), np.zeros(
            len(points)
        )

    x, y = np.meshgrid(np.arange(0, 1, 0.01), np.arange(0, 1, 0.01))
    seen = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    assert meshing.extract(query, seen, VOXEL, 0.08).vertices[:, 2].max() > 0.03
    assert meshing.extract(query, seen, VOXEL, 0.08, band_m=0.095).vertices[:, 2].max() < 0.01


def test_small_pieces_are_dropped():
    def query(points):
        speck = np.linalg.norm(points - (CENTRE + np.array([0, 0, RADIUS + 0.3])), axis=1) - 0.05
        return np.minimum(sphere(points)[0], speck), np.zeros(len(points))

    seen = np.concatenate([on_sphere(), CENTRE + np.array([0, 0, RADIUS + 0.3]) + 0.05 * np.eye(3)])
    with_speck = meshing.extract(query, seen, VOXEL, 0.1, min_component_m2=0.0)
    without = meshing.extract(query, seen, VOXEL, 0.1, min_component_m2=0.05)
    assert with_speck.body_count == 2 and without.body_count == 1
    assert without.vertices[:, 2].max() < CENTRE[2] + RADIUS + 0.01


def test_colour_and_uncertainty_belong_to_their_vertices(tmp_path):
    mesh = meshing.extract(sphere, on_sphere(), VOXEL, color=lambda points: 0.5 + 0.5 * points)
    np.testing.assert_allclose(mesh.vertex_attributes["uncertainty"], mesh.vertices[:, 0], atol=1e-6)
    expected = np.rint(255 * np.clip(0.5 + 0.5 * mesh.vertices.astype(np.float32), 0, 1))
    assert np.abs(np.asarray(mesh.visual.vertex_colors)[:, :3] - expected).max() <= 1
    export_ply(tmp_path / "mesh.ply", mesh)
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(read.vertices, mesh.vertices)
    np.testing.assert_array_equal(read.faces, mesh.faces)
    np.testing.assert_array_equal(read.visual.vertex_colors, mesh.visual.vertex_colors)
    restore_uncertainty(read)
    np.testing.assert_array_equal(
        read.vertex_attributes["uncertainty"], mesh.vertex_attributes["uncertainty"]
    )


def test_a_mesh_of_another_program_has_no_uncertainty(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.ply")
    read = trimesh.load_mesh(tmp_path / "box.ply", process=False)
    restore_uncertainty(read)
    assert "uncertainty" not in read.vertex_attributes


def test_same_bytes_twice_and_for_shuffled_points(tmp_path):
    points = on_sphere()
    for name, seen in (("a", points), ("b", points), ("c", np.random.default_rng(1).permutation(points))):
        export_ply(tmp_path / name, meshing.extract(sphere, seen, VOXEL))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes() == (tmp_path / "c").read_bytes()


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((4, 3), np.nan), np.full((5, 3), 3.0)])
@pytest.mark.fault(53)
def test_no_surface_gives_an_empty_mesh_and_a_warning(points, tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        mesh = meshing.extract(sphere, points, VOXEL, color=lambda p: p)
    assert len(mesh.faces) == 0 and "no surface" in caplog.text
    export_ply(tmp_path / "empty.ply", mesh)
    read = trimesh.load_mesh(tmp_path / "empty.ply", process=False)
    assert len(read.vertices) == 0 and len(read.faces) == 0
    assert len(meshing.cull(mesh, points, 0.1).vertices) == 0


def test_far_away_and_negative_coordinates():
    shift = np.array([-137.5, 812.25, -3.125])
    mesh = meshing.extract(lambda p: sphere(p.astype(np.float64) - shift), on_sphere() + shift, VOXEL)
    assert mesh.is_watertight
    # float32 holds coordinates near 800 m to 0.06 mm
    assert np.abs(np.linalg.norm(mesh.vertices - shift - CENTRE, axis=1) - RADIUS).max() < VOXEL / 20


@pytest.mark.parametrize(("voxel", "margin"), [(0.0, 0.1), (-0.02, 0.1), (0.02, 0.0)])
def test_nonsense_sizes_are_refused(voxel, margin):
    with pytest.raises(ValueError, match="must be positive"):
        meshing.extract(sphere, on_sphere(10), voxel, margin)


def test_points_beyond_the_lattice_are_refused():
    with pytest.raises(ValueError, match="too far"):
        meshing.extract(sphere, np.full((1, 3), 1e6), VOXEL)


def test_a_margin_wider_than_a_tile(monkeypatch):
    monkeypatch.setattr(lattice, "TILE", 8)
    mesh = meshing.extract(sphere, on_sphere(1), 0.1, margin_m=2.0)
    assert mesh.is_watertight


def test_cull_keeps_what_is_near_with_its_attributes():
    mesh = meshing.extract(sphere, on_sphere(), VOXEL, color=lambda p: 0.5 + 0.5 * p)
    half = on_sphere()[on_sphere()[:, 2] > CENTRE[2]]
    kept = meshing.cull(mesh, np.concatenate([half, np.full((1, 3), np.nan)]), 0.03)
    assert 0.4 < len(kept.vertices) / len(mesh.vertices) < 0.6
    assert kept.vertices[:, 2].min() > CENTRE[2] - 0.03
    np.testing.assert_allclose(kept.vertex_attributes["uncertainty"], kept.vertices[:, 0], atol=1e-6)
    assert len(kept.visual.vertex_colors) == len(kept.vertices)


def test_an_unwritable_place_is_reported_and_leaves_nothing(tmp_path):
    mesh = trimesh.creation.box()
    with pytest.raises(OutputError, match="cannot write"):
        export_ply(tmp_path / "missing" / "mesh.ply", mesh)
    (tmp_path / "mesh.ply").mkdir()
    with pytest.raises(OutputError, match="cannot write"):
        export_ply(Path(tmp_path / "mesh.ply"), mesh)
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]
