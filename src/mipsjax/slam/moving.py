"""Things that move: what a frame shows where a keyframe looked through free space was not there then.

The camera is tracked, and the map learned, without it: who walks through the view else takes the camera along.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics, rays
from mipsjax.core.compiled import compiled
from mipsjax.core.rigid import transform
from mipsjax.core.views import Views, seen_through
from mipsjax.data.sequence import Frame
from mipsjax.submaps.bundle import mapping_camera, mapping_stride

EVERY_PX = 2  # of the images that are mapped: their pixels that are looked at
SQUARE = np.ones((3, 3), np.uint8)  # of these pixels: what is smaller is the edge of something, or noise


class Found(NamedTuple):
    """Of each pixel of a frame's depth image, made smaller, whether it lies in free space."""

    depth: Float32[np.ndarray, "h w"]
    free: Bool[Array, "h w"]
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
    return Found(depth, _in_free_space(depth, T_sub_cam, views, mapping_camera(camera, cfg), cfg), every)


def without_moving(frame: Frame, found: Found | None, cfg: Config) -> tuple[Frame, float]:
    """The frame without depth where something moves, and the share of its depth that is left out so.

    It is the frame as it was, and 0, where nothing moves, or so much that rather the pose is wrong.
    """
    assert frame.depth is not None
    if found is None:
        return frame, 0.0
    moving = cv2.morphologyEx(np.asarray(found.free, np.uint8), cv2.MORPH_OPEN, SQUARE)
    share = float(np.count_nonzero(moving) / max(np.count_nonzero(found.depth), 1))
    if not cfg.track.moving.least <= share <= cfg.track.moving.most:
        return frame, 0.0
    # With its edge, which lies between what moves and what is seen past it
    wide = cv2.dilate(moving, SQUARE).repeat(found.every, 0).repeat(found.every, 1)
    height, width = frame.depth.shape
    still = np.where(wide[:height, :width] > 0, np.float32(0), frame.depth)
    return frame._replace(depth=still), share


@compiled("camera", "cfg", reads=("sensor", "track"))
def _in_free_space(
    depth: Float[Array, "h w"],
    T_sub_cam: Float[Array, "4 4"],
    views: Views,
    camera: Intrinsics,
    cfg: Config,
) -> Bool[Array, "h w"]:
    """Which pixels lie where a view saw through. `camera` is that of the views; `depth` is smaller by EVERY_PX."""
    small = camera.decimated(EVERY_PX)
    v, u = jnp.mgrid[: small.height, : small.width].reshape(2, -1)
    measured = depth.reshape(-1)
    p_sub = transform(T_sub_cam, rays(v, u, small) * measured[:, None])
    through = seen_through(views, p_sub, camera, cfg.track.moving.margin, cfg.sensor.noise_growth)
    return (through & (measured > 0)).reshape(depth.shape)
