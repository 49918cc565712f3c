"""Steps in a mesh where submaps meet, beside steps of the same size of cell where they do not.

A mesh is off by a little everywhere, most where things are small or were far away, so that two parts of it are off by
different amounts whether a border runs between them or not. A seam is what a border adds to that.

Only flat cells count: walls, floors, table tops, where a step would show. There the signed error of both sides is that
of one plane; elsewhere each side may hold another part of a chair.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from mipsjax.data.synth.scene import Scene

CELL = 0.25  # metres
FEWEST = 20  # vertices on a side
FLAT_M = 0.005  # the scene's surface in a flat cell is a plane up to this
FLAT_NORMAL = 0.98  # least length of the mean of its normals
CHUNK = 20_000


class Errors(NamedTuple):
    """Of points against an analytic scene."""

    signed: Float[np.ndarray, " N"]
    """Metres, positive in free space."""
    normal: Float[np.ndarray, "N 3"]
    """Of the nearest surface."""


def errors(scene: Scene, points: Float[np.ndarray, "N 3"]) -> Errors:
    """Distances of points to the scene, and which way they lie."""

    @jax.jit
    def both(p):
        return scene.distance(p), jax.grad(lambda p: scene.distance(p).sum())(p)

    count = len(points)
    padded = np.zeros((-(-count // CHUNK) * CHUNK, 3), np.float32)
    padded[:count] = points
    parts = [jax.device_get(both(jnp.asarray(part))) for part in padded.reshape(-1, CHUNK, 3)]
    distance, normal = (np.concatenate(column)[:count] for column in zip(*parts, strict=True))
    return Errors(distance, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9))


def seams(vertices: Float[np.ndarray, "N 3"], submap: Int[np.ndarray, " N"], off: Errors) -> dict[str, Any]:
    """A row: steps in centimetres in flat cells that a border crosses, and in others, cut by a random plane.

    `vertices` are in the scene's frame; `submap` is the one that leads at each, -1 for none.
    """
    rng = np.random.default_rng(0)
    steps: dict[str, list[float]] = {"seam": [], "control": []}
    foot = vertices - off.signed[:, None] * off.normal
    for members in _cells(vertices):
        if len(members) < 2 * FEWEST or not _flat(foot[members], off.normal[members]):
            continue
        places, counts = np.unique(submap[members], return_counts=True)
        places = places[(counts >= FEWEST) & (places >= 0)]
        if len(places) > 1:
            sides = [members[submap[members] == place] for place in places]
        elif len(places) == 1:
            along = vertices[members] @ rng.standard_normal(3)
            cut = np.quantile(along, rng.uniform(0.3, 0.7))
            sides = [members[along < cut], members[along >= cut]]
        else:
            continue
        medians = [np.median(off.signed[side]) for side in sides]
        steps["seam" if len(places) > 1 else "control"].append(100 * float(max(medians) - min(medians)))
    return {
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
