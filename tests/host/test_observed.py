"""Where a submap measured, and from how near."""

from __future__ import annotations

import numpy as np
import pytest

from mipsjax.host.observed import observe, range_at

CELL = 0.1
RNG = np.random.default_rng(0)


def test_every_measured_point_and_its_surroundings_are_observed():
    points = RNG.uniform(-3, 3, (200, 3))
    observed = observe(points, np.full(200, 2.0), CELL)
    around = points + RNG.uniform(-CELL, CELL, points.shape)
    np.testing.assert_array_equal(range_at(observed, around), np.full(200, 2.0, np.float32))


def test_far_from_all_points_nothing_is():
    points = RNG.uniform(-1, 1, (50, 3))
    observed = observe(points, np.ones(50), CELL)
    away = np.array([[1 + 2.1 * CELL, 0, 0], [0, -9, 0], [300.0, 0, 0]])
    assert np.isinf(range_at(observed, away)).all()


def test_the_nearest_range_counts():
    """Also that of a neighbouring cell, by the definition in double loops."""
    points, ranges = RNG.uniform(0, 1, (300, 3)), RNG.uniform(0.5, 5, 300)
    observed = observe(points, ranges, CELL)
    asked = RNG.uniform(-0.3, 1.3, (200, 3))
    cells, mine = np.floor(points / CELL), np.floor(asked / CELL)
    for point_cell, found in zip(mine, range_at(observed, asked), strict=True):
        near = np.abs(cells - point_cell).max(1) <= 1
        wanted = ranges[near].min() if near.any() else np.inf
        assert found == pytest.approx(wanted)


def test_without_points_nothing_is_observed():
    observed = observe(np.zeros((0, 3)), np.zeros(0), CELL)
    assert np.isinf(range_at(observed, np.zeros((4, 3)))).all()
