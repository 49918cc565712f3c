"""From a field to a coloured mesh: evaluated only near observed surface, meshed tile by tile, written as PLY.

The field is a callable, so the same code meshes a network, several blended submaps or an analytic scene.
Lattice vertices are whole multiples of the voxel size in the world frame. Every vertex is evaluated once and
tiles share the values on their common faces, hence the tiles meet without a seam.

Memory: 6 bytes a lattice vertex within the margin (17 million for 1000 square metres at 2 cm), one batch
of queries and one dense tile at a time, and the mesh.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float32, Int, UInt8, UInt16
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from skimage.measure import marching_cubes

from mipsjax.files import write_atomically
from mipsjax.mesh.render import vertex_colors

log = logging.getLogger(__name__)

TILE = 32
"""Cells along a tile: 36,000 vertices are large enough for marching cubes to be efficient, small enough to be
sparse."""
QUERY_POINTS = 1 << 18
"""Vertices are gathered from several tiles up to about this number, so that the field works on full
chunks."""
BITS = 20
"""Bits a lattice coordinate is packed into, so that three and an axis fit one integer: 10 km each way at 2
cm."""
LATTICE_LIMIT = 1 << (BITS - 1)
"""Lattice coordinates are less than this."""
NUDGE = 1e-3
"""Voxels. Signed distances are kept this far from zero, so that no mesh vertex coincides with a lattice
vertex."""
ON_LATTICE = 1e-4
"""Voxels. Between the rounding of float32 coordinates (4e-6) and the least distance from a lattice vertex
that the nudge leaves (2.5e-4 where the other end of the edge has the clip value)."""
CLIP = 4.0
"""Voxels. No true distance is larger in a cell that the surface crosses; clipping bounds the ratio above."""
MIN_COMPONENT_M2 = 0.01
"""A detached piece of surface smaller than a hand (10 cm x 10 cm) is noise."""
DOUBLE_FROM_M = 1000.0
"""Coordinates of the world beyond this are written in double precision."""
MARGIN_M = 0.06
"""Surface is sought this far from observed points: twice the noise of a depth camera plus the drift of a
submap."""

Query = Callable[[Float32[np.ndarray, "M 3"]], tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]]
"""World points in metres to signed distance in metres (positive in free space) and entropy."""
Color = Callable[[Float32[np.ndarray, "M 3"]], np.ndarray]
"""World points in metres to RGB [M 3], uint8 or floats from 0 to 1."""

_Tile = tuple[int, int, int]
_CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])


class _Samples(NamedTuple):
    """Field values at the lattice vertices that a tile owns and that lie near observed surface."""

    vertex: UInt16[np.ndarray, "M"]
    """Position in the tile, x slowest."""
    tsdf: Float32[np.ndarray, "M"]
    """Signed distance in voxels; NaN where it is not to be used."""


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
    store = _evaluate(query, _voxelised(observed_points, voxel_m), voxel_m, margin_m / voxel_m, limits[1])
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


def export_ply(path: Path, mesh: trimesh.Trimesh) -> None:
    """Writes a binary PLY: float positions, uint8 colours, float `uncertainty` where the mesh has it.

    Positions beyond DOUBLE_FROM_M are double, which single precision would round to visible steps. The same
    mesh gives the same bytes. The file appears whole or not at all; an empty mesh gives a valid file.

    Raises:
        OutputError: the file cannot be written.
    """
    vertices = np.asarray(mesh.vertices)
    far = len(vertices) > 0 and bool(np.abs(vertices).max() > DOUBLE_FROM_M)
    vertex = np.zeros(len(vertices), _vertex_type("uncertainty" in mesh.vertex_attributes, far))
    vertex["x"], vertex["y"], vertex["z"] = vertices.T
    vertex["red"], vertex["green"], vertex["blue"] = vertex_colors(mesh).T
    if "uncertainty" in mesh.vertex_attributes:
        vertex["uncertainty"] = mesh.vertex_attributes["uncertainty"]
    face = np.zeros(len(mesh.faces), [("count", "u1"), ("vertex_indices", "<i4", (3,))])
    face["count"], face["vertex_indices"] = 3, mesh.faces
    write_atomically(Path(path), _ply_header(vertex, face) + vertex.tobytes() + face.tobytes())


def _voxelised(points: Float[np.ndarray, "N 3"], voxel_m: float) -> Int[np.ndarray, "M 3"]:
    """Distinct lattice vertices nearest to the finite points, in the order of tiles."""
    finite = np.asarray(points)[np.isfinite(points).all(axis=1)].astype(np.float64)
    nearest = np.rint(finite / voxel_m)
    # Less a tile: vertices and cells around the points need coordinates, too
    if len(nearest) and np.abs(nearest).max() >= LATTICE_LIMIT - TILE:
        raise ValueError(
            f"observed points reach {np.abs(finite).max():g} m: too far for a voxel of {voxel_m:g} m"
        )
    return _unpack(np.unique(_pack(nearest.astype(np.int64))))


def _pack(lattice: Int[np.ndarray, "M 3"]) -> Int[np.ndarray, "M"]:
    """One integer for three lattice coordinates."""
    x, y, z = (lattice + LATTICE_LIMIT).T
    return (x << 2 * BITS) | (y << BITS) | z


def _unpack(packed: Int[np.ndarray, "M"]) -> Int[np.ndarray, "M 3"]:
    low = (1 << BITS) - 1
    return np.stack([packed >> 2 * BITS, (packed >> BITS) & low, packed & low], axis=1) - LATTICE_LIMIT


def _evaluate(
    query: Query, occupied: Int[np.ndarray, "M 3"], voxel_m: float, margin: float, max_entropy: float
) -> dict[_Tile, _Samples]:
    """Field values at all lattice vertices within the margin (in voxels), by tile."""
    store: dict[_Tile, _Samples] = {}
    for batch in _batches(_active_vertices(occupied, margin)):
        lattice = np.concatenate([_lattice_of(tile, vertex) for tile, vertex in batch])
        tsdf, entropy = query((lattice * voxel_m).astype(np.float32))
        values = _usable_values(np.asarray(tsdf) / voxel_m, np.asarray(entropy), max_entropy)
        ends = np.cumsum([len(vertex) for _, vertex in batch])
        for (tile, vertex), part in zip(batch, np.split(values, ends[:-1]), strict=True):
            store[tile] = _Samples(vertex, part)
    return store


def _usable_values(
    tsdf: Float[np.ndarray, "M"], entropy: Float[np.ndarray, "M"], max_entropy: float
) -> Float32[np.ndarray, "M"]:
    """Distances in voxels, kept away from zero, and NaN where they or the entropy cannot be trusted."""
    away = np.where(tsdf < 0, np.minimum(tsdf, -NUDGE), np.maximum(tsdf, NUDGE))
    trusted = np.isfinite(tsdf) & (entropy <= max_entropy)
    return np.where(trusted, away, np.nan).astype(np.float32)


def _active_vertices(
    occupied: Int[np.ndarray, "M 3"], margin: float
) -> Iterator[tuple[_Tile, UInt16[np.ndarray, "K"]]]:
    """Tiles with the vertices they own within the margin of an occupied one, in a fixed order."""
    halo = int(np.ceil(margin))
    by_tile = _grouped(occupied)
    for tile in _tiles_within(occupied, halo):
        near = _neighbourhood(by_tile, tile, halo)
        if near.any():
            # The nearest occupied vertex may be a neighbouring tile's, hence the halo
            distance = np.asarray(distance_transform_edt(~near))
            own = (slice(halo, halo + TILE),) * 3
            vertex = np.flatnonzero(distance[own] <= margin).astype(np.uint16)
            if len(vertex):
                yield tile, vertex


def _tiles_within(occupied: Int[np.ndarray, "M 3"], halo: int) -> list[_Tile]:
    """Tiles that reach into the cube of half side `halo` around an occupied vertex, in ascending order."""
    # steps of at most a tile, so that no tile inside the cube is stepped over
    steps = np.unique(np.rint(np.linspace(-halo, halo, -(-2 * halo // TILE) + 1)).astype(np.int64))
    shifts = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    found = [np.unique(_pack((occupied + shift) // TILE)) for shift in shifts]
    return [(x, y, z) for x, y, z in _unpack(np.unique(np.concatenate(found))).tolist()]


def _grouped(occupied: Int[np.ndarray, "M 3"]) -> dict[_Tile, Int[np.ndarray, "K 3"]]:
    """Occupied lattice vertices by tile."""
    tile = _pack(occupied // TILE)
    order = np.argsort(tile, kind="stable")
    tiles, first = np.unique(tile[order], return_index=True)
    groups = np.split(occupied[order], first[1:])
    return {(x, y, z): group for (x, y, z), group in zip(_unpack(tiles).tolist(), groups, strict=False)}


def _neighbourhood(
    by_tile: dict[_Tile, Int[np.ndarray, "K 3"]], tile: _Tile, halo: int
) -> Bool[np.ndarray, "S S S"]:
    """Occupancy of a tile and of `halo` vertices around it."""
    size, reach = TILE + 2 * halo, -(-halo // TILE)
    near = np.zeros((size, size, size), bool)
    for offset in np.ndindex((2 * reach + 1,) * 3):
        x, y, z = (int(t + o - reach) for t, o in zip(tile, offset, strict=True))
        if (x, y, z) in by_tile:
            local = by_tile[x, y, z] - np.array(tile) * TILE + halo
            local = local[((local >= 0) & (local < size)).all(axis=1)]
            near[tuple(local.T)] = True
    return near


def _batches(
    tiles: Iterator[tuple[_Tile, UInt16[np.ndarray, "K"]]],
) -> Iterator[list[tuple[_Tile, UInt16[np.ndarray, "K"]]]]:
    """Runs of tiles with about QUERY_POINTS vertices together."""
    batch, total = [], 0
    for tile, vertex in tiles:
        batch.append((tile, vertex))
        total += len(vertex)
        if total >= QUERY_POINTS:
            yield batch
            batch, total = [], 0
    if batch:
        yield batch


def _lattice_of(tile: _Tile, vertex: UInt16[np.ndarray, "K"]) -> Int[np.ndarray, "K 3"]:
    return np.stack(np.unravel_index(vertex, (TILE,) * 3), axis=1) + np.array(tile) * TILE


def _meshed_tiles(store: dict[_Tile, _Samples]) -> set[_Tile]:
    """Tiles that own a cell with values: those with samples and their lower neighbours."""
    return {(x - int(i), y - int(j), z - int(k)) for x, y, z in store for i, j, k in _CORNERS}


def _mesh_tile(store: dict[_Tile, _Samples], tile: _Tile, band: float) -> _Piece | None:
    """Marching cubes over the cells of one tile; None where the surface does not cross it."""
    volume = _volume(store, tile)
    known = np.isfinite(volume)
    corners = [
        tuple(slice(o, o + TILE) for o in corner) for corner in _CORNERS
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
    lattice = position.astype(np.float64) + np.array(tile) * TILE
    return _Piece(_edge_keys(position, tile), lattice, faces.astype(np.int64))


def _volume(store: dict[_Tile, _Samples], tile: _Tile) -> Float32[np.ndarray, "S S S"]:
    """Values of a tile and of the first vertices of its upper neighbours; NaN where there are none."""
    volume = np.full((TILE + 1,) * 3, np.nan, np.float32)
    for corner in _CORNERS:
        x, y, z = (int(t + o) for t, o in zip(tile, corner, strict=True))
        if (x, y, z) in store:
            samples = store[x, y, z]
            local = np.stack(np.unravel_index(samples.vertex, (TILE,) * 3), axis=1) + corner * TILE
            inside = (local <= TILE).all(axis=1)
            volume[tuple(local[inside].T)] = samples.tsdf[inside]
    return volume


def _edge_keys(position: Float32[np.ndarray, "V 3"], tile: _Tile) -> Int[np.ndarray, "V"]:
    """The lattice edge of every mesh vertex, as one integer, equal in all tiles that share the edge.

    A vertex lies on an edge, off the lattice in one coordinate, or, in a few ambiguous cases of marching
    cubes, alone in the middle of its cell. Positions cannot serve: their last bits depend on the tile.
    """
    off = np.abs(position - np.rint(position))
    axis = np.where((off > ON_LATTICE).sum(axis=1) > 1, 3, np.argmax(off, axis=1))
    along = (axis[:, None] == np.arange(3)) | (axis[:, None] == 3)
    base = np.where(along, np.floor(position), np.rint(position)).astype(np.int64)
    base += np.array(tile) * TILE
    return _pack(base) * 4 + axis


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
    parts = [vertices[i : i + QUERY_POINTS] for i in range(0, len(vertices), QUERY_POINTS)]
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


def _vertex_type(with_uncertainty: bool, far: bool) -> np.dtype:
    position = "<f8" if far else "<f4"
    fields = [(name, position) for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    return np.dtype(fields + ([("uncertainty", "<f4")] if with_uncertainty else []))


def _ply_header(vertex: np.ndarray, face: np.ndarray) -> bytes:
    names = {np.dtype("<f4"): "float", np.dtype("<f8"): "double", np.dtype("u1"): "uchar"}
    fields = vertex.dtype.fields or {}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    lines += [f"property {names[kind[0]]} {name}" for name, kind in fields.items()]
    lines += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode("ascii")
