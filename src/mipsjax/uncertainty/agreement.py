"""Whether depth images agree with each other at the poses found: no frame may look through what another measured.

A frame is tracked against a map that bends with its errors, so that its residual stays small where a run goes wrong.
Two depth images do not bend. Where one measured a surface, another that looks along the same line and measures
something well behind it contradicts it: at least one of the poses, or the depth itself, is wrong. The reverse is
natural: something in front hides the surface.

Distances are compared by tiles of small images. The median of a tile is free of most of the sensor's noise, and of
stray pixels; what remains is compared with the sensor's model. What others look through both before and after was
there for a moment only: it moves, and does not count. Metres.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from mipsjax.core.camera import Intrinsics, rays

LIMIT = 0.03
"""Share of tiles that may be looked through, in the median of neighbouring pairs: less than one of a whole image. Right
runs stay at 0.00, on real and rendered sequences; wrong ones reach 0.04 to 0.6."""
DEVIATIONS = 1.5
"""By which a tile must lie in front: of one pixel of the one image and one of the other. It is the systematic part
that counts, since a median over a tile has a few times less noise."""
DRIFT = 0.005
"""Metres for each metre of path between two frames, a drift that is usual: a long way round that does not close to the
millimetre is not wrong."""
TILE = 7
"""Pixels, side: six columns of tiles in a thumbnail."""
FEWEST_PIXELS = 8
"""Of a tile's, that must be comparable: 3 deviations of their median are then 1.3 of a pixel."""
FEWEST_TILES = 12
"""Of a pair, that must be comparable, of both views together: of fewer, one alone would be much."""
WINDOW = 8
"""Pairs, one after the other, whose median is taken: what passes through the view within them is no contradiction."""
SHORTEST = 2
"""Views between the frames of the nearest pairs; the next are twice as far apart, and so on."""
MOST_VIEWS = 400
"""Spread evenly over a long run, so that the time this takes is bounded: about 1 s on one core."""
CHUNK = 32
"""Pairs at a time, which bounds the memory."""
APART = 1.0
"""Radians between two directions of view, or as many times the usual depth between two places, or their sum: what is
farther apart hardly sees the same."""
GRAZING = 4.0
"""Relative change of depth, for a step of one focal length in the image, above which a surface is left out: depth then
changes by more than its noise from one pixel to the next. For a surface in the middle of the image this is the tangent
of the angle between line of sight and normal."""
FARTHER = 1.5
"""Times the distance from which it was measured, from which a surface may be looked at: from farther away it is too
small in the image."""
BEND = 3.0
"""Deviations of the noise by which three pixels in a row may be off a plane: at an edge of depth they are, and a pixel
there may be a mixture of both sides."""


