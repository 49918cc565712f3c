"""Where a submap has measured surface, and from how near: its field means something only there."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

BITS = 20
"""Of a cell's coordinate along one axis: 50 km either way."""


class Observed(NamedTuple):
    """Cells with measured surface in them or in a neighbour."""

    cell_m: float
    """Edge of a cell; together with its neighbours it reaches this far at least."""
    cells: Int64[np.ndarray, " C"]
    """Packed coordinates, ascending."""
    range_m: Float32[np.ndarray, " C"]
    """Nearest range from which it was measured."""


def observe(points: Float[np.ndarray, "N 3"], range_m: Float[np.ndarray, " N"], cell_m: float) -> Observed:
    """From measured points and the ranges they were measured from, metres."""
    near = np.argsort(range_m, kind="stable")
    cells = np.floor(points[near] / cell_m).astype(np.int64)
    _, first = np.unique(_packed(cells), return_index=True)
    cells, range_m = cells[first], range_m[near][first]
    around = np.array(list(product((-1, 0, 1), repeat=3)))
    packed = _packed((cells[:, None] + around[None]).reshape(-1, 3))
    ranges = np.repeat(range_m, len(around))
    near = np.argsort(ranges, kind="stable")
    keys, first = np.unique(packed[near], return_index=True)
    return Observed(cell_m, keys, ranges[near][first].astype(np.float32))


def range_at(observed: Observed, points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
    """Metres; infinite where nothing was measured."""
    out = np.full(len(points), np.inf, np.float32)
    if len(observed.cells):
        key = _packed(np.floor(points / observed.cell_m).astype(np.int64))
        place = np.minimum(np.searchsorted(observed.cells, key), len(observed.cells) - 1)
        found = observed.cells[place] == key
        out[found] = observed.range_m[place[found]]
    return out


def _packed(cells: Int64[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    x, y, z = (cells + (1 << (BITS - 1))).T
    return (x << (2 * BITS)) | (y << BITS) | z
