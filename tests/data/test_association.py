"""Association by time: one-to-one, in order, near; poses between poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mipsjax.data.association import associate, nearest, poses_at, sort_stamps
from mipsjax.data.trajectory import Trajectory, known_poses
from mipsjax.errors import InputError

stamp_lists = st.lists(st.floats(0, 3), min_size=1, max_size=40, unique=True).map(sorted).map(np.array)


def straight(times: list[float]) -> Trajectory:
    """One metre and one radian a second."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = times
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(times, [0, 0, 1])).as_matrix()
    return Trajectory(np.array(times, dtype=float), poses)


@given(stamp_lists, stamp_lists, st.floats(0, 0.5))
def test_pairs_are_one_to_one_in_order_and_near(first: np.ndarray, second: np.ndarray, max_dt: float) -> None:
    closest = np.abs(first[:, None] - second).min()
    if closest > max_dt:
        with pytest.raises(InputError, match="0 of"):
            associate(first, second, max_dt)
        return
    left, right = associate(first, second, max_dt)
    assert len(left) == len(right) > 0
    assert np.all(np.diff(left) > 0) and np.all(np.diff(right) > 0)
    assert np.abs(first[left] - second[right]).max() <= max_dt
    free_left, free_right = np.delete(first, left), np.delete(second, right)
    if len(free_left) and len(free_right):  # nobody is left who could have been paired
        assert np.abs(free_left[:, None] - free_right).min() > max_dt


@given(stamp_lists, stamp_lists)
def test_nearest_is_nearest(stamps: np.ndarray, queries: np.ndarray) -> None:
    found = np.abs(stamps[nearest(stamps, queries)] - queries)
    np.testing.assert_array_equal(found, np.abs(stamps - queries[:, None]).min(axis=1))


def test_the_nearest_pair_wins() -> None:
    left, right = associate(np.array([0.00, 0.05]), np.array([0.04, 0.30]))
    assert (left.tolist(), right.tolist()) == ([1], [0])


def test_a_missing_image_costs_one_pair() -> None:
    depth = np.arange(10) / 30
    left, right = associate(np.delete(depth + 0.004, 4), depth, 0.02)
    np.testing.assert_array_equal(right, np.delete(np.arange(10), 4))
    np.testing.assert_array_equal(left, np.arange(9))


@pytest.mark.fault(23)
def test_different_clocks_are_explained() -> None:
    times = np.arange(20) / 30
    with pytest.raises(InputError, match=r"0 of 20 pairs within 0\.08 s; nearest 1 s"):
        associate(times, times + times[-1] + 1.0)


@pytest.mark.fault(21, 22)
def test_sorting_is_stable_and_drops_repetitions() -> None:
    order, notes = sort_stamps(np.array([2.0, 1.0, 2.0, 0.5, 1.0]), "rgb.txt")
    assert order.tolist() == [3, 1, 0]
    assert notes == (
        "rgb.txt: timestamps were not in order, sorted",
        "rgb.txt: 2 entries with a repeated timestamp dropped",
    )
    assert sort_stamps(np.array([1.0, 2.0]), "rgb.txt")[1] == ()


@given(st.lists(st.floats(-5, 5), max_size=30).map(np.array))
def test_sorted_stamps_increase(stamps: np.ndarray) -> None:
    order, _ = sort_stamps(stamps, "list")
    assert np.all(np.diff(stamps[order]) > 0)
    assert len(order) == len(set(stamps.tolist()))


@pytest.mark.parametrize("time", [0.0, 0.013, 0.05, 0.09])
def test_interpolation_is_exact_on_a_screw(time: float) -> None:
    found = poses_at(np.array([time]), straight([0.0, 0.05, 0.1]))
    np.testing.assert_allclose(found, straight([time]).T_world_cam, atol=1e-12)


def test_no_pose_in_gaps_and_outside() -> None:
    found = poses_at(np.array([-0.05, 0.02, 0.3, 0.5001, 0.7]), straight([0.0, 0.04, 0.5]))
    np.testing.assert_array_equal(known_poses(found), [False, True, False, True, False])


def test_unknown_and_unsorted_poses_of_the_trajectory() -> None:
    truth = straight([0.1, 0.0, 0.05, 0.02])
    truth.T_world_cam[3] = np.nan
    found = poses_at(np.array([0.02, 0.07]), truth)
    np.testing.assert_allclose(found, straight([0.02, 0.07]).T_world_cam, atol=1e-12)


@pytest.mark.parametrize("truth", [[], [1.0]], ids=["empty", "single"])
def test_short_trajectories(truth: list[float]) -> None:
    known = known_poses(poses_at(np.array([0.0, 1.0, 2.0]), straight(truth)))
    np.testing.assert_array_equal(known, [False, bool(truth), False])


def test_half_turn_between_poses() -> None:
    truth = straight([0.0, 0.1])
    truth.T_world_cam[1, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    found = poses_at(np.array([0.05]), truth)
    np.testing.assert_allclose(np.linalg.det(found[:, :3, :3]), 1)
    np.testing.assert_allclose(np.abs(found[0, 0, 1]), 1, atol=1e-12)  # a quarter turn, either way
