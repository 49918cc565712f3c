"""Corners of a frame whose pose is known, followed into another image (Lucas and Kanade 1981, on a pyramid)."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int, UInt8

from mipsjax.core.camera import Intrinsics, project
from mipsjax.core.rigid import from_parts, transform
from mipsjax.images.corners import WINDOW_PX, Corners, stride

LEVELS = 3
"""Of the pyramid above the image: flow of some 50 pixels beside what the guess explains."""
RETURN_PX = 0.5
"""A corner that is followed there and back again and ends farther off than this is not believed."""
FIRST = 150
"""Corners, the strongest, by which a motion is looked for first; where they do not do, by all."""
ROUGHLY = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.03)
"""When following ends there: the second round does the rest."""
EXACTLY = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
"""When it ends in the second round, after so many steps or a step of so many pixels."""
TEXTURE = 1e-4
"""Least eigenvalue of a window's gradients, divided by its pixels, below which a corner is not followed."""
HYPOTHESES = 200
"""Of the motion by RANSAC: with half of the corners wrong, each set of four has a chance of 1 in 16."""
MOTION_PX = 1.5
"""Largest error of a corner that agrees with the motion."""
NEAREST_M = 0.1
"""Points nearer than this to the camera, or behind it, are not projected."""


class Followed(NamedTuple):
    """Corners of an earlier frame that were found in the current one."""

    p_ref: Float64[np.ndarray, "N 3"]
    """Metres, in the camera of the earlier frame."""
    pixel: Float64[np.ndarray, "N 2"]
    """In the current image."""
    axes: Float32[np.ndarray, "N 2 2"]
    """As in `Corners`."""
    T_ref_cam: Float64[np.ndarray, "4 4"]
    """The motion that they agree on."""


def follow(
    reference: Corners,
    grey: UInt8[np.ndarray, "H W"],
    T_ref_cam: Float64[np.ndarray, "4 4"],
    fewest: int,
    camera: Intrinsics,
    near: bool = False,
) -> Followed | None:
    """Corners of `reference` in the image `grey`, which was taken at about `T_ref_cam`.

    None where fewer than `fewest` are found there and back again and agree on one motion.

    They are followed twice: first as they are, from where they should be, then in the image as the camera of
    `reference` would have taken it, by its depth and by the motion that was found first. Seen from elsewhere the square
    around a corner is stretched, and what is nearer in it has moved farther: without the second round this makes
    motions too small, by 1 to 2 % of a turn into a room. Where `T_ref_cam` is known to a few pixels (`near`), that
    round is tried alone.
    """
    if len(reference.pixel) < fewest:
        return None
    found = _as_drawn(reference, grey, T_ref_cam, fewest, camera) if near else None
    if found is not None:
        return found
    first = _as_they_are(reference, grey, T_ref_cam, fewest, FIRST, camera)
    if first is None and len(reference.pixel) > FIRST:
        first = _as_they_are(reference, grey, T_ref_cam, fewest, len(reference.pixel), camera)
    return first and (_as_drawn(reference, grey, first.T_ref_cam, fewest, camera) or first)