class Noise(NamedTuple):
    """Standard deviation of one measurement: `floor + growth * z ** 2`, metres."""

    floor: float
    growth: float

    def __call__(self, z: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
        return self.floor + self.growth * z**2


class Views(NamedTuple):
    """Depth images with their poses, in the order of time."""

    depth: Float[np.ndarray, "N h w"]
    """z-depth, metres, 0 for none."""
    T_world_cam: Float64[np.ndarray, "N 4 4"]
    camera: Intrinsics
    """Of these small images."""


class Pairs(NamedTuple):
    """Views that are compared, in the order of the later one within each level."""

    level: Int[np.ndarray, " P"]
    """The views are at least `SHORTEST * 2 ** level` apart in time, and less than twice that."""
    earlier: Int[np.ndarray, " P"]
    later: Int[np.ndarray, " P"]


class Tiles(NamedTuple):
    """Of one view of each pair, its tiles against the other view."""

    through: Bool[np.ndarray, "P K"]
    """The other looks through them."""
    compared: Bool[np.ndarray, "P K"]


class Part(NamedTuple):
    """A piece of the path, by neighbouring pairs of one level."""

    share: float
    """Of tiles that are looked through, the median of the pairs."""
    first: int
    """Place of the earliest view of these pairs."""
    last: int
    """Place of the latest."""


class Agreement(NamedTuple):
    """What the comparison of all pairs says."""

    worst: Part
    """Where most is looked through."""
    begins: Part | None
    """The part over the limit that ends first, by when something must have gone wrong; None where all are below it."""
    pairs: int
    """That had enough in common."""


def agreement(views: Views, noise: Noise) -> Agreement | None:
    """Compares pairs of views near in place, and near and far in time; None where too few have enough in common."""
    pairs, share = looked_through(views, noise)
    found = parts(pairs, share)
    if not found:
        return None
    # A fault shows from when it happened on: the part that ends first is the earliest sign of it
    over = [part for part in found if part.share > LIMIT]
    begins = min(over, key=lambda part: (part.last, -part.first), default=None)
    return Agreement(max(found, key=lambda part: part.share), begins, int(np.isfinite(share).sum()))


def pairs_of(T_world_cam: Float64[np.ndarray, "N 4 4"], reach: Float64[np.ndarray, " N"]) -> Pairs:
    """For each view and each level, the view before it that is nearest in pose. `reach` is the usual depth, metres."""
    place, forward = T_world_cam[:, :3, 3], T_world_cam[:, :3, 2]
    found = []
    level, gap = 0, SHORTEST
    while gap < len(place):
        for later in range(gap, len(place)):
            span = slice(max(0, later - 2 * gap + 1), later - gap + 1)
            turn = np.arccos(np.clip(forward[span] @ forward[later], -1, 1))
            apart = turn + np.linalg.norm(place[span] - place[later], axis=1) / reach[later]
            nearest = int(np.argmin(apart))
            if apart[nearest] < APART:
                found.append((level, span.start + nearest, later))
        level, gap = level + 1, 2 * gap
    return Pairs(*np.array(found, int).reshape(-1, 3).T)


def looked_through(views: Views, noise: Noise) -> tuple[Pairs, Float64[np.ndarray, " P"]]:
    """Pairs, and of each the share of comparable tiles of either view that the other looks through; NaN where too few
    are comparable."""
    depth = views.depth.astype(np.float32)
    pairs = pairs_of(views.T_world_cam, _usual_depth(depth))
    smooth = surfaces(depth, views.camera, noise)
    place = views.T_world_cam[:, :3, 3]
    path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
    allowed = DRIFT * (path[pairs.later] - path[pairs.earlier])
    earlier = _tiles(views, smooth, noise, pairs.earlier, pairs.later, allowed)
    later = _tiles(views, smooth, noise, pairs.later, pairs.earlier, allowed)
    moment = _there_for_a_moment(len(depth), pairs, earlier, later)
    through, compared = np.zeros((2, len(allowed)), int)
    for tiles, number in ((earlier, pairs.earlier), (later, pairs.later)):
        # A tile that something moved through is left out of every pair that its view is in
        stays = ~moment[number]
        through += (tiles.through & stays).sum(1)
        compared += (tiles.compared & stays).sum(1)
    return pairs, np.where(compared >= FEWEST_TILES, through / np.maximum(compared, 1), np.nan)


def surfaces(
    depth: Float[np.ndarray, "N h w"], camera: Intrinsics, noise: Noise
) -> Bool[np.ndarray, "N h w"]:
    """Pixels on a smooth surface: with both neighbours in a row and in a column they lie on a plane, up to noise, that
    is not seen at a grazing angle."""
    out = np.zeros(depth.shape, bool)
    inside = np.ones((len(depth), depth.shape[1] - 2, depth.shape[2] - 2), bool)
    inverse = _inverse(depth)
    middle = inverse[:, 1:-1, 1:-1]
    # Inverse depth is linear over the image of a plane
    bend = BEND * np.sqrt(6) * noise(depth[:, 1:-1, 1:-1]) * middle**2
    rows = inverse[:, :-2, 1:-1], inverse[:, 2:, 1:-1], camera.fy
    columns = inverse[:, 1:-1, :-2], inverse[:, 1:-1, 2:], camera.fx
    for before, after, focal in (rows, columns):
        inside &= np.abs(before + after - 2 * middle) <= bend
        inside &= np.abs(after - before) * focal <= 2 * GRAZING * middle
    out[:, 1:-1, 1:-1] = inside
    return out


def parts(pairs: Pairs, share: Float64[np.ndarray, " P"]) -> list[Part]:
    """Medians of `WINDOW` neighbouring pairs of one level, in steps of half as many."""
    found = []
    for level in np.unique(pairs.level):
        of_level = np.flatnonzero((pairs.level == level) & np.isfinite(share))
        for start in range(0, len(of_level) - WINDOW + 1, WINDOW // 2):
            chosen = of_level[start : start + WINDOW]
            first, last = pairs.earlier[chosen].min(), pairs.later[chosen].max()
            found.append(Part(float(np.median(share[chosen])), int(first), int(last)))
    return found


def _there_for_a_moment(views: int, pairs: Pairs, earlier: Tiles, later: Tiles) -> Bool[np.ndarray, "N K"]:
    """Tiles of each view that some view before it looks through, and some view after it. Where a camera slides it is
    one or the other."""
    before, after = np.zeros((2, views, earlier.through.shape[1]), bool)
    np.logical_or.at(before, pairs.later, later.through)
    np.logical_or.at(after, pairs.earlier, earlier.through)
    return before & after


def _tiles(
    views: Views,
    smooth: Bool[np.ndarray, "N h w"],
    noise: Noise,
    of: Int[np.ndarray, " P"],
    other: Int[np.ndarray, " P"],
    allowed: Float64[np.ndarray, " P"],
) -> Tiles:
    """Tiles of `of` that `other` looks through by more than the noise and `allowed` metres."""
    rows, columns = (size // TILE for size in views.depth.shape[1:])
    tiles = Tiles(*np.zeros((2, len(of), rows * columns), bool))
    # Between two pixels that are each on a surface there is one, too: at an edge one of them would be off a plane
    on_surfaces = np.where(smooth, views.depth, 0)
    for start in range(0, len(of), CHUNK):
        here = slice(start, start + CHUNK)
        z_of, z, u, v = _seen_from(views, of[here], other[here])
        measured = _measured_at(on_surfaces[other[here]], u, v)
        with np.errstate(invalid="ignore"):
            comparable = smooth[of[here]] & (z < FARTHER * z_of) & np.isfinite(measured)
            limit = DEVIATIONS * np.hypot(noise(z_of), noise(measured)) + allowed[here, None, None]
            median, count = _tile_medians(np.where(comparable, (measured - z) / limit, np.nan))
            tiles.compared[here] = count >= FEWEST_PIXELS
            tiles.through[here] = tiles.compared[here] & (median > 1)
    return tiles


def _seen_from(
    views: Views, a: Int[np.ndarray, " C"], b: Int[np.ndarray, " C"]
) -> tuple[Float[np.ndarray, "C h w"], ...]:
    """Depth of all pixels of views `a`, from there and from views `b`; where they are in the images of `b` (u, v)."""
    camera, z_a = views.camera, views.depth[a].astype(np.float32)
    height, width = z_a.shape[1:]
    T_b_a = (np.linalg.inv(views.T_world_cam[b]) @ views.T_world_cam[a]).astype(np.float32)
    # In single precision, which is half of the memory, and several motions at once
    v_a, u_a = np.mgrid[:height, :width].astype(np.float32).reshape(2, -1)
    turned = rays(v_a, u_a, camera) @ T_b_a[:, :3, :3].transpose(0, 2, 1)
    p_b = turned.reshape(len(a), height, width, 3) * z_a[..., None]
    p_b += T_b_a[:, None, None, :3, 3]
    z = p_b[..., 2]
    # Not by `project`: what lies behind a camera must come out as nowhere, not as far outside of the image
    ahead = np.where(z > 0, z, np.nan)
    u = camera.fx * p_b[..., 0] / ahead + camera.cx
    v = camera.fy * p_b[..., 1] / ahead + camera.cy
    return z_a, z, u, v


def _measured_at(
    depth: Float[np.ndarray, "C h w"], u: Float[np.ndarray, "C h w"], v: Float[np.ndarray, "C h w"]
) -> Float[np.ndarray, "C h w"]:
    """Depth that images measured between pixels; NaN outside, and where one of the four around is 0."""
    height, width = depth.shape[1:]
    inside = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    left, top = (np.where(inside, at, 0).astype(int) for at in (u, v))
    share_u, share_v = u - left, v - top
    inverse = _inverse(depth).reshape(-1)
    corner = (np.arange(len(depth))[:, None, None] * height + top) * width + left
    # Inverse depth between four pixels, since that is what is linear over the image of a plane
    q00, q01, q10, q11 = (inverse[corner + step] for step in (0, 1, width, width + 1))
    above, below = q00 + share_u * (q01 - q00), q10 + share_u * (q11 - q10)
    return np.where(inside, 1 / (above + share_v * (below - above)), np.nan)


def _tile_medians(
    values: Float[np.ndarray, "C h w"],
) -> tuple[Float[np.ndarray, "C K"], Int[np.ndarray, "C K"]]:
    """Median of the finite values of each tile, and how many there are; rows and columns that make no whole tile are
    left out."""
    rows, columns = (size // TILE for size in values.shape[1:])
    cut = values[:, : rows * TILE, : columns * TILE]
    tiles = cut.reshape(len(values), rows, TILE, columns, TILE).transpose(0, 1, 3, 2, 4)
    # NaN sorts last, so that the finite values are the first `count`
    ordered = np.sort(tiles.reshape(len(values), rows * columns, TILE * TILE), axis=-1)
    count = np.isfinite(ordered).sum(-1)
    middle = np.maximum(count - 1, 0) // 2
    return np.take_along_axis(ordered, middle[..., None], -1)[..., 0], count


def _inverse(depth: Float[np.ndarray, "*S"]) -> Float[np.ndarray, "*S"]:
    """1 / depth, NaN for no measurement."""
    return 1 / np.where(depth > 0, depth, np.nan)


def _usual_depth(depth: Float[np.ndarray, "N h w"]) -> Float64[np.ndarray, " N"]:
    """Median of what each view measured, metres; 1 where that is nothing."""
    return np.array([np.median(image[image > 0]) if image.any() else 1.0 for image in depth])
