"""Corners of an image: where it changes in every direction, on a measured surface, away from edges of depth.

Where surfaces leave a direction free, as along a plain wall, the edge of a lamp or of a picture still holds the camera.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from mipsjax.core.camera import Intrinsics, unproject
from mipsjax.images.features import surface_depth

QUALITY = 0.001
"""Least strength of a corner, relative to the strongest one of its image."""
SPACING_PX = 5
"""Least distance of two corners."""
WINDOW_PX = 15
"""Side of the square around a corner that is compared."""
DEPTH_WIDTH = 160
"""Pixels, about, of the depth by which an image is drawn from elsewhere: it is kept of every keyframe."""
MEDIAN_PX = 3
"""Side of the square of that depth of which the median is taken, so that it has no noise; OpenCV knows 3 and 5."""
EDGE_PX = 12
"""Pixels around a corner in which no edge of depth may be: half of `WINDOW_PX`, and what a moving camera blurs."""
EDGE = 0.1
"""Relative change of inverse depth that is an edge of it."""
DISTINCT = 2.0
"""Times the squared gradients that noise makes, by which those around a corner are more than noise makes: with less it
may be noise that looks like a corner, and is found anywhere."""
SMOOTHEST = 10
"""Per cent of the image, its smoothest part, by which that noise is measured."""
EVERY_PX = 8
"""Pixels between the places at which that is looked for."""
LEAST_NOISE, MOST_NOISE = 1.0, 400.0
"""Squared gradients, of OpenCV's Sobel filter, that rounding makes, and white noise of 6 grey levels: what is smoothest
in an image that is textured all over is none of noise."""


class Corners(NamedTuple):
    """What can be followed from one frame: at most `count` corners on measured surfaces."""

    record: int
    """Id of the record of the frame."""
    grey: UInt8[np.ndarray, "H W"]
    depth: Float32[np.ndarray, "h w"]
    """Metres, decimated, without holes and with less noise."""
    pixel: Float32[np.ndarray, "N 2"]
    p_cam: Float32[np.ndarray, "N 3"]
    """Metres, in the frame's own camera."""
    axes: Float32[np.ndarray, "N 2 2"]
    """Rows: the direction across which the image around a corner changes most, of length 1, and the other one, the
    shorter the less it changes along it. What is followed along an edge slides on it."""


def grey_of(color: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
    """Brightness of an RGB image."""
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.uint8)


def corners(
    grey: UInt8[np.ndarray, "H W"],
    depth: Float32[np.ndarray, "H W"],
    record: int,
    count: int,
    camera: Intrinsics,
) -> Corners:
    """The strongest corners of a frame, where the depth around them is measured and belongs to one surface."""
    found = cv2.goodFeaturesToTrack(grey, count, QUALITY, SPACING_PX) if count else None
    pixel = np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)
    surface, z = surface_depth(depth, pixel)
    pixel, z = pixel[surface], z[surface]
    axes, distinct = _axes(grey, pixel)
    every = stride(camera)
    small = _filled(depth[::every, ::every])
    wanted = distinct & ~_beside_an_edge(small, pixel, every)
    pixel, z, axes = pixel[wanted], z[wanted], axes[wanted]
    p_cam = unproject(pixel[:, 1], pixel[:, 0], z, camera).astype(np.float32)
    return Corners(record, grey, small, pixel, p_cam, axes)


def decimated(camera: Intrinsics) -> Intrinsics:
    """That of `Corners.depth`."""
    return camera.decimated(stride(camera))


def stride(camera: Intrinsics) -> int:
    """Depth is decimated by this for `Corners.depth`."""
    return max(1, round(camera.width / DEPTH_WIDTH))


def _filled(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """The depth of the nearest measured pixel where there is none; medians, so that it is steady."""
    measured = depth > 0
    if not measured.any():
        return np.ones(depth.shape, np.float32)  # there are no corners either
    holes = (~measured).astype(np.uint8)
    _, nearest = cv2.distanceTransformWithLabels(
        holes, cv2.DIST_L2, cv2.DIST_MASK_3, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(nearest, int)
    depth_of = np.zeros(nearest.max() + 1, np.float32)
    # Labels are of measured pixels: each hole takes the depth of the label that it got
    depth_of[nearest[measured]] = depth[measured]
    return np.asarray(cv2.medianBlur(depth_of[nearest], MEDIAN_PX), np.float32)


def _beside_an_edge(
    depth: Float32[np.ndarray, "h w"], pixel: Float32[np.ndarray, "N 2"], every: int
) -> Bool[np.ndarray, "N"]:
    """Whether there is an edge of depth near a pixel: in the square around it the nearest surface is not as much nearer
    as the farthest one is farther, by inverse depth, which is linear over the image of a plane.

    What is seen there is of both sides, and moves with neither: the surface in front covers and uncovers the other, and
    a moving camera blurs it over that. Who turns into a room and walks there sees corners on what lies behind move too
    little, each time.
    """
    reach = round(EDGE_PX / every)
    inverse, square = 1 / depth, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    nearest, farthest = cv2.dilate(inverse, square), cv2.erode(inverse, square)
    bent = np.abs(nearest + farthest - 2 * inverse) > EDGE * inverse
    u, v = np.clip(np.rint(pixel / every).astype(int), 0, np.array(depth.shape[::-1]) - 1).T
    return np.asarray(bent[v, u])


def _axes(
    grey: UInt8[np.ndarray, "H W"], pixel: Float32[np.ndarray, "N 2"]
) -> tuple[Float32[np.ndarray, "N 2 2"], Bool[np.ndarray, "N"]]:
    """Of the structure tensor of the window around each corner, less what noise makes of it, divided by its larger
    eigenvalue: its root. And whether the corner is more than noise.

    Pictures of one place differ by more than noise, by perspective and by light, and the more where they change more:
    what that moves a corner by is in proportion to the larger gradient over that along which it moves.
    """
    u, v = np.clip(np.rint(pixel).astype(int), 0, np.array(grey.shape[::-1]) - 1).T
    x, y = cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    xx, xy, yy = (cv2.boxFilter(part, -1, (WINDOW_PX, WINDOW_PX))[v, u] for part in (x * x, x * y, y * y))
    # The structure tensor [[xx, xy], [xy, yy]] of each window
    tensor = np.stack([np.stack([xx, xy], 1), np.stack([xy, yy], 1)], 1)
    by_noise = _of_noise(x, y)
    strength, directions = np.linalg.eigh(tensor)
    strength = np.maximum(strength - by_noise, 0)
    largest = np.maximum(strength[:, 1:], np.finfo(np.float32).tiny)
    length = np.sqrt(strength / largest)
    # Rows, the direction of the larger eigenvalue first
    axes = (length[..., None] * directions.swapaxes(1, 2))[:, ::-1]
    return axes.astype(np.float32), strength[:, 1] > DISTINCT * by_noise


def _of_noise(x: Float32[np.ndarray, "H W"], y: Float32[np.ndarray, "H W"]) -> float:
    """The squared gradient along one axis where the image is smoothest: whatever made its noise, and smoothed it. Parts
    without any, as where it is too dark or too bright, say nothing."""
    squared = cv2.boxFilter((x * x + y * y) / 2, -1, (WINDOW_PX, WINDOW_PX))[::EVERY_PX, ::EVERY_PX]
    squared = squared[squared > 0]
    if not squared.size:
        return LEAST_NOISE
    return float(np.clip(np.percentile(squared, SMOOTHEST), LEAST_NOISE, MOST_NOISE))
