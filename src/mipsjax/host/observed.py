"""Where a submap has measured surface, and how well: its field means something only there."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

BITS = 20
"""Of a node's coordinate along one axis: 50 km either way."""
CORNERS = np.array(list(product((0, 1), repeat=3)))
"""Of a cell, in cells."""


class Observed(NamedTuple):
    """Corners of cells with measured surface in them; all others have trust 0."""

    cell_m: float
    """Edge of a cell."""
    nodes: Int64[np.ndarray, " C"]
    """Packed coordinates, ascending."""
    trust: Float32[np.ndarray, " C"]
    """0..1, the mean of the eight cells around a node."""


def observe(points: Float[np.ndarray, "N 3"], trust: Float[np.ndarray, " N"], cell_m: float) -> Observed:
    """From measured points and how far each is trusted (0..1): a cell counts as its best point."""
    best = np.argsort(-trust, kind="stable")
    cells = np.floor(points[best] / cell_m).astype(np.int64)
    _, first = np.unique(_packed(cells), return_index=True)
    corners = (cells[first][:, None] + CORNERS[None]).reshape(-1, 3)
    nodes, place = np.unique(_packed(corners), return_inverse=True)
    total = np.bincount(place, np.repeat(trust[best][first], len(CORNERS)), len(nodes))
    return Observed(cell_m, nodes, (total / len(CORNERS)).astype(np.float32))


def trust_at(observed: Observed, points: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
    """Trilinear between the nodes, thus continuous: 0 from one cell beyond the measured ones on."""
    out = np.zeros(len(points), np.float32)
    if not len(observed.nodes):
        return out
    scaled = points / observed.cell_m
    cells = np.floor(scaled).astype(np.int64)
    share = (scaled - cells).astype(np.float32)
    for corner in CORNERS:
        key = _packed(cells + corner)
        place = np.minimum(np.searchsorted(observed.nodes, key), len(observed.nodes) - 1)
        weight = np.where(corner, share, 1 - share).prod(1)
        out += np.where(observed.nodes[place] == key, weight * observed.trust[place], 0)
    return out


def _packed(coordinates: Int64[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    x, y, z = (coordinates + (1 << (BITS - 1))).T
    return (x << (2 * BITS)) | (y << BITS) | z
