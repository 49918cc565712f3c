"""Trust in corners: all of it where they agree with surfaces, less where these contradict them."""

from __future__ import annotations

import numpy as np
import pytest

from mipsjax.core.relative import Relative
from mipsjax.host.trust import ALLOWED, FEWEST, MATCHED, STEPS, Differing, differing, trusted

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
    assert trusted(pairs(0.5 * ALLOWED**0.5 * SIGMA)) == 1.0


def test_trust_falls_until_the_contradiction_is_usual():
    some = pairs(SIGMA)
    trust = trusted(some)
    assert STEPS[-1] < trust < 1
    assert np.median([pair.contradiction(trust) for pair in some]) <= ALLOWED
    assert np.median([pair.contradiction(1.2 * trust) for pair in some]) > ALLOWED
    assert trusted(pairs(2 * SIGMA)) < trust


def test_half_of_the_pairs_decide():
    agreeing, wild = pairs(0.1 * ALLOWED**0.5 * SIGMA), pairs(1.0)
    assert trusted(agreeing + wild[:90]) == 1.0
    assert trusted(agreeing[:90] + wild) < 0.01


def said(**fields: np.ndarray) -> Relative:
    """Of one pair in which surfaces and corners each hold the frame, with some fields otherwise."""
    usual = {
        "T_first_second": np.eye(4),
        "surfaces": np.eye(6),
        "corners": 4 * np.eye(6),
        "to_surfaces": np.full(6, 0.02),
        "to_corners": np.full(6, -0.01),
        "matched": np.array(0.9),
    }
    return Relative(**{name: np.asarray(part)[None] for name, part in (usual | fields).items()})  # pyright: ignore[reportArgumentType]


def test_the_difference_is_that_of_the_poses_alone():
    found = differing(said(), 0)
    assert found is not None
    np.testing.assert_allclose(found.twist, np.full(6, 0.03))
    np.testing.assert_allclose(found.surfaces, np.eye(6))
    np.testing.assert_allclose(found.corners, np.eye(6) / 4)


@pytest.mark.parametrize(
    "fields",
    [
        {"corners": np.zeros((6, 6)), "to_corners": np.full(6, np.nan)},
        {"corners": np.diag([1.0, 1, 1, 1, 1, 0])},
        {"surfaces": np.full((6, 6), np.nan)},
        {"matched": np.array(MATCHED / 2)},
    ],
)
def test_what_one_of_both_leaves_open_is_no_contradiction(fields):
    assert differing(said(**fields), 0) is None


def test_a_few_pairs_decide_nothing():
    assert trusted(pairs(1.0, count=FEWEST - 1)) == 1.0 and trusted(pairs(1.0, count=FEWEST)) < 0.1
