"""Image features with depth, and which stored keyframes look like a frame.

For loops with large drift and for relocalisation, where the map's own distance field says nothing (paper, "Loop
detection and closure"). SIFT (Lowe 2004) compared as RootSIFT (Arandjelovic and Zisserman 2012): on 320 x 240
images it holds a wider change of view than ORB on doubled images, at three times the time.

Descriptors are whole numbers small enough for float32 products to be exact, so that no order of summation and no
number of threads changes a bit of any result.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from mipsjax.core.camera import Intrinsics, unproject

MAX_FEATURES = 600
"""Kept of one frame: 76 bytes each, 51 kB at most with the coarse depth."""
MAX_DETECTED = 1000
"""Looked for in the image; more than kept, since depth is missing at some."""
CONTRAST = 0.01
"""Least contrast of a SIFT extremum: a quarter of the usual, since small indoor images have little of it."""
WORKING_WIDTH = 640
"""Wider images are reduced to this first: time and memory grow with the pixels, matches hardly do."""
UNIT = 48
"""Length of a descriptor in its stored unit: of RootSIFT's components one in ten thousand is then over `LARGEST`."""
LARGEST = 2**4 - 1
"""Of a stored component, in half a byte."""

DEPTH_RADIUS_PX = 1
"""Half width of the square of depths around a keypoint."""
DEPTH_SHARE = 0.5
"""Of the square must be measured."""
DEPTH_SPREAD = 0.05
"""Most a square's depths differ, relative: a surface at 75 degrees stays below, an edge of an object does not."""
COARSE_WIDTH = 40
"""Columns of the coarse depth, about: enough to tell a wall from free space."""

VOTED = 64
"""Features of a keyframe that take part in `similar`: the largest, which change least between views."""
VOTING = 128
"""Features of the current frame that take part."""
BACKGROUND = 10
"""Rank of the keyframe whose distance counts as chance: a feature votes only for those clearly nearer."""


class Features(NamedTuple):
    """At most `MAX_FEATURES` features of one frame, the largest first."""

    descriptors: UInt8[np.ndarray, "N 64"]
    """RootSIFT, of length `UNIT` up to rounding, two components in a byte."""
    p_cam: Float32[np.ndarray, "N 3"]
    """Metres, camera frame."""
    depth: Float32[np.ndarray, "h w"]
    """Depth decimated to about `COARSE_WIDTH` columns, metres, 0 for no measurement: to check a pose with."""


def detect(
    color: UInt8[np.ndarray, "H W 3"], depth: Float32[np.ndarray, "H W"], camera: Intrinsics
) -> Features:
    """Features where the depth around the keypoint is measured and belongs to one surface.

    `color` is RGB, `depth` metres with 0 (or anything not finite) for no measurement. None of them found is no
    error.

    Raises:
        ValueError: the images do not have the size of the camera.
    """
    size = (camera.height, camera.width)
    if color.shape != (*size, 3) or depth.shape != size:
        raise ValueError(f"images of {size} expected, got colour {color.shape} and depth {depth.shape}")
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
    every = coarse_stride(camera)
    coarse = depth[::every, ::every].copy()
    pixel, strength, extent, raw = _keypoints(color)
    surface, z = surface_depth(depth, pixel)
    found = np.flatnonzero(surface)
    # Stable sorts: equal keys keep their order, so that two machines keep the same features
    found = found[np.argsort(-strength[found], kind="stable")[:MAX_FEATURES]]
    found = found[np.argsort(-extent[found], kind="stable")]
    pixel, z = pixel[found], z[found]
    p_cam = unproject(pixel[:, 1], pixel[:, 0], z, camera)
    return Features(_root(raw[found]), p_cam.astype(np.float32), coarse)


def coarse_stride(camera: Intrinsics) -> int:
    """Depth is decimated by this for `Features.depth`."""
    return max(1, round(camera.width / COARSE_WIDTH))


def packed(components: UInt8[np.ndarray, "N 128"]) -> UInt8[np.ndarray, "N 64"]:
    """Two components, of at most `LARGEST`, in a byte."""
    return components[:, ::2] << 4 | components[:, 1::2]


def unpacked(descriptors: UInt8[np.ndarray, "N 64"]) -> UInt8[np.ndarray, "N 128"]:
    """The components of packed descriptors."""
    return np.stack([descriptors >> 4, descriptors & LARGEST], axis=2).reshape(len(descriptors), -1)


def squared_distances(
    a: UInt8[np.ndarray, "N 64"], b: UInt8[np.ndarray, "M 64"]
) -> Float32[np.ndarray, "N M"]:
    """Of all pairs of descriptors, in units of `UNIT` squared: 0 for equal, 2 for unrelated ones.

    Products and sums stay below 2^24, hence exact in float32.
    """
    a32, b32 = unpacked(a).astype(np.float32), unpacked(b).astype(np.float32)
    lengths = np.sum(a32 * a32, axis=1)[:, None] + np.sum(b32 * b32, axis=1)[None]
    return (lengths - 2 * (a32 @ b32.T)) / np.float32(UNIT**2)


