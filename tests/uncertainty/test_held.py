"""How far a pose may be off: closed forms, and a camera that goes where only chance knows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from mipsjax.config.tracking import HeldConfig
from mipsjax.core.rigid import adjoint, cross
from mipsjax.uncertainty.held import (
    EXACT,
    LASTING,
    MOVING,
    NONE,
    OPEN,
    Held,
    at,
    carried,
    deviations,
    difference,
    directions,
    gains,
    held,
    predicted,
)
from painted import pose

CFG = HeldConfig()
T = pose((20, -40, 70), (1.0, -2.0, 3.0))
STILL = np.eye(4)
SECONDS = 1 / 30
WHITE = CFG.acceleration * np.sqrt(2 * LASTING / SECONDS)
"""m/s^2: accelerations by chance in each frame that do as much as one that lasts."""
FIRM = np.diag([1 / 0.002**2] * 3 + [1 / 0.001**2] * 3)


def exp(twist: np.ndarray) -> np.ndarray:
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = cross(twist[3:]), twist[:3]
    return expm(generator)


def test_the_adjoint_carries_a_twist_to_the_other_side():
    twist = np.array([0.3, -0.2, 0.1, 0.4, 0.5, -0.6])
    np.testing.assert_allclose(T @ exp(twist), exp(adjoint(T) @ twist) @ T, atol=1e-12)


def step(
    last: Held, information: np.ndarray, reference: np.ndarray | None = NONE, T=STILL, seconds=SECONDS
) -> Held:
    return held(reference, predicted(reference, last, T, seconds, CFG), T, information)


def test_a_frame_that_is_measured_is_as_good_as_its_measurement_and_its_keyframes():
    reference = carried(np.diag([0.01] * 3 + [0.002] * 3) ** 2, T)
    found = step(at(np.eye(6), T), FIRM, reference, T)
    expected = reference + carried(np.linalg.inv(FIRM), T)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-3, atol=1e-9)
    # Measured again and again against the same keyframes it is never better than these
    for _ in range(100):
        found = step(found, FIRM, reference, T)
    assert np.linalg.eigvalsh(found.covariance - reference)[0] > -1e-9


def test_what_nothing_holds_strays_as_chance_makes_it():
    """A second of accelerations by chance, from a motion that is hardly known; whatever the keyframe is off by."""
    rng, frames = np.random.default_rng(0), 30
    changes = WHITE * SECONDS**2 * rng.standard_normal((4000, frames, 3))
    motion = MOVING * rng.standard_normal((4000, 1, 3)) + changes.cumsum(1)
    strayed = motion.sum(1).std(0)
    for common in (NONE, np.diag([0.1] * 6) ** 2):
        last = at(common, np.eye(4))
        for _ in range(frames):
            last = step(last, NONE, common)
        # 4000 draws: the standard deviation is good to 2 % or so
        found = np.sqrt(np.diag(last.covariance - common)[:3])
        np.testing.assert_allclose(found, strayed, rtol=0.05)


@pytest.mark.parametrize("every", [1, 4, 8, 30])
def test_a_slide_grows_as_chance_makes_it_whatever_keyframes_it_is_measured_against(every):
    """Each so many frames a new keyframe, itself loose by then, takes over."""
    along = np.zeros(6)
    along[0] = 1
    blind = FIRM - np.outer(along, along) * FIRM[0, 0]
    last = step(EXACT, FIRM)
    reference = last.covariance
    for place in range(60):
        last = step(last, blind, reference)
        if place % every == 0:
            reference = last.covariance
    exact = WHITE * SECONDS**2 * np.sqrt(60**3 / 3)
    assert 0.1 * exact < np.sqrt(last.covariance[0, 0]) < 2 * exact
    assert np.linalg.eigvalsh(last.joint)[0] > -1e-9


@pytest.mark.parametrize("found_m", [1e-4, 0.03])
def test_what_is_stated_is_how_far_off_a_camera_is_that_is_measured_against_the_frame_before(found_m):
    """Two seconds in front of a bare wall, then ten frames that measure the motion again; poses as they are found, by
    the gain. What is learned of a motion does not take back where it has led."""
    rng, blind, seen, draws = np.random.default_rng(4), 60, 10, 2000
    wall, again = FIRM.copy(), FIRM.copy()
    wall[0, 0], again[0, 0] = 0, 1 / found_m**2
    last, off, motion = step(EXACT, FIRM), np.zeros(draws), np.zeros(draws)
    motion += np.sqrt(last.joint[6, 6]) * rng.standard_normal(draws)
    stated = []
    for place in range(blind + seen):
        information = wall if place < blind else again
        expected = predicted(None, last, STILL, SECONDS, CFG)
        gain = gains(None, expected, STILL, information)
        motion += WHITE * SECONDS**2 * rng.standard_normal(draws)
        surprise = motion - found_m * rng.standard_normal(draws)
        motion -= gain.motion[0, 0] * surprise
        off += motion
        last = held(None, expected, STILL, information)
        stated.append(np.sqrt(last.covariance[0, 0]))
        np.testing.assert_allclose(stated[-1], off.std(), rtol=0.1)
    assert stated[-1] > 0.9 * stated[blind - 1] > 1
    assert np.linalg.eigvalsh(last.joint)[0] > -1e-9


def test_as_much_is_believed_as_leaves_the_covariance_that_is_stated():
    """P - K P of a Kalman filter, of the pose and of its part with the motion."""
    root = np.random.default_rng(1).normal(size=(6, 6))
    information = 1e4 * (root @ root.T)
    before = predicted(NONE, step(EXACT, FIRM, T=T), T, SECONDS, CFG)
    gain, after = gains(NONE, before, T, information), held(NONE, before, T, information)
    into = adjoint(np.linalg.inv(T))
    for share, rows in ((gain.pose, slice(0, 6)), (gain.motion, slice(6, 12))):
        was, left = (into @ one.joint[rows, :6] @ into.T for one in (before, after))
        pose = into @ before.covariance @ into.T
        np.testing.assert_allclose(was - share @ pose, left, atol=1e-9)
    firm, nothing = (gains(NONE, before, T, part) for part in (1e6 * FIRM, NONE))
    np.testing.assert_allclose(firm.pose, np.eye(6), atol=1e-4)
    assert not np.any(nothing.pose) and not np.any(nothing.motion)


def test_a_slow_camera_is_followed_better_than_each_frame_is_measured():
    """Up to 0.4 m/s, measured to 3 cm along one axis: with the motion before, less is missed."""
    rng, sigma, frames = np.random.default_rng(2), 0.03, 300
    truth = 0.3 * np.sin(0.04 * np.arange(frames))
    information = FIRM.copy()
    information[0, 0] = 1 / sigma**2
    last, there, speed, missed = at(NONE, STILL), 0.0, 0.0, []
    for true in truth:
        expected, guess = predicted(NONE, last, STILL, SECONDS, CFG), there + speed
        gain = gains(NONE, expected, STILL, information)
        surprise = true + sigma * rng.standard_normal() - guess
        there, speed = guess + gain.pose[0, 0] * surprise, speed + gain.motion[0, 0] * surprise
        last = held(NONE, expected, STILL, information)
        missed.append(there - true)
    assert np.std(missed[30:]) < 0.8 * sigma


def test_a_direction_that_is_measured_again_is_good_again():
    along = np.zeros(6)
    along[0] = 1
    last = step(EXACT, FIRM)
    for _ in range(60):
        last = step(last, FIRM - np.outer(along, along) * FIRM[0, 0])
    assert np.sqrt(last.covariance[0, 0]) > 0.1 and np.sqrt(last.covariance[1, 1]) < 0.003
    assert np.sqrt(step(last, FIRM).covariance[0, 0]) < 0.003


@pytest.mark.parametrize("seconds", [1e-3, 10.0, 3600.0])
def test_a_gap_between_frames_leaves_a_covariance(seconds):
    last = step(EXACT, FIRM, T=T)
    for information in (FIRM, NONE, FIRM):
        last = step(last, information, T=T, seconds=seconds)
        assert np.linalg.eigvalsh(last.joint)[0] > -1e-9 and np.isfinite(last.joint).all()
    assert deviations(last.covariance, T)[0] < 0.02


def test_directions_are_from_the_firmest_to_the_freest():
    strengths = np.array([1e4, 1e6, 1e2, 1e8, 0.0, 1e5])
    found = directions(np.diag(strengths))
    np.testing.assert_allclose(found.deviation, [1e-4, 1e-3, 1 / np.sqrt(1e5), 1e-2, 0.1, OPEN])
    assert abs(found.twist[-1][4]) == 1 and abs(found.twist[0][3]) == 1
    assert directions(NONE).deviation[-1] == OPEN


def test_deviations_are_those_of_the_camera_not_of_the_origin():
    """A turn about a camera far from the origin does not shift it; one about the origin does."""
    turn = np.diag([0, 0, 0, 0, 0, 0.01**2])
    far = pose((0, 0, 0), (10, 0, 0))
    assert deviations(carried(turn, far), far) == pytest.approx((0, 0.01), abs=1e-8)
    assert deviations(turn, far) == pytest.approx((0.1, 0.01))


def test_a_difference_of_covariances_is_one():
    whole, part = np.diag([4.0, 1, 1, 1, 1, 1]), np.diag([1.0, 2, 1, 1, 1, 1])
    np.testing.assert_allclose(difference(whole, part), np.diag([3.0, 0, 0, 0, 0, 0]), atol=1e-12)
