"""Which shapes a view, or a part of a scene, needs: the rest of a large scene is left out, exactly.

Sight passes from one carved box into the next through what they share. Seen from above, the directions that
reach a box are an interval, narrowed at every passage; a solid outside those intervals cannot be seen.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64, Int

from mipsjax.core.camera import Intrinsics
from mipsjax.data.synth.scene import Scene, Shapes

SHADING_REACH = 0.6
"""Metres from a visible point within which shapes may shade it: twice the reach of ambient shading, and some."""
# Carved boxes, boxes and cylinders of a reduced scene, or these numbers doubled as often as needed: few
# shapes of arrays, because each is compiled anew. A scene that holds no more stays as it is.
_SIZES = (8, 64, 32)


class _Plan(NamedTuple):
    """Rectangles on the floor, around shapes."""

    low: Float64[np.ndarray, "K 2"]
    high: Float64[np.ndarray, "K 2"]

    def grown(self, by: float) -> _Plan:
        return _Plan(self.low - by, self.high + by)

    def within(self, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> _Plan:
        """The part of each inside one rectangle; empty ones have low > high."""
        return _Plan(np.maximum(self.low, low), np.minimum(self.high, high))

    def corners(self) -> Float64[np.ndarray, "K 4 2"]:
        (x0, z0), (x1, z1) = self.low.T, self.high.T
        return np.stack([np.stack(p, axis=-1) for p in ((x0, z0), (x1, z0), (x1, z1), (x0, z1))], axis=1)

    def filled(self) -> Bool[np.ndarray, "K"]:
        return np.all(self.low <= self.high, axis=1)


def is_large(scene: Scene) -> bool:
    """Whether leaving shapes out can pay."""
    return any(count > size for count, size in zip(_counts(scene), _SIZES, strict=True))


def in_view(scene: Scene, intrinsics: Intrinsics, T_world_cam: Float64[np.ndarray, "4 4"]) -> Scene:
    """The scene without shapes that a view neither shows nor needs for shading; small scenes unchanged.

    The camera must stand in free space and no ray may be vertical. Images are those of the whole scene to
    rounding: a ray that grazes an edge may take a different number of steps.
    """
    if not is_large(scene):
        return scene
    position, forward = T_world_cam[[0, 2], 3], T_world_cam[[0, 2], 2]
    forward = forward / np.linalg.norm(forward)
    # Coordinates in the plan: to the right of the view's heading, and along it
    axes = np.stack([[forward[1], -forward[0]], forward], axis=1)
    interval = _spread(intrinsics, T_world_cam[:3, :3][[0, 2]].T @ axes)
    carved, boxes, cylinders = (_plan(shapes) for shapes in (scene.carved, scene.boxes, scene.cylinders))
    reached = _reached(carved, position, axes, interval)
    chosen = [
        _any_seen(solids.grown(SHADING_REACH), carved, reached, position, axes)
        for solids in (boxes, cylinders)
    ]
    return _reduced(scene, np.isin(np.arange(len(carved.low)), list(reached)), *chosen)


def nearby(scene: Scene, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]) -> Scene:
    """The scene without shapes farther than `SHADING_REACH` from a rectangle of places (x, z).

    Distances there are exact up to that reach and at least that beyond, while a carved box is near.
    """
    plans = (_plan(shapes) for shapes in (scene.carved, scene.boxes, scene.cylinders))
    return _reduced(scene, *(plan.grown(SHADING_REACH).within(low, high).filled() for plan in plans))


def _counts(scene: Scene) -> tuple[int, int, int]:
    carved, boxes, cylinders = (
        len(shapes.rounding) for shapes in (scene.carved, scene.boxes, scene.cylinders)
    )
    return carved, boxes, cylinders


def _plan(shapes: Shapes) -> _Plan:
    center, half, turn = (np.asarray(a, np.float64) for a in (shapes.center, shapes.half, shapes.turn))
    c, s = np.abs(turn).T
    reach = np.stack([c * half[:, 0] + s * half[:, 2], s * half[:, 0] + c * half[:, 2]], axis=1)
    return _Plan(center[:, [0, 2]] - reach, center[:, [0, 2]] + reach)


def _spread(intrinsics: Intrinsics, plan_of_cam: Float64[np.ndarray, "3 2"]) -> tuple[float, float]:
    """Least and greatest slope, right over ahead, of the rays through the image's corners."""
    fx, fy, cx, cy, width, height = intrinsics
    u, v = np.array([-0.5, width - 0.5] * 2), np.repeat([-0.5, height - 0.5], 2)
    right, ahead = (np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(4)], axis=1) @ plan_of_cam).T
    return float(np.min(right / ahead)), float(np.max(right / ahead))