def similar(current: Features, database: Sequence[Features], top: int) -> list[int]:
    """Places in `database` of the at most `top` keyframes that look most like the current frame, best first.

    Each of the largest features of the frame votes by how much nearer a keyframe's nearest feature is than that of
    the keyframe at rank `BACKGROUND`. Keyframes without features are never named. Time grows with the database.
    """
    usable = [place for place, other in enumerate(database) if len(other.descriptors)]
    if not usable or top < 1 or not len(current.descriptors):
        return []
    stored = [database[place].descriptors[:VOTED] for place in usable]
    starts = np.cumsum([0, *(len(d) for d in stored[:-1])])
    squared = squared_distances(current.descriptors[:VOTING], np.concatenate(stored))
    nearest = np.sqrt(np.minimum.reduceat(squared, starts, axis=1))
    rank = min(BACKGROUND, len(usable) - 1)
    chance = np.partition(nearest, rank, axis=1)[:, rank, None]
    # What is no nearer than chance says nothing, not something against a keyframe
    votes = np.maximum(chance - nearest, 0).sum(axis=0)
    return [usable[place] for place in np.argsort(-votes, kind="stable")[:top]]


def _keypoints(
    color: UInt8[np.ndarray, "H W 3"],
) -> tuple[
    Float32[np.ndarray, "K 2"],
    Float32[np.ndarray, "K"],
    Float32[np.ndarray, "K"],
    Float32[np.ndarray, "K 128"],
]:
    """Pixel, strength, extent in pixels and SIFT descriptor of each keypoint."""
    grey = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    height, width = grey.shape
    if width > WORKING_WIDTH:
        size = (WORKING_WIDTH, max(1, round(height * WORKING_WIDTH / width)))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(nfeatures=MAX_DETECTED, contrastThreshold=CONTRAST)
    points, raw = sift.detectAndCompute(grey, None)  # type: ignore[call-overload]
    # None where there are none; a NumPy array otherwise
    descriptors = np.zeros((0, 128), np.float32) if raw is None else np.asarray(raw, np.float32)
    where = np.array([p.pt for p in points], np.float32).reshape(-1, 2)
    enlarge = np.array([width / grey.shape[1], height / grey.shape[0]], np.float32)
    strength, extent = np.array([(p.response, p.size) for p in points], np.float32).reshape(-1, 2).T
    # Pixel centres are whole numbers: sizes are scaled about the corner of the image, half a pixel off
    return (where + 0.5) * enlarge - 0.5, strength, extent, descriptors


def surface_depth(
    depth: Float32[np.ndarray, "H W"], pixel: Float32[np.ndarray, "K 2"]
) -> tuple[Bool[np.ndarray, "K"], Float32[np.ndarray, "K"]]:
    """Whether the depths around each pixel belong to one surface, and their median."""
    square = _squares(depth, np.rint(pixel).astype(int))
    measured = square > 0
    count = measured.sum(axis=1)
    ordered = np.sort(np.where(measured, square, np.inf), axis=1)
    rows = np.arange(len(pixel))
    middle = ordered[rows, np.maximum(count - 1, 0) // 2]
    middle = np.where(count > 0, middle, 0)
    nearest = np.where(count > 0, ordered[:, 0], 0)
    one_surface = square.max(axis=1) - nearest <= DEPTH_SPREAD * middle
    return (count >= DEPTH_SHARE * square.shape[1]) & one_surface, middle.astype(np.float32)


def _squares(depth: Float32[np.ndarray, "H W"], at: Int[np.ndarray, "K 2"]) -> Float32[np.ndarray, "K S"]:
    """Depths of the square around each pixel; 0 outside of the image."""
    r = DEPTH_RADIUS_PX
    padded = np.pad(depth, r)
    dv, du = np.mgrid[: 2 * r + 1, : 2 * r + 1].reshape(2, -1)
    u, v = np.clip(at, 0, np.array(depth.shape[::-1]) - 1).T
    return padded[v[:, None] + dv[None], u[:, None] + du[None]]


def _root(raw: Float32[np.ndarray, "N 128"]) -> UInt8[np.ndarray, "N 64"]:
    """RootSIFT: square roots of the components as shares of their sum, so that Euclidean distance is Hellinger's."""
    # Of a square without any gradient the sum is 0
    share = raw / np.maximum(raw.sum(axis=1, keepdims=True), 1)
    return packed(np.minimum(np.rint(UNIT * np.sqrt(share)), LARGEST).astype(np.uint8))
