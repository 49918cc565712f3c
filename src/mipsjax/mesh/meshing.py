"""From a field to a coloured mesh: evaluated only near observed surface, meshed tile by tile.

The field is a callable, so the same code meshes a network, several blended submaps or an analytic scene.
Tiles of the lattice share the values on their common faces, hence they meet without a seam.

Memory: 6 bytes a lattice vertex within the margin (17 million for 1000 square metres at 2 cm), one batch
of queries and one dense tile at a time, and the mesh.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from mipsjax.mesh import lattice
from mipsjax.mesh.lattice import Query, Samples, Tile, evaluate, pack, voxelised
from mipsjax.mesh.render import vertex_colors

log = logging.getLogger(__name__)

ON_LATTICE = 1e-4
"""Voxels. Between the rounding of float32 coordinates (4e-6) and the least distance from a lattice vertex
that the nudge leaves (2.5e-4 where the other end of the edge has the clip value)."""
CLIP = 4.0
"""Voxels. No true distance is larger in a cell that the surface crosses; clipping bounds the ratio above."""
MIN_COMPONENT_M2 = 0.01
"""A detached piece of surface smaller than a hand (10 cm x 10 cm) is noise."""
MARGIN_M = 0.06
"""Surface is sought this far from observed points: twice the noise of a depth camera plus the drift of a
submap."""

Color = Callable[[Float32[np.ndarray, "M 3"]], np.ndarray]
"""World points in metres to RGB [M 3], uint8 or floats from 0 to 1."""

_CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])


class _Piece(NamedTuple):
    """Mesh of one tile. A vertex's key is the same in every tile that has it."""

    key: Int[np.ndarray, "V"]
    position: Float[np.ndarray, "V 3"]
    """Voxels, in the lattice."""
    faces: Int[np.ndarray, "F 3"]


def extract(
    query: Query,
    observed_points: Float[np.ndarray, "N 3"],
    voxel_m: float,
    margin_m: float = MARGIN_M,
    color: Color | None = None,
    band_m: float | None = None,
    max_entropy: float | None = None,
    min_component_m2: float = MIN_COMPONENT_M2,
) -> trimesh.Trimesh:
    """Zero surface of the field near observed points, as a coloured mesh whose normals point into free space.

    A lattice cell is meshed only where all eight corners are within `margin_m` of an observed point (points
    rounded to the lattice), have finite values and, if given, an entropy of at most `max_entropy`, and where
    at least one corner is nearer to the surface than `band_m` (a field truncated at tau jumps from -tau to
    tau behind a surface: a band below tau leaves these out). Detached pieces below `min_component_m2` square
    metres are dropped.

    Returns a mesh with vertex colours (if `color` is given) and the vertex attribute `uncertainty`, the
    entropy at the vertex. Where there is no surface, an empty mesh is returned and a warning logged.

    Raises:
        ValueError: the voxel size or the margin is not positive, or points lie beyond the lattice.
    """
    if not (voxel_m > 0 and margin_m > 0):
        raise ValueError(f"voxel size and margin must be positive, not {voxel_m} and {margin_m}")
    limits = (np.inf if band_m is None else band_m / voxel_m, np.inf if max_entropy is None else max_entropy)
    store = evaluate(query, voxelised(observed_points, voxel_m), voxel_m, margin_m / voxel_m, limits[1])
    # In one order, so that the same map gives the same bytes
    pieces = [_mesh_tile(store, tile, limits[0]) for tile in sorted(_meshed_tiles(store))]
    vertices, faces = _merged([piece for piece in pieces if piece is not None])
    vertices = (vertices * voxel_m).astype(np.float32)
    vertices, faces = _without_small(vertices, faces, min_component_m2)
    if len(faces) == 0:
        log.warning("no surface found near the %d observed points: the mesh is empty", len(observed_points))
    return _finished(vertices, faces, query, color)


def cull(mesh: trimesh.Trimesh, points: Float[np.ndarray, "N 3"], distance_m: float) -> trimesh.Trimesh:
    """Mesh without the vertices farther than `distance_m` from all observed points, and without their faces.

    Colours and `uncertainty` are kept. Non-finite points are ignored; without any point the result is empty.
    """
    points = points[np.isfinite(points).all(axis=1)]
    near = np.zeros(len(mesh.vertices), bool)
    if len(points) and len(mesh.vertices):
        distance, _ = KDTree(points).query(mesh.vertices, distance_upper_bound=distance_m, workers=-1)
        near = np.isfinite(distance)
    return _keep_vertices(mesh, near)


def _meshed_tiles(store: dict[Tile, Samples]) -> set[Tile]:
    """Tiles that own a cell with values: those with samples and their lower neighbours."""
    return {(x - int(i), y - int(j), z - int(k)) for x, y, z in store for i, j, k in _CORNERS}


