"""Trust in colour: all of it where it agrees with surfaces, less where these contradict it."""

from __future__ import annotations

import numpy as np
import pytest

from mipsjax.core.relative import Relative
from mipsjax.uncertainty.trust import ALLOWED, FEWEST, MATCHED, STEPS, Differing, differing, of_pair, trusted

SIGMA = 0.01
"""Metres, or rad, of colour and of surfaces each."""


def pairs(spread: float, sigma_colour: float = SIGMA, count: int = 200) -> list[Differing]:
    """Poses by colour that are off by so much."""
    rng = np.random.default_rng(0)
    surfaces, colour = np.eye(6) / SIGMA**2, np.eye(6) / sigma_colour**2
    found = [differing(twist, surfaces, colour) for twist in rng.normal(size=(count, 6)) * spread]
    assert None not in found
    return found  # pyright: ignore[reportReturnType]


def test_contradiction_is_one_of_what_is_expected():
    both = np.hypot(SIGMA, SIGMA)
    found = [pair.contradiction(1.0) for pair in pairs(both)]
    assert np.mean(found) == pytest.approx(1.0, abs=0.1)  # of 1200 squares


def test_colour_that_agrees_has_all_trust_and_so_has_none_at_all():
    assert trusted([], ALLOWED) == 1.0
    assert trusted(pairs(0.5 * ALLOWED**0.5 * SIGMA), ALLOWED) == 1.0


def test_trust_falls_until_the_contradiction_is_usual():
    some = pairs(SIGMA)
    trust = trusted(some, ALLOWED)
    assert STEPS[-1] < trust < 1
    assert np.median([pair.contradiction(trust) for pair in some]) <= ALLOWED
    assert np.median([pair.contradiction(1.2 * trust) for pair in some]) > ALLOWED
    assert trusted(pairs(2 * SIGMA), ALLOWED) < trust


def test_half_of_the_pairs_decide():
    agreeing, wild = pairs(0.1 * ALLOWED**0.5 * SIGMA), pairs(1.0)
    assert trusted(agreeing + wild[:90], ALLOWED) == 1.0
    assert trusted(agreeing[:90] + wild, ALLOWED) < 0.01


def said(**fields: np.ndarray) -> Relative:
    """Of one pair in which surfaces and colour each hold the frame, with some fields otherwise."""
    usual = {
        "T_first_second": np.eye(4),
        "surfaces": np.eye(6),
        "colour": 4 * np.eye(6),
        "to_surfaces": np.full(6, 0.02),
        "to_colour": np.full(6, -0.01),
        "matched": np.array(0.9),
    }
    return Relative(**{name: np.asarray(part)[None] for name, part in (usual | fields).items()})  # pyright: ignore[reportArgumentType]


def test_the_difference_is_that_of_the_poses_alone():
    found = of_pair(said(), 0)
    assert found is not None
    np.testing.assert_allclose(found.squares, np.full(6, 0.03**2), rtol=1e-6)
    np.testing.assert_allclose(found.ratio, np.full(6, 1 / 4))


def test_a_difference_counts_by_what_is_known_along_it():
    """Covariances of any shape: the mean square is that of the whole difference under the sum of both."""
    rng = np.random.default_rng(1)
    twist, (a, b) = rng.normal(size=6), rng.normal(size=(2, 6, 6))
    surfaces, colour = a @ a.T + np.eye(6), b @ b.T + np.eye(6)
    found = differing(twist, surfaces, colour)
    assert found is not None
    for trust in (1.0, 0.01):
        together = np.linalg.inv(surfaces) + np.linalg.inv(colour) / trust
        expected = twist @ np.linalg.solve(together, twist) / 6
        assert found.contradiction(trust) == pytest.approx(expected)


@pytest.mark.parametrize(
    "fields",
    [
        {"colour": np.zeros((6, 6)), "to_colour": np.full(6, np.nan)},
        {"colour": np.diag([1.0, 1, 1, 1, 1, 0])},
        {"surfaces": np.full((6, 6), np.nan)},
        {"matched": np.array(MATCHED / 2)},
    ],
)
def test_what_one_of_both_leaves_open_is_no_contradiction(fields):
    assert of_pair(said(**fields), 0) is None


def test_a_few_pairs_decide_nothing():
    assert (
        trusted(pairs(1.0, count=FEWEST - 1), ALLOWED) == 1.0
        and trusted(pairs(1.0, count=FEWEST), ALLOWED) < 0.1
    )
