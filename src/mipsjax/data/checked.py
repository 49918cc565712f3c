"""What a caller of the library hands over, looked at before anything is computed from it.

Readers of files make frames that pass; these checks are for arrays of anybody's own. Every error says what was expected
and what came.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from jaxtyping import Float64

from mipsjax.core.camera import Intrinsics
from mipsjax.data.sequence import Frame
from mipsjax.errors import InputError

FARTHEST_DEPTH = 200.0
"""Metres. No depth camera measures so far; a median beyond it is of millimetres."""

LOOKED_AT = 8
"""Pixels from one to the next of which the median is taken: every frame is checked, and a millisecond would count."""

ROTATION_TOLERANCE = 3e-3
"""How far a rotation times its transpose may be from the identity: published poses are, by up to this."""

_BOTTOM_ROW = (0.0, 0.0, 0.0, 1.0)


def checked_start(
    frame: Frame, camera: Intrinsics, T_world_cam: Float64[np.ndarray, "4 4"] | None
) -> tuple[Frame, Intrinsics, Float64[np.ndarray, "4 4"]]:
    """What a map can begin with: a frame with colour and depth, intrinsics, and the pose of the frame, the identity
    where None.

    Raises:
        InputError: one of them is not what it should be.
    """
    # First, since images are held against its size
    camera = checked_camera(camera)
    frame = checked_frame(frame, camera)
    if frame.color is None or frame.depth is None:
        missing = "colour" if frame.color is None else "depth"
        raise InputError(f"a map begins with a frame of colour and depth, this one has no {missing}")
    if not (frame.depth > 0).any():
        raise InputError("a map begins with a frame that has depth, in this one no pixel is above 0 m")
    return frame, camera, np.eye(4) if T_world_cam is None else checked_pose(T_world_cam)


def checked_frame(frame: Any, camera: Intrinsics) -> Frame:
    """A frame whose images are of the camera's size, in metres and RGB bytes, at a finite time; depth that is no
    distance is 0 in it.

    Raises:
        InputError: it is none.
    """
    if not isinstance(frame, Frame):
        raise InputError(f"a mipsjax.Frame is expected, got {type(frame).__name__}")
    if not math.isfinite(frame.timestamp):
        raise InputError(f"the timestamp of a frame must be finite seconds, got {frame.timestamp}")
    size = (camera.height, camera.width)
    if frame.color is not None:
        _check_array(frame.color, "colour", (*size, 3), np.uint8, "RGB bytes from 0 to 255")
    if frame.depth is None:
        return frame
    _check_array(frame.depth, "depth", size, np.floating, "floats in metres")
    frame = frame.cleaned()
    assert frame.depth is not None
    some = frame.depth[::LOOKED_AT, ::LOOKED_AT]
    measured = some[some > 0]
    if measured.size and (median := float(np.median(measured))) > FARTHEST_DEPTH:
        raise InputError(
            f"depth is expected in metres, its median is {median:.4g}: divide by the units per metre"
        )
    return frame


def checked_camera(camera: Any) -> Intrinsics:
    """Intrinsics that can be a camera's.

    Raises:
        InputError: they are no `Intrinsics`, or their values are not finite, or no size, or no focal length.
    """
    if not isinstance(camera, Intrinsics):
        raise InputError(
            "mipsjax.Intrinsics(fx, fy, cx, cy, width, height) are expected, got "
            f"{type(camera).__name__} of {np.shape(camera) or 'no'} numbers"
        )
    numbers = all(isinstance(value, int | float | np.number) and math.isfinite(value) for value in camera)
    if not numbers or camera.fx == 0 or camera.fy == 0 or min(camera.width, camera.height) < 1:
        raise InputError(
            f"intrinsics must be finite, focal lengths not 0 and sizes positive, got {tuple(camera)}"
        )
    return camera


def checked_pose(T_world_cam: Any) -> Float64[np.ndarray, "4 4"]:
    """A rigid motion as a matrix.

    Raises:
        InputError: it is no finite 4 x 4 matrix, or its rotation is stretched or mirrored.
    """
    pose = np.asarray(T_world_cam, np.float64)
    if pose.shape != (4, 4):
        raise InputError(f"a pose is a 4 x 4 matrix, camera to world, got an array of shape {pose.shape}")
    if not np.isfinite(pose).all():
        raise InputError("a pose must be finite; leave it out where it is not known")
    rotation = pose[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    # A transposed pose has its translation in the last row
    if off > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0 or not np.allclose(pose[3], _BOTTOM_ROW):
        raise InputError(
            "a pose must be a rotation, not mirrored, and a translation over 0 0 0 1: the rotation is off by "
            f"{off:.2g}, its determinant is {np.linalg.det(rotation):.2g}, the last row is {pose[3].tolist()}"
        )
    return pose


def _check_array(array: Any, name: str, shape: tuple[int, ...], kind: type, meaning: str) -> None:
    found_shape, found_type = np.shape(array), getattr(array, "dtype", np.dtype(object))
    if found_shape != shape:
        raise InputError(f"{name} of shape {shape} is expected, that of the intrinsics, got {found_shape}")
    if not np.issubdtype(found_type, kind):
        raise InputError(f"{name} is expected as {meaning}, got {found_type}")
