"""Things that move: what a frame shows where a keyframe looked through free space was not there then.

The camera is tracked, and the map learned, without it: who walks through the view else takes the camera along.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, UInt8

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics, rays
from mipsjax.core.compiled import compiled
from mipsjax.core.rigid import transform
from mipsjax.core.views import Views, observed, seen_through
from mipsjax.data.sequence import Frame
from mipsjax.submaps.bundle import mapping_camera, mapping_stride

EVERY_PX = 2  # of the images that are mapped: their pixels that are looked at
JUMP = 0.05  # of the depth: neighbours farther apart are of different things
SQUARE = np.ones((3, 3), np.uint8)  # of these pixels: what is smaller is the edge of something, or noise


class Found(NamedTuple):
    """Of each pixel of a frame's depth image, made smaller, whether it lies in free space or where nothing was seen."""

    depth: Float32[np.ndarray, "h w"]
    free: Bool[Array, "h w"]
    unseen: Bool[Array, "h w"]
    """No keyframe saw anything there, neither that nor free space."""
    every: int
    """Pixels of the frame, along both axes, that are one of these."""


def in_free_space(
    frame: Frame, T_sub_cam: Float[Array, "4 4"], views: Views | None, camera: Intrinsics, cfg: Config
) -> Found | None:
    """Where a frame at a pose shows something in space that keyframes, `views`, looked through; None without any.

    `camera` is that of the frame. JAX goes on with it while the caller does: nothing waits for it here.
    """
    assert frame.depth is not None
    if views is None or cfg.track.moving.most == 0:
        return None
    every = EVERY_PX * mapping_stride(camera, cfg)
    depth = frame.depth[::every, ::every]
    free, unseen = _in_free_space(depth, T_sub_cam, views, mapping_camera(camera, cfg), cfg)
    return Found(depth, free, unseen, every)


def without_moving(frame: Frame, found: Found | None, cfg: Config) -> tuple[Frame, float]:
    """The frame without depth where something moves, and the share of its depth that is left out so.

    It is the frame as it was, and 0, where nothing moves, or so much that rather the pose is wrong.
    """
    assert frame.depth is not None
    if found is None:
        return frame, 0.0
    moving = cv2.morphologyEx(np.asarray(found.free, np.uint8), cv2.MORPH_OPEN, SQUARE)
    measured = max(np.count_nonzero(found.depth), 1)
    if np.count_nonzero(moving) < cfg.track.moving.least * measured:
        return frame, 0.0
    moving = _whole(moving, np.asarray(found.unseen), found.depth)
    share = np.count_nonzero(moving) / measured
    if share > cfg.track.moving.most:
        return frame, 0.0
    # With its edge, which lies between what moves and what is seen past it
    wide = cv2.dilate(moving, SQUARE).repeat(found.every, 0).repeat(found.every, 1)
    height, width = frame.depth.shape
    still = np.where(wide[:height, :width] > 0, np.float32(0), frame.depth)
    return frame._replace(depth=still), share


def _whole(
    moving: UInt8[np.ndarray, "h w"], unseen: Bool[np.ndarray, "h w"], depth: Float32[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w"]:
    """What moves, with what hangs together with it where no keyframe saw anything: who comes into view from where the
    camera has not looked yet."""
    edge = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > JUMP * np.minimum(*_neighbours(depth, axis))
        for side in _neighbours(edge, axis):
            side |= jump
    candidates = (moving > 0) | (unseen & ~edge)
    _, part = cv2.connectedComponents(candidates.astype(np.uint8), connectivity=4)
    return (candidates & np.isin(part, np.unique(part[moving > 0]))).astype(np.uint8)


def _neighbours(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Views of all pixels but the last along an axis, and of those after them."""
    moved = np.moveaxis(image, axis, 0)
    return np.moveaxis(moved[:-1], 0, axis), np.moveaxis(moved[1:], 0, axis)


@compiled("camera", "cfg", reads=("sensor", "track"))
def _in_free_space(
    depth: Float[Array, "h w"],
    T_sub_cam: Float[Array, "4 4"],
    views: Views,
    camera: Intrinsics,
    cfg: Config,
) -> tuple[Bool[Array, "h w"], Bool[Array, "h w"]]:
    """Which pixels lie where a view saw through, and which where none saw anything.

    `camera` is that of the views; `depth` is smaller by EVERY_PX.
    """
    small = camera.decimated(EVERY_PX)
    v, u = jnp.mgrid[: small.height, : small.width].reshape(2, -1)
    measured = depth.reshape(-1)
    p_sub = transform(T_sub_cam, rays(v, u, small) * measured[:, None])
    margin, exists = cfg.track.moving.margin, measured > 0
    free = exists & seen_through(views, p_sub, camera, margin, cfg.sensor.noise_growth)
    unseen = exists & ~observed(views, p_sub, camera, margin)
    return free.reshape(depth.shape), unseen.reshape(depth.shape)
