"""How far a pose may be off: closed forms, and a camera that goes where only chance knows."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from mipsjax.config import HeldConfig
from mipsjax.host.held import (
    EXACT,
    NONE,
    OPEN,
    adjoint,
    at,
    cross,
    deviations,
    difference,
    directions,
    held,
    moved,
)
from painted import pose

CFG = HeldConfig()
T = pose((20, -40, 70), (1.0, -2.0, 3.0))
SECONDS = 1 / 30
FIRM = np.diag([1 / 0.002**2] * 3 + [1 / 0.001**2] * 3)


def exp(twist: np.ndarray) -> np.ndarray:
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = cross(twist[3:]), twist[:3]
    return expm(generator)


def test_the_adjoint_carries_a_twist_to_the_other_side():
    twist = np.array([0.3, -0.2, 0.1, 0.4, 0.5, -0.6])
    np.testing.assert_allclose(T @ exp(twist), exp(adjoint(T) @ twist) @ T, atol=1e-12)


def test_a_frame_that_is_measured_is_as_good_as_its_measurement_and_its_keyframes():
    reference = moved(np.diag([0.01] * 3 + [0.002] * 3) ** 2, T)
    vague = at(np.eye(6), EXACT, np.eye(4))
    found = held(reference, vague, T, FIRM, SECONDS, CFG)
    expected = reference + moved(np.linalg.inv(FIRM), T)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-3, atol=1e-9)
    # Measured again and again against the same keyframes it is never better than these
    for _ in range(100):
        found = held(reference, found, T, FIRM, SECONDS, CFG)
    assert np.linalg.eigvalsh(found.covariance - reference)[0] > -1e-12


def test_what_nothing_holds_strays_as_chance_makes_it():
    """An acceleration by chance in each frame, for a second, in the frame of a camera that stands."""
    rng, frames, last = np.random.default_rng(0), 30, EXACT
    for _ in range(frames):
        last = held(last.covariance * 0, last, np.eye(4), NONE, SECONDS, CFG)
    changes = CFG.acceleration * SECONDS**2 * rng.standard_normal((4000, frames, 3))
    strayed = changes.cumsum(1).cumsum(1)[:, -1]
    # 4000 draws: the standard deviation is good to 2 % or so
    np.testing.assert_allclose(np.sqrt(np.diag(last.covariance)[:3]), strayed.std(0), rtol=0.05)


def test_a_direction_that_is_measured_again_is_good_again_and_the_others_are_not():
    along = np.zeros(6)
    along[0] = 1
    blind = FIRM - np.outer(along, along) * FIRM[0, 0]
    last = held(NONE, EXACT, np.eye(4), FIRM, SECONDS, CFG)
    for _ in range(60):
        last = held(NONE, last, np.eye(4), blind, SECONDS, CFG)
    assert np.sqrt(last.covariance[0, 0]) > 0.1 and np.sqrt(last.covariance[1, 1]) < 0.003
    again = held(NONE, last, np.eye(4), FIRM, SECONDS, CFG)
    assert np.sqrt(again.covariance[0, 0]) < 0.003


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
    assert deviations(moved(turn, far), far) == pytest.approx((0, 0.01), abs=1e-8)
    assert deviations(turn, far) == pytest.approx((0.1, 0.01))


def test_a_difference_of_covariances_is_one():
    whole, part = np.diag([4.0, 1, 1, 1, 1, 1]), np.diag([1.0, 2, 1, 1, 1, 1])
    np.testing.assert_allclose(difference(whole, part), np.diag([3.0, 0, 0, 0, 0, 0]), atol=1e-12)