def _reached(
    carved: _Plan,
    position: Float64[np.ndarray, "2"],
    axes: Float64[np.ndarray, "2 2"],
    interval: tuple[float, float],
) -> dict[int, tuple[float, float]]:
    """The slopes under which each carved box can be seen into, of those that can."""
    grown = carved.grown(SHADING_REACH)
    inside = np.all((carved.low <= position) & (position <= carved.high), axis=1)
    reached = {int(box): interval for box in np.flatnonzero(inside)}
    waiting = list(reached)
    while waiting:
        box = waiting.pop()
        shared = grown.within(carved.low[box], carved.high[box])
        # By a hair, so that boxes with a face in common touch whatever was rounded
        touching = carved.grown(1e-6).within(carved.low[box], carved.high[box]).filled()
        for other in np.flatnonzero(touching):
            passed = _passed(_Plan(shared.low[other], shared.high[other]), position, axes, reached[box])
            before = reached.get(int(other))
            after = passed if passed is None or before is None else _hull(before, passed)
            if after is not None and after != before:
                reached[int(other)] = after
                waiting.append(int(other))
    return reached


def _hull(a: tuple[float, float], b: tuple[float, float]) -> tuple[float, float]:
    return min(a[0], b[0]), max(a[1], b[1])


def _passed(
    opening: _Plan,
    position: Float64[np.ndarray, "2"],
    axes: Float64[np.ndarray, "2 2"],
    interval: tuple[float, float],
) -> tuple[float, float] | None:
    """The slopes of an interval that meet an opening; None if none does."""
    if np.all((opening.low <= position) & (position <= opening.high)):
        return interval
    corners = (_Plan(opening.low[None], opening.high[None]).corners()[0] - position) @ axes
    for sign, slope in ((1.0, interval[0]), (-1.0, interval[1])):
        corners = _clipped(corners, sign * (corners[:, 0] - slope * corners[:, 1]))
    if len(corners) == 0:
        return None
    slopes = corners[:, 0] / np.maximum(corners[:, 1], 1e-9)
    return max(interval[0], float(slopes.min())), min(interval[1], float(slopes.max()))


def _clipped(
    corners: Float64[np.ndarray, "N 2"], height: Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "M 2"]:
    """The part of a convex polygon where a linear function, known at the corners, is at least 0."""
    kept = []
    for here, there, a, b in zip(
        corners, np.roll(corners, -1, axis=0), height, np.roll(height, -1), strict=True
    ):
        if a >= 0.0:
            kept.append(here)
        if (a >= 0.0) != (b >= 0.0):
            kept.append(here + a / (a - b) * (there - here))
    return np.array(kept).reshape(-1, 2)


def _any_seen(
    solids: _Plan,
    carved: _Plan,
    reached: dict[int, tuple[float, float]],
    position: Float64[np.ndarray, "2"],
    axes: Float64[np.ndarray, "2 2"],
) -> Bool[np.ndarray, "K"]:
    """Which solids lie, in part, in a carved box within its slopes."""
    seen = np.zeros(len(solids.low), bool)
    for box, (least, most) in reached.items():
        part = solids.within(carved.low[box], carved.high[box])
        right, ahead = np.moveaxis((part.corners() - position) @ axes, -1, 0)
        crossing = np.any(right >= least * ahead, axis=1) & np.any(right <= most * ahead, axis=1)
        seen |= part.filled() & crossing
    return seen


def _reduced(scene: Scene, *chosen: Bool[np.ndarray, "K"]) -> Scene:
    """The chosen carved boxes, boxes and cylinders, filled up to one of a few sizes."""
    needed = max(int(np.sum(rows)) / size for rows, size in zip(chosen, _SIZES, strict=True))
    doublings = max(0, int(np.ceil(np.log2(max(needed, 1.0)))))
    parts = [
        _rows(shapes, _filled_up(flags, size << doublings))
        for shapes, flags, size in zip(
            (scene.carved, scene.boxes, scene.cylinders), chosen, _SIZES, strict=True
        )
    ]
    return scene._replace(carved=parts[0], boxes=parts[1], cylinders=parts[2])


def _rows(shapes: Shapes, picked: Int[np.ndarray, "S"]) -> Shapes:
    return jax.tree.map(lambda column: jnp.asarray(np.asarray(column)[picked]), shapes)


def _filled_up(chosen: Bool[np.ndarray, "K"], size: int) -> Int[np.ndarray, "S"]:
    """Numbers of the chosen shapes, some twice: a shape that is there already changes nothing."""
    if len(chosen) == 0:
        return np.zeros(0, np.intp)
    rows = np.flatnonzero(chosen)
    return np.resize(rows if len(rows) else np.zeros(1, np.intp), size)
