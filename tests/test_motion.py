"""The filter of the camera's motion: what it predicts, how sure it is, and what it learns from a frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mipsjax.config import RefineConfig
from mipsjax.motion import LONGEST, SPEED, predict, update
from mipsjax.state import Motion

GO = RefineConfig()
DT = 1 / 30
DENSITY = np.repeat([GO.acceleration**2, GO.angular_acceleration**2], 3)
CERTAIN = np.eye(6) * 1e10  # 10 um and 10 urad


def moving(velocity, covariance=None, seconds=DT) -> Motion:
    return Motion(
        np.array(velocity, float), np.zeros((12, 12)) if covariance is None else covariance, seconds
    )


def rigid(twist) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(twist[3:]).as_matrix(), twist[:3]
    return T


def twist(T) -> np.ndarray:
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


@pytest.mark.parametrize(("intervals", "steps"), [(1, 1), (2.5, 2.5), (100, LONGEST), (0, 0), (-3, 0)])
def test_the_motion_goes_on_for_the_time_that_has_passed(intervals, steps):
    """At the same speed, but not over a long gap, and not backwards in time."""
    velocity = np.array([0.6, 0, -0.3, 0, 0.5, 0])
    found = predict(moving(velocity), intervals * DT, GO)
    np.testing.assert_allclose(found.T_last_next, rigid(steps * DT * velocity), atol=1e-12)
    assert (found.precision == 0).all() == (intervals <= 0), "without time the motion says nothing"


def test_a_known_motion_is_less_sure_the_longer_it_goes_on():
    """White noise in the acceleration: variances of the pose grow with the cube of the time."""
    for seconds in (DT, 4 * DT):
        covariance = predict(moving(np.zeros(6)), seconds, GO).covariance
        np.testing.assert_allclose(np.diag(covariance)[:6], DENSITY * seconds**3 / 3)
        np.testing.assert_allclose(np.diag(covariance)[6:], DENSITY * seconds)


@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0))
def test_two_predictions_are_one_over_the_whole_time(first, second):
    start = moving(np.zeros(6), np.diag(np.arange(1.0, 13.0)))
    halfway = predict(start, first, GO)
    onward = predict(moving(np.zeros(6), halfway.covariance), second, GO)
    np.testing.assert_allclose(onward.covariance, predict(start, first + second, GO).covariance, atol=1e-9)


def test_errors_of_the_last_pose_are_turned_into_the_next_frame():
    error, velocity = 1e-6 * np.array([1.0, -2, 3, 2, 1, -1]), np.array([3.0, -1, 2, 4, -6, 2])
    covariance = np.zeros((12, 12))
    covariance[:6, :6] = np.outer(error, error)
    still = replace(GO, acceleration=1e-9, angular_acceleration=1e-9)
    found = predict(moving(velocity, covariance), DT, still)
    onward = found.T_last_next
    expected = twist(np.linalg.inv(onward) @ rigid(error) @ onward)
    np.testing.assert_allclose(found.covariance[:6, :6], np.outer(expected, expected), atol=1e-16)


def test_a_frame_that_says_nothing_changes_nothing():
    before = predict(moving(np.ones(6), np.diag([1e-4] * 6 + [1.0] * 6)), DT, GO)
    after = update(before, before.T_last_next, np.zeros((6, 6)))
    assert after is not None
    np.testing.assert_allclose(after.velocity, before.velocity)
    np.testing.assert_allclose(after.covariance, before.covariance, atol=1e-12)


def test_where_time_says_nothing_the_motion_is_forgotten():
    assert update(predict(moving(np.ones(6)), 0.0, GO), np.eye(4), CERTAIN) is None


def test_exact_poses_give_the_velocity_between_them():
    velocity = np.array([0.9, 0.1, -0.3, 0.2, 0.5, -0.1])
    unknown = predict(None, DT, GO)
    np.testing.assert_array_equal(unknown.T_last_next, np.eye(4))
    assert np.sqrt(unknown.covariance[0, 0]) == pytest.approx(SPEED * DT, rel=0.01)
    found = update(unknown, rigid(velocity * DT), CERTAIN)
    assert found is not None and found.seconds == DT
    np.testing.assert_allclose(found.velocity, velocity, rtol=0.01)


def test_a_direction_that_surfaces_hardly_hold_is_held_by_the_frames_before():
    """A hundred seconds of a steady camera, poses 2 cm off along one axis and 2 mm and 2 mrad otherwise."""
    rng, go = np.random.default_rng(0), replace(GO, acceleration=0.1, angular_acceleration=0.1)
    noise = np.array([0.02] + [0.002] * 5)
    information = np.diag(noise**-2.0)
    grown = np.linalg.cholesky([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]])
    motion, velocity, error, errors, squares = None, np.zeros(6), np.zeros(6), [], []
    for _ in range(3000):
        wander = grown @ rng.normal(size=(2, 6)) * np.repeat([go.acceleration, go.angular_acceleration], 3)
        step, velocity = velocity * DT + wander[0], velocity + wander[1]
        predicted = predict(motion, DT, go)
        # The estimate lies `error` off the truth; so does what is predicted from it, and the frame is measured anew
        expected, seen = error + twist(predicted.T_last_next) - step, rng.normal(size=6) * noise
        posed = np.linalg.inv(predicted.precision + information)
        error = posed @ (predicted.precision @ expected + information @ seen)
        motion = update(predicted, rigid(twist(predicted.T_last_next) + error - expected), information)
        assert motion is not None
        errors.append(error)
        off = np.concatenate([error, motion.velocity - velocity])
        squares.append(off @ np.linalg.solve(motion.covariance, off))
    rms = np.sqrt(np.mean(np.square(errors[100:]), 0))
    assert rms[0] < 0.55 * noise[0] and (rms[1:] < noise[1:]).all()
    assert np.mean(squares[100:]) == pytest.approx(12, rel=0.15), "as far off as the covariance says"
