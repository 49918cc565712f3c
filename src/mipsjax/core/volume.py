"""The box that a submap governs: what a keyframe sees, growth and containment.

Plain NumPy in double precision: it runs on the host, a few times a frame, with some hundred points. Boxes and
points are in a submap's frame, metres; a box is closed, so that a point on a face is inside.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from mipsjax.config.submaps import VolumeConfig
from mipsjax.core.camera import Intrinsics, rays

ROWS, COLUMNS = 12, 16
"""Pixels of an image whose rays stand for it: a step of about 4 degrees for a common depth camera."""
DEPTHS = 8
"""Points on a ray: about 60 cm apart up to 5 m, a tenth of the largest box."""


class Box(NamedTuple):
    """An axis-aligned box in a submap's frame (Omega of the paper)."""

    lo: Float64[np.ndarray, "3"]
    """Metres."""
    hi: Float64[np.ndarray, "3"]


class Seen(NamedTuple):
    """Points that stand for what a frame sees; as many for every frame of one camera and config."""

    p_cam: Float64[np.ndarray, "M 3"]
    mask: Bool[np.ndarray, " M"]


def seen(depth: Float[np.ndarray, "h w"], camera: Intrinsics, cfg: VolumeConfig) -> Seen:
    """What a frame sees, by one of three definitions (`cfg.governs`). Camera frame, metres.

    An even grid of pixels from edge to edge, and on the ray of each:

    - `frustum`: even depths up to `far`, whatever was measured there (Section 3.4 of the paper);
    - `depth`: even depths up to the measured one, or to `far` where that is nearer;
    - `surface`: the measured point, where it is nearer than `far`; its row of depths collapses to one.

    Pixels without a measurement are masked, except by `frustum`. Depths are even, not volumes: what is near, and
    seen in most detail, counts as much as what is far.
    """
    v, u = (grid.ravel() for grid in np.meshgrid(*_grid(camera), indexing="ij"))
    measured = depth[v, u].astype(np.float64)
    valid = np.isfinite(measured) & (measured > 0)
    measured = np.where(valid, measured, 0.0)
    even = np.arange(1, DEPTHS + 1) / DEPTHS
    if cfg.governs == "frustum":
        reach, valid = np.full_like(measured, cfg.far), np.ones_like(valid)
    elif cfg.governs == "depth":
        reach = np.minimum(measured, cfg.far)
    else:
        reach, valid, even = measured, valid & (measured < cfg.far), np.ones(1)
    depths = reach[:, None] * even
    p_cam = rays(v, u, camera)[:, None] * depths[..., None]
    return Seen(p_cam.reshape(-1, 3), np.repeat(valid, len(even)))


def grow(
    box: Box | None, points: Float64[np.ndarray, "M 3"], mask: Bool[np.ndarray, " M"], cfg: VolumeConfig
) -> Box:
    """The least expansion that encloses the points and a margin, within `max_side` (Section 3.4 of the paper).

    A side that would become longer grows to exactly `max_side`, towards where it is needed; where both ends are,
    each gets its share of what is left. A first box (None) grows in this way from the place nearest to the
    submap's origin, where the anchor camera stands. Without points a box stays as it is, and a first one is
    that origin. Points that are not finite count as masked.
    """
    points = _usable(points, mask)
    if len(points) == 0:
        return Box(np.zeros(3), np.zeros(3)) if box is None else box
    needed = Box(points.min(0) - cfg.margin, points.max(0) + cfg.margin)
    if box is None:
        nearest = np.clip(np.zeros(3), *needed)
        box = Box(nearest, nearest)
    # How far each face would have to move outwards
    below, above = np.maximum(box.lo - needed.lo, 0), np.maximum(needed.hi - box.hi, 0)
    wanted, free = below + above, np.maximum(cfg.max_side - (box.hi - box.lo), 0)
    fits = wanted <= free
    # Both ends of a side that would become too long get the same share of what they want
    share = free / np.where(fits, 1, wanted)
    # Where all of it fits, the bounds are taken over exactly: the points on them are inside, not just outside
    lo = np.where(fits, np.minimum(box.lo, needed.lo), box.lo - share * below)
    hi = np.where(fits, np.maximum(box.hi, needed.hi), box.hi + share * above)
    return Box(lo, hi)


def inside(box: Box, points: Float64[np.ndarray, "M 3"]) -> Bool[np.ndarray, " M"]:
    """Which points are in the box; faces belong to it, NaN is outside."""
    return np.all((points >= box.lo) & (points <= box.hi), axis=-1)


def contained(box: Box, points: Float64[np.ndarray, "M 3"], mask: Bool[np.ndarray, " M"]) -> float:
    """Share of the points in the box, 0..1. Points that are not finite count as masked.

    1 where no point is left: a frame that sees nothing is no reason for a new submap.
    """
    points = _usable(points, mask)
    return float(inside(box, points).mean()) if len(points) else 1.0


def _grid(camera: Intrinsics) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of an even grid with the image's edges in it."""
    return tuple(  # pyright: ignore[reportReturnType]  (of two elements)
        np.rint(np.linspace(0, size - 1, count)).astype(int)
        for size, count in ((camera.height, ROWS), (camera.width, COLUMNS))
    )


def _usable(points: Float64[np.ndarray, "M 3"], mask: Bool[np.ndarray, " M"]) -> Float64[np.ndarray, "K 3"]:
    return points[mask & np.isfinite(points).all(-1)]
