"""Recordings that are not what they are taken for, and such as only look odd."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics
from mipsjax.data.suspicion import (
    suspicions_of_depth,
    suspicions_of_times,
    suspicions_of_truth,
    suspicions_of_view,
)

UNITS = 1000.0
ROOM = (2.0 + np.linspace(0, 1, 80) + np.linspace(0, 0.5, 60)[:, None]).astype(np.float32)
SCALES = [1000.0, 5000.0, 6553.5]


def depth_remarks(depth: np.ndarray, units: float = UNITS, depth_max: float = 8.0) -> str:
    return " ".join(suspicions_of_depth(depth.astype(np.float32), units, depth_max, 3))


@pytest.mark.parametrize("units", SCALES)
def test_a_room_is_above_suspicion(units: float) -> None:
    noise = np.random.default_rng(0).normal(0, 0.01, ROOM.shape)
    for depth in (ROOM, ROOM + noise, np.where(noise > 0, ROOM, 0), np.full_like(ROOM, 2.5)):
        assert depth_remarks(np.rint(depth * units) / units, units) == ""


def test_a_scene_deeper_than_the_range() -> None:
    assert "--input.depth-max" in depth_remarks(5 * ROOM) and "100 %" in depth_remarks(5 * ROOM)
    assert depth_remarks(5 * ROOM, depth_max=20.0) == ""


def test_depth_in_whole_metres() -> None:
    assert "rounded when it was written" in depth_remarks(np.rint(ROOM))


@pytest.mark.parametrize("units", SCALES)
def test_swapped_bytes(units: float) -> None:
    swapped = np.rint(ROOM * units).astype(np.uint16).byteswap()
    assert "bytes" in depth_remarks(swapped / units, units, depth_max=100.0)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_times_of_another_unit(factor: float, unit: str) -> None:
    times, numbers = np.arange(20) / 30, np.arange(20)
    assert suspicions_of_times(times, numbers) == ()
    assert suspicions_of_times(300 * times, 300 * numbers) == (), "frames were left out"
    (remark,) = suspicions_of_times(factor * times, numbers)
    assert unit in remark


def test_images_on_their_side() -> None:
    landscape = Intrinsics(585.0, 585.0, 319.5, 239.5, 640, 480)
    assert suspicions_of_view(landscape, "camera.json") == ()
    (remark,) = suspicions_of_view(landscape._replace(width=480, height=640), "camera.json")
    assert "exchange FX with FY" in remark
    assert suspicions_of_view(landscape._replace(cx=250.0), "camera.json") == (), "off, but no better turned"


def walk() -> np.ndarray:
    """A camera that turns about two axes while it moves, and is off by a little noise."""
    along = np.linspace(0, 1, 40)
    turns = np.stack([0.3 * np.sin(6 * along), 2.0 * along, 0.2 * np.cos(5 * along)], axis=1)
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("xyz", turns).as_matrix()
    poses[:, :3, 3] = np.stack([along, 0.1 * np.sin(9 * along), along**2], axis=1)
    return poses


def w_first(poses: np.ndarray) -> np.ndarray:
    read = poses.copy()
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    read[:, :3, :3] = Rotation.from_quat(xyzw[:, [3, 0, 1, 2]]).as_matrix()
    return read


@pytest.mark.parametrize(
    ("read", "name"),
    [
        (np.linalg.inv, "world-to-camera"),
        (lambda poses: poses * np.array([1.0, -1.0, -1.0, 1.0]), "OpenGL"),
        (w_first, "w first"),
    ],
)
def test_true_poses_of_another_convention(read, name: str) -> None:
    noise = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 0.005, (40, 3))).as_matrix()
    truth = walk()
    estimate = np.linalg.inv(truth[0]) @ truth  # an estimate is in a frame of its own
    estimate[:, :3, :3] = estimate[:, :3, :3] @ noise
    assert suspicions_of_truth(estimate, truth) == ()
    (remark,) = suspicions_of_truth(estimate, read(truth))
    assert name in remark
    assert suspicions_of_truth(estimate[:5], read(truth)[:5]) == (), "too few to tell"
    assert suspicions_of_truth(estimate, np.full_like(truth, np.nan)) == ()


def test_an_estimate_that_went_astray_says_nothing_about_the_truth() -> None:
    astray = walk()
    astray[:, :3, :3] = Rotation.random(40, random_state=0).as_matrix()
    assert suspicions_of_truth(astray, walk()) == ()
