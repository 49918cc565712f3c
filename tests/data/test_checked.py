"""What a caller of the library may hand over by mistake."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from mipsjax.core.camera import Intrinsics
from mipsjax.data.checked import checked_camera, checked_frame, checked_pose, checked_start
from mipsjax.data.sequence import Frame
from mipsjax.errors import InputError

CAMERA = Intrinsics(65.0, 65.0, 39.5, 29.5, 80, 60)
COLOR = np.full((60, 80, 3), 9, np.uint8)
DEPTH = np.full((60, 80), 2.0, np.float32)
FRAME = Frame(0, 0.0, COLOR, DEPTH)
NAN = float("nan")
MIRRORED = np.diag([1.0, 1.0, -1.0, 1.0])


def test_what_is_right_stays_as_it_is() -> None:
    frame, camera, pose = checked_start(FRAME, CAMERA, None)
    assert camera == CAMERA and frame.depth is not None
    np.testing.assert_array_equal(frame.depth, DEPTH)
    np.testing.assert_array_equal(pose, np.eye(4))
    assert checked_frame(Frame(1, 1.0, None, None, "missing"), CAMERA).problem == "missing"


def test_depth_that_is_no_distance_is_zero() -> None:
    depth = DEPTH.copy()
    depth[0, :3] = NAN, -1, np.inf
    found = checked_frame(FRAME._replace(depth=depth), CAMERA).depth
    assert found is not None and (found[0, :3] == 0).all() and found[1, 0] == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": 1000 * DEPTH}, "in metres, its median is 2000"),
        ({"depth": (1000 * DEPTH).astype(np.uint16)}, "got uint16"),
        ({"depth": DEPTH[:30]}, "got (30, 80)"),
        ({"depth": DEPTH.T}, "got (80, 60)"),
        ({"depth": DEPTH.tolist()}, "got object"),
        ({"color": COLOR / 255.0}, "got float64"),
        ({"color": COLOR.astype(np.uint16)}, "got uint16"),
        ({"color": COLOR[..., 0]}, "colour of shape (60, 80, 3)"),
        ({"timestamp": NAN}, "timestamp"),
    ],
)
def test_a_frame_that_is_none(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        checked_frame(FRAME._replace(**changes), CAMERA)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"color": None}, "no colour"),
        ({"depth": None}, "no depth"),
        ({"depth": 0 * DEPTH}, "no pixel"),
        ({"depth": NAN * DEPTH}, "no pixel"),
    ],
)
def test_a_frame_that_begins_no_map(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        checked_start(FRAME._replace(**changes), CAMERA, None)


@pytest.mark.parametrize(
    "camera",
    [(65.0, 65.0, 39.5, 29.5), np.eye(3), None, CAMERA._replace(fx=NAN), CAMERA._replace(width=0)],
)
def test_intrinsics_that_are_none(camera: Any) -> None:
    with pytest.raises(InputError, match="ntrinsics"):
        checked_camera(camera)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.full((4, 4), NAN), "finite"),
        (MIRRORED, "mirrored"),
        (2 * np.eye(4), "off by 3"),
        (np.eye(3), "shape (3, 3)"),
        (np.eye(4) + np.eye(4, k=-3), "last row"),
    ],
)
def test_a_pose_that_is_none(pose: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        checked_pose(pose)


def test_what_is_no_frame() -> None:
    with pytest.raises(InputError, match="got tuple"):
        checked_frame((COLOR, DEPTH), CAMERA)
