"""Where a submap has measured surface, and how well: its field means something only there."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

BITS = 20
"""Of a corner's coordinate along one axis: half a million cells either way."""
CORNERS = np.array(list(product((0, 1), repeat=3)))
"""Offsets from a cell's coordinates to its eight corners."""


class Observed(NamedTuple):
    """A regular grid of cells, of which some hold measured surface; what is known of them is kept at their corners."""

    cell_m: float
    """Edge of a cell."""
    corners: Int64[np.ndarray, " C"]
    """Packed coordinates, ascending; those that touch no measured cell are left out."""
    trust: Float32[np.ndarray, " C"]
    """0..1, the mean of the eight cells around each; one without measured surface has 0."""
    lo: Float[np.ndarray, "3"]
    """Metres, where the outermost corners' values have fallen to 0."""
    hi: Float[np.ndarray, "3"]


def observe(points: Float[np.ndarray, "N 3"], trust: Float[np.ndarray, " N"], cell_m: float) -> Observed:
    """From measured points and how far each is trusted (0..1): a cell counts as its best point."""
    # Best first, since `np.unique` gives the first of each cell
    best = np.argsort(-trust, kind="stable")
    cells = np.floor(points[best] / cell_m).astype(np.int64)
    _, first = np.unique(_packed(cells), return_index=True)
    touched = (cells[first][:, None] + CORNERS[None]).reshape(-1, 3)
    corners, place = np.unique(_packed(touched), return_inverse=True)
    total = np.bincount(place.ravel(), np.repeat(trust[best][first], len(CORNERS)), len(corners))
    lo, hi = (touched.min(0) - 1, touched.max(0) + 1) if len(touched) else np.zeros((2, 3))
    # By all eight cells, measured or not: so trust falls towards the end of what was measured
    mean = (total / len(CORNERS)).astype(np.float32)
    return Observed(cell_m, corners, mean, cell_m * lo, cell_m * hi)


def trust_at(observed: Observed, points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
    """Trust at each point, 0..1, trilinear between the corners.

    So it is continuous, and fades where measurements end: half of what it was at the border, 0 one cell beyond. A wall
    that lies on a border of cells, in both layers, has up to twice what it has inside one layer.
    """
    out = np.zeros(len(points), np.float32)
    near = np.flatnonzero(((points > observed.lo) & (points < observed.hi)).all(1))
    if not len(near):
        return out
    scaled = points[near] / observed.cell_m
    cells = np.floor(scaled).astype(np.int64)
    share = (scaled - cells).astype(np.float32)
    for corner in CORNERS:
        key = _packed(cells + corner)
        # A key behind the last one gets the last place, where the comparison below fails
        place = np.minimum(np.searchsorted(observed.corners, key), len(observed.corners) - 1)
        weight = np.where(corner, share, 1 - share).prod(1)
        out[near] += np.where(observed.corners[place] == key, weight * observed.trust[place], 0)
    return out


def _packed(coordinates: Int64[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    # Made positive, so that no sign reaches into the bits of the next axis
    x, y, z = (coordinates + (1 << (BITS - 1))).T
    return (x << (2 * BITS)) | (y << BITS) | z
