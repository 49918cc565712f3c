"""Trust in corners: all of it where they agree with surfaces, less where these contradict them."""

from __future__ import annotations

import numpy as np
import pytest

from mipsjax.core.relative import Relative
from mipsjax.host.trust import STEPS, USUAL, Differing, differing, trusted

SIGMA = 0.01
"""Metres, or rad, of corners and of surfaces each."""


def pairs(spread: float, sigma_corners: float = SIGMA, count: int = 200) -> list[Differing]:
    """Poses by corners that are off by so much."""
    rng = np.random.default_rng(0)
    covariance, of_corners = SIGMA**2 * np.eye(6), sigma_corners**2 * np.eye(6)
    return [Differing(twist, covariance, of_corners) for twist in rng.normal(size=(count, 6)) * spread]


def test_contradiction_is_one_of_what_is_expected():
    both = np.hypot(SIGMA, SIGMA)
    found = [pair.contradiction(1.0) for pair in pairs(both)]
    assert np.mean(found) == pytest.approx(1.0, abs=0.1)  # of 1200 squares


def test_corners_that_agree_have_all_trust_and_so_have_none():
    assert trusted([]) == 1.0
    assert trusted(pairs(0.5 * USUAL**0.5 * SIGMA)) == 1.0


def test_trust_falls_until_the_contradiction_is_usual():
    some = pairs(SIGMA)
    trust = trusted(some)
    assert STEPS[-1] < trust < 1
    assert np.median([pair.contradiction(trust) for pair in some]) <= USUAL
    assert np.median([pair.contradiction(1.2 * trust) for pair in some]) > USUAL
    assert trusted(pairs(2 * SIGMA)) < trust


def test_half_of_the_pairs_decide():
    agreeing, wild = pairs(0.1 * USUAL**0.5 * SIGMA), pairs(1.0)
    assert trusted(agreeing + wild[:90]) == 1.0
    assert trusted(agreeing[:90] + wild) < 0.01


@pytest.mark.parametrize("trust", [1.0, 0.01])
def test_the_difference_is_that_of_the_poses_alone(trust: float):
    """Two quadratic costs: at the minimum of their sum the slope of one says where both would be alone."""
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(2, 6, 6))
    surfaces, corners = (root @ root.T + np.eye(6) for root in roots)
    at_surfaces, at_corners = rng.normal(size=(2, 6))
    weighted = trust * corners
    between = np.linalg.solve(surfaces + weighted, surfaces @ at_surfaces + weighted @ at_corners)
    pull = weighted @ (between - at_corners)
    parts = np.zeros((4, 4)), surfaces, weighted, pull, np.array(1.0)
    found = differing(Relative(*(part[None] for part in parts)), 0, trust)  # pyright: ignore[reportArgumentType]
    assert found is not None
    np.testing.assert_allclose(found.twist, at_surfaces - at_corners, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.inv(found.corners), corners, rtol=1e-6)


@pytest.mark.parametrize(
    "corners", [np.zeros((6, 6)), np.diag([1.0, 1, 1, 1, 1, 0]), np.full((6, 6), np.nan)]
)
def test_corners_that_leave_something_open_say_nothing(corners):
    parts = np.zeros((4, 4)), np.eye(6), corners, np.ones(6), np.array(1.0)
    assert differing(Relative(*(part[None] for part in parts)), 0, 1.0) is None  # pyright: ignore[reportArgumentType]