def _as_drawn(
    reference: Corners,
    grey: UInt8[np.ndarray, "H W"],
    T_ref_cam: Float64[np.ndarray, "4 4"],
    fewest: int,
    camera: Intrinsics,
) -> Followed | None:
    """The second round, in the image drawn as the reference's camera would have taken it."""
    origin = _origin(reference.depth, np.linalg.inv(T_ref_cam), camera)
    drawn = _sampled(grey, *np.moveaxis(origin, -1, 0))
    there, back = _there_and_back(reference.grey, drawn, reference.pixel, reference.pixel, 0, EXACTLY)
    seen = _sampled(origin, *there.T[..., None])[:, 0]
    back &= _inside(seen, camera, WINDOW_PX // 2)  # the whole of its square
    # Beyond the last depth that is kept nothing is known of where a pixel lies
    back &= np.all(there <= stride(camera) * (np.array(reference.depth.shape[::-1]) - 1), axis=1)
    return _motion(reference, np.flatnonzero(back), seen[back], fewest, camera)


def _as_they_are(
    reference: Corners,
    grey: UInt8[np.ndarray, "H W"],
    T_ref_cam: Float64[np.ndarray, "4 4"],
    fewest: int,
    most: int,
    camera: Intrinsics,
) -> Followed | None:
    """The first round, on a pyramid of images, with at most so many corners."""
    guess, visible = _project(reference.p_cam, np.linalg.inv(T_ref_cam), camera)
    which = np.flatnonzero(visible)[:most]  # the strongest come first
    if len(which) < fewest:
        return None
    pixel, guess = reference.pixel[which], guess[which]
    there, back = _there_and_back(reference.grey, grey, pixel, guess, LEVELS, ROUGHLY)
    return _motion(reference, which[back], there[back], fewest, camera)


def _project(
    p_ref: Float32[np.ndarray, "N 3"], T_cam_ref: Float64[np.ndarray, "4 4"], camera: Intrinsics
) -> tuple[Float32[np.ndarray, "N 2"], Bool[np.ndarray, "N"]]:
    """Pixels of points of another camera, and which of them lie in the image."""
    p_cam = transform(T_cam_ref, p_ref)
    pixel = project(p_cam, camera, NEAREST_M)
    return pixel.astype(np.float32), _inside(pixel, camera) & (p_cam[:, 2] > NEAREST_M)


def _sampled(image: np.ndarray, u: Float32[np.ndarray, "*N"], v: Float32[np.ndarray, "*N"]) -> np.ndarray:
    """An image between its pixels, and outside of it that of its nearest pixel, so that its border is no edge."""
    return np.asarray(
        cv2.remap(
            image,
            np.ascontiguousarray(u),
            np.ascontiguousarray(v),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    )


def _inside(pixel: Float[np.ndarray, "N 2"], camera: Intrinsics, margin: int = 0) -> Bool[np.ndarray, "N"]:
    """Which pixels lie in the image, so many of them away from its border."""
    farthest = np.array([camera.width, camera.height]) - 1 - margin
    return np.all((pixel >= margin) & (pixel <= farthest), axis=1)


def _origin(
    depth: Float32[np.ndarray, "h w"], T_cam_ref: Float64[np.ndarray, "4 4"], camera: Intrinsics
) -> Float32[np.ndarray, "H W 2"]:
    """Where each pixel of another camera, which sees this depth, lies in the current image."""
    every = stride(camera)
    K = camera.matrix()
    # The homography K R K^-1 by columns, so that a whole image is three products and sums
    by_u, by_v, fixed = (K @ T_cam_ref[:3, :3] @ np.linalg.inv(K)).T.astype(np.float32)[:, :, None, None]
    shift = (K @ T_cam_ref[:3, 3]).astype(np.float32)[:, None, None]
    v, u = (every * axis.astype(np.float32) for axis in np.ogrid[: depth.shape[0], : depth.shape[1]])
    x, y, z = (by_u * u + by_v * v + fixed) * depth + shift
    z = np.maximum(z, np.float32(NEAREST_M))
    return _enlarged(np.stack([x / z, y / z], -1), every, camera)


def _enlarged(
    small: Float32[np.ndarray, "h w 2"], every: int, camera: Intrinsics
) -> Float32[np.ndarray, "H W 2"]:
    """What was decimated by `every`, at the size of the image, between its values."""
    shrink = np.array([[1 / every, 0, 0], [0, 1 / every, 0]])
    how, size = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, (camera.width, camera.height)
    return np.asarray(cv2.warpAffine(small, shrink, size, flags=how, borderMode=cv2.BORDER_REPLICATE))


def _there_and_back(
    before: UInt8[np.ndarray, "H W"],
    now: UInt8[np.ndarray, "H W"],
    pixel: Float32[np.ndarray, "N 2"],
    guess: Float32[np.ndarray, "N 2"],
    levels: int,
    criteria: tuple[int, int, float],
) -> tuple[Float32[np.ndarray, "N 2"], Bool[np.ndarray, "N"]]:
    """Where the corners are now, and which of them lead back to where they came from."""
    how = {
        "winSize": (WINDOW_PX, WINDOW_PX),
        "maxLevel": levels,
        "criteria": criteria,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "minEigThreshold": TEXTURE,
    }
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, pixel[:, None], guess[:, None].copy(), **how)
    # Looked for as far off on the way back as on the way there: from the answer anything would lead back to it
    start = there + (pixel - guess)[:, None]
    back, again, _ = cv2.calcOpticalFlowPyrLK(now, before, there, start, **how)
    there, back = there.reshape(-1, 2), back.reshape(-1, 2)
    # A corner that slid along an edge, or onto another like it, hardly comes back to where it was
    returned = np.linalg.norm(back - pixel, axis=1) < RETURN_PX
    inside = np.all((there >= 0) & (there <= np.array(now.shape[::-1]) - 1), axis=1)
    return there, (found.ravel() > 0) & (again.ravel() > 0) & returned & inside


def _motion(
    reference: Corners,
    which: Int[np.ndarray, "N"],
    pixel: Float32[np.ndarray, "N 2"],
    fewest: int,
    camera: Intrinsics,
) -> Followed | None:
    """The corners among `which`, seen at these pixels, that agree on a motion, by perspective of points; None where
    these are fewer than `fewest`."""
    if len(which) < fewest:
        return None
    K = camera.matrix()
    p_ref, seen = reference.p_cam[which].astype(np.float64), pixel.astype(np.float64)
    # Its draws are the same in each call
    ok, turn, shift, inliers = cv2.solvePnPRansac(
        p_ref,
        seen,
        K,
        None,
        iterationsCount=HYPOTHESES,
        reprojectionError=MOTION_PX,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or inliers is None or len(inliers) < fewest:
        return None
    agreed = np.asarray(inliers, int).ravel()
    turn, shift = cv2.solvePnPRefineLM(p_ref[agreed], seen[agreed], K, None, turn, shift)
    T_cam_ref = from_parts(np.asarray(cv2.Rodrigues(turn)[0]), shift.ravel())
    if not np.isfinite(T_cam_ref).all():
        return None
    return Followed(p_ref[agreed], seen[agreed], reference.axes[which[agreed]], np.linalg.inv(T_cam_ref))
