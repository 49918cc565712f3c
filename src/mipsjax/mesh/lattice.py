"""The lattice on which a field is asked near observed surface, in tiles.

Lattice vertices are whole multiples of the voxel size in the world frame. Every vertex is owned by one tile and
evaluated once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt16
from scipy.ndimage import distance_transform_edt

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

Query = Callable[[Float32[np.ndarray, "M 3"]], tuple[Float[np.ndarray, "M"], Float[np.ndarray, "M"]]]
"""World points in metres to signed distance in metres (positive in free space) and entropy."""
Tile = tuple[int, int, int]
"""Place of a tile, in tiles."""


class Samples(NamedTuple):
    """Field values at the lattice vertices that a tile owns and that lie near observed surface."""

    vertex: UInt16[np.ndarray, "M"]
    """Position in the tile, x slowest."""
    tsdf: Float32[np.ndarray, "M"]
    """Signed distance in voxels; NaN where it is not to be used."""


def evaluate(
    query: Query, occupied: Int[np.ndarray, "M 3"], voxel_m: float, margin: float, max_entropy: float
) -> dict[Tile, Samples]:
    """Field values at all lattice vertices within the margin (in voxels), by tile."""
    store: dict[Tile, Samples] = {}
    for batch in _batches(_active_vertices(occupied, margin)):
        lattice = np.concatenate([_lattice_of(tile, vertex) for tile, vertex in batch])
        tsdf, entropy = query((lattice * voxel_m).astype(np.float32))
        values = _usable_values(np.asarray(tsdf) / voxel_m, np.asarray(entropy), max_entropy)
        ends = np.cumsum([len(vertex) for _, vertex in batch])
        for (tile, vertex), part in zip(batch, np.split(values, ends[:-1]), strict=True):
            store[tile] = Samples(vertex, part)
    return store


def voxelised(points: Float[np.ndarray, "N 3"], voxel_m: float) -> Int[np.ndarray, "M 3"]:
    """Distinct lattice vertices nearest to the finite points, in the order of tiles."""
    finite = np.asarray(points)[np.isfinite(points).all(axis=1)].astype(np.float64)
    nearest = np.rint(finite / voxel_m)
    # Less a tile: vertices and cells around the points need coordinates, too
    if len(nearest) and np.abs(nearest).max() >= LATTICE_LIMIT - TILE:
        raise ValueError(
            f"observed points reach {np.abs(finite).max():g} m: too far for a voxel of {voxel_m:g} m"
        )
    return unpack(np.unique(pack(nearest.astype(np.int64))))


def pack(lattice: Int[np.ndarray, "M 3"]) -> Int[np.ndarray, "M"]:
    """One integer for three lattice coordinates."""
    x, y, z = (lattice + LATTICE_LIMIT).T
    return (x << 2 * BITS) | (y << BITS) | z


def unpack(packed: Int[np.ndarray, "M"]) -> Int[np.ndarray, "M 3"]:
    low = (1 << BITS) - 1
    return np.stack([packed >> 2 * BITS, (packed >> BITS) & low, packed & low], axis=1) - LATTICE_LIMIT


def _usable_values(
    tsdf: Float[np.ndarray, "M"], entropy: Float[np.ndarray, "M"], max_entropy: float
) -> Float32[np.ndarray, "M"]:
    """Distances in voxels, kept away from zero, and NaN where they or the entropy cannot be trusted."""
    away = np.where(tsdf < 0, np.minimum(tsdf, -NUDGE), np.maximum(tsdf, NUDGE))
    trusted = np.isfinite(tsdf) & (entropy <= max_entropy)
    return np.where(trusted, away, np.nan).astype(np.float32)


def _active_vertices(
    occupied: Int[np.ndarray, "M 3"], margin: float
) -> Iterator[tuple[Tile, UInt16[np.ndarray, "K"]]]:
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


def _tiles_within(occupied: Int[np.ndarray, "M 3"], halo: int) -> list[Tile]:
    """Tiles that reach into the cube of half side `halo` around an occupied vertex, in ascending order."""
    # steps of at most a tile, so that no tile inside the cube is stepped over
    steps = np.unique(np.rint(np.linspace(-halo, halo, -(-2 * halo // TILE) + 1)).astype(np.int64))
    shifts = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    found = [np.unique(pack((occupied + shift) // TILE)) for shift in shifts]
    return [(x, y, z) for x, y, z in unpack(np.unique(np.concatenate(found))).tolist()]


def _grouped(occupied: Int[np.ndarray, "M 3"]) -> dict[Tile, Int[np.ndarray, "K 3"]]:
    """Occupied lattice vertices by tile."""
    tile = pack(occupied // TILE)
    order = np.argsort(tile, kind="stable")
    tiles, first = np.unique(tile[order], return_index=True)
    groups = np.split(occupied[order], first[1:])
    return {(x, y, z): group for (x, y, z), group in zip(unpack(tiles).tolist(), groups, strict=False)}


def _neighbourhood(
    by_tile: dict[Tile, Int[np.ndarray, "K 3"]], tile: Tile, halo: int
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
    tiles: Iterator[tuple[Tile, UInt16[np.ndarray, "K"]]],
) -> Iterator[list[tuple[Tile, UInt16[np.ndarray, "K"]]]]:
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


def _lattice_of(tile: Tile, vertex: UInt16[np.ndarray, "K"]) -> Int[np.ndarray, "K 3"]:
    return np.stack(np.unravel_index(vertex, (TILE,) * 3), axis=1) + np.array(tile) * TILE