def _mesh_tile(store: dict[Tile, Samples], tile: Tile, band: float) -> _Piece | None:
    """Marching cubes over the cells of one tile; None where the surface does not cross it."""
    volume = _volume(store, tile)
    known = np.isfinite(volume)
    corners = [
        tuple(slice(o, o + lattice.TILE) for o in corner) for corner in _CORNERS
    ]  # the eight shifted views whose entry [i, j, k] is one corner of cell (i, j, k)
    cell = np.logical_and.reduce([known[c] for c in corners])
    values = np.stack([np.where(cell, volume[c], 1.0) for c in corners])
    cell &= (values.min(axis=0) < 0) & (values.max(axis=0) > 0) & (np.abs(values).min(axis=0) < band)
    if not cell.any():
        return None
    # the mask entry of a cell is that of its far corner
    mask = np.zeros(volume.shape, bool)
    mask[1:, 1:, 1:] = cell
    # Marching cubes takes no NaN; the mask keeps cells with an unknown corner out
    filled = np.clip(np.where(known, volume, 1.0), -CLIP, CLIP).astype(np.float32)
    position, faces, _, _ = marching_cubes(filled, 0.0, mask=mask)
    placed = position.astype(np.float64) + np.array(tile) * lattice.TILE
    return _Piece(_edge_keys(position, tile), placed, faces.astype(np.int64))


def _volume(store: dict[Tile, Samples], tile: Tile) -> Float32[np.ndarray, "S S S"]:
    """Values of a tile and of the first vertices of its upper neighbours; NaN where there are none."""
    volume = np.full((lattice.TILE + 1,) * 3, np.nan, np.float32)
    for corner in _CORNERS:
        x, y, z = (int(t + o) for t, o in zip(tile, corner, strict=True))
        if (x, y, z) in store:
            samples = store[x, y, z]
            local = (
                np.stack(np.unravel_index(samples.vertex, (lattice.TILE,) * 3), axis=1)
                + corner * lattice.TILE
            )
            inside = (local <= lattice.TILE).all(axis=1)
            volume[tuple(local[inside].T)] = samples.tsdf[inside]
    return volume


def _edge_keys(position: Float32[np.ndarray, "V 3"], tile: Tile) -> Int[np.ndarray, "V"]:
    """The lattice edge of every mesh vertex, as one integer, equal in all tiles that share the edge.

    A vertex lies on an edge, off the lattice in one coordinate, or, in a few ambiguous cases of marching
    cubes, alone in the middle of its cell. Positions cannot serve: their last bits depend on the tile.
    """
    off = np.abs(position - np.rint(position))
    axis = np.where((off > ON_LATTICE).sum(axis=1) > 1, 3, np.argmax(off, axis=1))
    along = (axis[:, None] == np.arange(3)) | (axis[:, None] == 3)
    base = np.where(along, np.floor(position), np.rint(position)).astype(np.int64)
    base += np.array(tile) * lattice.TILE
    return pack(base) * 4 + axis


def _merged(pieces: list[_Piece]) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """One mesh of all tiles, with the vertices on common edges unified. Voxels."""
    if not pieces:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    starts = np.cumsum([0, *(len(piece.key) for piece in pieces[:-1])])
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, starts, strict=True)])
    _, first, inverse = np.unique(
        np.concatenate([piece.key for piece in pieces]), return_index=True, return_inverse=True
    )
    return np.concatenate([piece.position for piece in pieces])[first], inverse.ravel()[faces]


def _without_small(
    vertices: Float32[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], min_area_m2: float
) -> tuple[Float32[np.ndarray, "W 3"], Int[np.ndarray, "G 3"]]:
    """The mesh without connected pieces below an area, and without unused vertices."""
    count = len(vertices)
    if count == 0:
        return vertices, faces
    # Two of its three edges join the corners of a triangle
    links = (np.ones(2 * len(faces), np.int8), (faces[:, :2].ravel(), faces[:, 1:].ravel()))
    _, label = connected_components(coo_matrix(links, shape=(count, count)), directed=False)
    corners = vertices[faces].astype(np.float64)
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    large = np.bincount(label[faces[:, 0]], areas, minlength=count) >= min_area_m2
    faces = faces[large[label[faces[:, 0]]]]
    used = np.zeros(count, bool)
    used[faces] = True
    # The new number of a vertex is how many of the used ones come before it
    return vertices[used], (np.cumsum(used) - 1)[faces]


def _finished(
    vertices: Float32[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], query: Query, color: Color | None
) -> trimesh.Trimesh:
    """The mesh with its colours and uncertainty, asked from the field at the vertices."""
    uncertainty = np.zeros(0, np.float32)
    colors = None if color is None else np.zeros((0, 3), np.uint8)
    parts = [vertices[i : i + lattice.QUERY_POINTS] for i in range(0, len(vertices), lattice.QUERY_POINTS)]
    if parts:
        uncertainty = np.concatenate([np.asarray(query(part)[1], np.float32) for part in parts])
    if parts and color is not None:
        colors = np.concatenate([_as_uint8(np.asarray(color(part))) for part in parts])
    # Not processed: trimesh would merge and reorder vertices, away from their attributes
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    mesh.vertex_attributes["uncertainty"] = uncertainty
    return mesh


def _as_uint8(colors: np.ndarray) -> UInt8[np.ndarray, "M 3"]:
    if colors.dtype == np.uint8:
        return colors
    return np.rint(255.0 * np.clip(np.nan_to_num(colors), 0.0, 1.0)).astype(np.uint8)


def _keep_vertices(mesh: trimesh.Trimesh, keep: Bool[np.ndarray, "V"]) -> trimesh.Trimesh:
    faces = np.asarray(mesh.faces)
    faces = (np.cumsum(keep) - 1)[faces[keep[faces].all(axis=1)]] if len(faces) else faces
    kept = trimesh.Trimesh(
        np.asarray(mesh.vertices)[keep], faces, vertex_colors=vertex_colors(mesh)[keep], process=False
    )
    for name, values in mesh.vertex_attributes.items():
        kept.vertex_attributes[name] = np.asarray(values)[keep]
    return kept
