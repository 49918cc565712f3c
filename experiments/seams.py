"""Steps in a mesh where submaps meet, beside steps of the same size of cell where they do not.

A mesh is off by a little everywhere, most where things are small or were far away, so that two parts of it are off by
different amounts whether a border runs between them or not. A seam is what a border adds to that. Two submaps that do
not fit show it all along their border: so the median step of each border is given too.

Only flat cells count: walls, floors, table tops, where a step would show. There the signed error of both sides is that
of one plane; elsewhere each side may hold another part of a chair.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from mipsjax.data.synth.scene import Scene

CELL = 0.25  # metres
FEWEST = 20  # vertices on a side
LEAST_BORDER = 5  # cells of a border whose median says something
FLAT_M = 0.005  # the scene's surface in a flat cell is a plane up to this
FLAT_NORMAL = 0.98  # least length of the mean of its normals
CHUNK = 20_000


class Errors(NamedTuple):
    """Of points against an analytic scene."""

    signed: Float[np.ndarray, " N"]
    """Metres, positive in free space."""
    normal: Float[np.ndarray, "N 3"]
    """Of the nearest surface."""


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
    steps: dict[str, list[float]] = {"seam": [], "control": []}
    borders: dict[tuple[int, ...], list[float]] = {}
    foot = vertices - off.signed[:, None] * off.normal
    for members in _cells(vertices):
        if len(members) < 2 * FEWEST or not _flat(foot[members], off.normal[members]):
            continue
        places, counts = np.unique(submap[members], return_counts=True)
        two = places[np.argsort(counts, kind="stable")[-2:]]
        sides = [members[submap[members] == place] for place in two]
        if len(places) == 1 and places[0] >= 0:
            along = vertices[members] @ rng.standard_normal(3)
            order = members[np.argsort(along)]
            place = int(rng.integers(FEWEST, len(members) - FEWEST + 1))
            steps["control"].append(_step(order[:place], order[place:], off))
        elif two.min() >= 0 and min(map(len, sides)) >= FEWEST:
            steps["seam"].append(_step(*sides, off))
            borders.setdefault(tuple(sorted(two.tolist())), []).append(steps["seam"][-1])
    medians = [float(np.median(sizes)) for sizes in borders.values() if len(sizes) >= LEAST_BORDER]
    return {
        "borders": len(medians),
        "worst_border_median_cm": max(medians, default=float("nan")),
    } | {
        f"{name}_{key}": value
        for name, sizes in steps.items()
        if sizes
        for key, value in {
            "cells": len(sizes),
            "median_cm": float(np.median(sizes)),
            "95_cm": float(np.quantile(sizes, 0.95)),
            "max_cm": max(sizes),
            "over_1_cm": float(np.mean(np.greater(sizes, 1))),
        }.items()
    }


def _step(one: Int[np.ndarray, " A"], other: Int[np.ndarray, " B"], off: Errors) -> float:
    """Centimetres between the median errors of two sets of vertices."""
    return 100 * abs(float(np.median(off.signed[one]) - np.median(off.signed[other])))


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
