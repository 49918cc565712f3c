"""Steps in a mesh where submaps meet, beside steps of the same size of cell where they do not.

A mesh is off by a little everywhere, most where things are small or were far away, so that two parts of it are off by
different amounts whether a border runs between them or not. A seam is what a border adds to that. Two submaps that do
not fit show it all along their border, or at least along a piece of it: so there are also medians of the sizes of steps
of whole borders and of pieces, beside those of pieces without a border, and the offset of each border, which is the
median with the sign of the steps in all that faces one way.

Only flat cells count: walls, floors, table tops, where a step would show. There the signed error of both sides is that
of one plane; elsewhere each side may hold another part of a chair.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from mipsjax.data.synth.scene import Scene

CELL = 0.25  # metres
FEWEST = 20  # vertices on a side
PIECE = 1.0  # metres
LEAST_CELLS = 3  # of a border or a piece whose median says something; a straight border has four in a piece
FLAT_M = 0.005  # the scene's surface in a flat cell is a plane up to this
FLAT_NORMAL = 0.98  # least length of the mean of its normals
CHUNK = 20_000


class Errors(NamedTuple):
    """Of points against an analytic scene."""

    signed: Float[np.ndarray, " N"]
    """Metres, positive in free space."""
    normal: Float[np.ndarray, "N 3"]
    """Of the nearest surface."""


class Step(NamedTuple):
    """In one cell."""

    between: tuple[int, ...]
    """The submaps on either side; one where there is no border."""
    facing: tuple[int, bool]
    """Axis along which the surface's normal lies most, and whether against it: where a submap is shifted, opposite
    walls have steps of opposite sign."""
    piece: tuple[int, ...]
    """Which cube of `PIECE` it is in."""
    cm: float
    """Error of the second less that of the first."""


@jax.jit
def _distance_and_gradient(scene: Scene, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    return scene.distance(points), jax.grad(lambda p: scene.distance(p).sum())(points)


def errors(scene: Scene, points: Float[np.ndarray, "N 3"]) -> Errors:
    """Distances of points to the scene, and which way they lie."""
    count = len(points)
    padded = np.zeros((max(1, -(-count // CHUNK)) * CHUNK, 3), np.float32)
    padded[:count] = points
    parts = [jax.device_get(_distance_and_gradient(scene, part)) for part in padded.reshape(-1, CHUNK, 3)]
    distance, normal = (np.concatenate(column)[:count] for column in zip(*parts, strict=True))
    return Errors(distance, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9))


def seams(vertices: Float[np.ndarray, "N 3"], submap: Int[np.ndarray, " N"], off: Errors) -> dict[str, Any]:
    """A row: steps in centimetres in flat cells that a border crosses, and in others, cut by a random plane.

    `vertices` are in the scene's frame; `submap` is the one that leads at each, -1 for none.
    """
    rng = np.random.default_rng(0)
    steps: dict[str, list[Step]] = {"seam": [], "control": []}
    foot = vertices - off.signed[:, None] * off.normal
    for members in _cells(vertices):
        if len(members) < 2 * FEWEST or not _flat(foot[members], off.normal[members]):
            continue
        normal = off.normal[members].mean(0)
        axis = int(np.argmax(np.abs(normal)))
        facing = axis, bool(normal[axis] < 0)
        piece = tuple((foot[members].mean(0) // PIECE).astype(int).tolist())
        places, counts = np.unique(submap[members], return_counts=True)
        two = np.sort(places[np.argsort(counts, kind="stable")[-2:]])
        sides = [members[submap[members] == place] for place in two]
        between = tuple(two.tolist())
        if len(places) == 1 and places[0] >= 0:
            along = vertices[members] @ rng.standard_normal(3)
            order = members[np.argsort(along)]
            place = int(rng.integers(FEWEST, len(members) - FEWEST + 1))
            steps["control"].append(Step(between, facing, piece, _step(order[:place], order[place:], off)))
        elif two.min() >= 0 and min(map(len, sides)) >= FEWEST:
            steps["seam"].append(Step(between, facing, piece, _step(*sides, off)))
    borders = _grouped(steps["seam"], lambda step: step.between)
    offsets = [abs(_median(w)) for w in _grouped(steps["seam"], lambda step: (step.between, step.facing))]
    row: dict[str, Any] = {
        "borders": len(borders),
        "worst_border_median_cm": max((_median(np.abs(b)) for b in borders), default=np.nan),
        "facings": len(offsets),
        "worst_offset_cm": max(offsets, default=np.nan),
        "offsets_over_1_cm": int(np.sum(np.greater(offsets, 1))),
    }
    for name, found in steps.items():
        if found:
            row |= {f"{name}_{key}": value for key, value in _summary(found).items()}
    return row


def _summary(steps: list[Step]) -> dict[str, float]:
    sizes = np.abs([step.cm for step in steps])
    pieces = _grouped(steps, lambda step: (step.between, step.piece))
    medians = [_median(np.abs(piece)) for piece in pieces]
    return {
        "cells": len(sizes),
        "median_cm": _median(sizes),
        "95_cm": float(np.quantile(sizes, 0.95)),
        "max_cm": float(sizes.max()),
        "over_1_cm": float(np.mean(sizes > 1)),
        "pieces": len(pieces),
        "cells_in_pieces": sum(map(len, pieces)),
        "worst_piece_cm": max(medians, default=np.nan),
        "pieces_over_1_cm": int(np.sum(np.greater(medians, 1))),
    }


def _grouped(steps: list[Step], by: Callable[[Step], Any]) -> list[list[float]]:
    """Steps of those groups that have enough of them."""
    groups = defaultdict(list)
    for step in steps:
        groups[by(step)].append(step.cm)
    return [group for group in groups.values() if len(group) >= LEAST_CELLS]


def _median(values: ArrayLike) -> float:
    return float(np.median(values))


def _step(one: Int[np.ndarray, " A"], other: Int[np.ndarray, " B"], off: Errors) -> float:
    """Centimetres by which the median error of the second set of vertices is above that of the first."""
    return 100 * (_median(off.signed[other]) - _median(off.signed[one]))


def _cells(vertices: Float[np.ndarray, "N 3"]) -> list[Int[np.ndarray, " M"]]:
    """Places of the vertices of each cell."""
    cell = np.unique(np.floor(vertices / CELL).astype(int), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(cell, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(cell[order])) + 1)


def _flat(foot: Float[np.ndarray, "M 3"], normal: Float[np.ndarray, "M 3"]) -> bool:
    mean = normal.mean(0)
    length = float(np.linalg.norm(mean))
    off = (foot - foot.mean(0)) @ mean
    return length > FLAT_NORMAL and float(np.abs(off).max()) < FLAT_M * length
