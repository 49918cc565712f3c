"""Where a submap measured, and how well."""

from __future__ import annotations

import numpy as np
import pytest

from mipsjax.mesh.observed import observe, trust_at

CELL = 0.1


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_every_measured_point_and_its_surroundings_are_observed(rng):
    points = rng.uniform(-3, 3, (200, 3))
    observed = observe(points, np.ones(200), CELL)
    around = points + rng.uniform(-0.99 * CELL, 0.99 * CELL, points.shape)
    assert (trust_at(observed, around) > 0).all()


def test_far_from_all_points_nothing_is(rng):
    points = rng.uniform(-1, 1, (50, 3))
    observed = observe(points, np.ones(50), CELL)
    away = np.array([[1 + 2.1 * CELL, 0, 0], [0, -9, 0], [300.0, 0, 0]])
    assert (trust_at(observed, away) == 0).all()


def test_trust_by_its_definition(rng):
    """In double loops: along an axis a cell gives half of its trust within itself, falling to 0 one cell away."""
    points, trust = rng.uniform(0, 1, (300, 3)), rng.uniform(0, 1, 300)
    observed = observe(points, trust, CELL)
    asked = rng.uniform(-0.3, 1.3, (200, 3))
    cells = np.floor(points / CELL).astype(int)
    best = {tuple(cell): trust[(cells == cell).all(1)].max() for cell in cells}

    def weight(cells_off: np.ndarray) -> float:
        return float(np.prod(np.clip(1.5 - np.abs(cells_off), 0, 1) / 2))

    for point, found in zip(asked, trust_at(observed, asked), strict=True):
        wanted = sum(t * weight(point / CELL - np.array(cell) - 0.5) for cell, t in best.items())
        assert found == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize("height", [0.53, 0.5, 0.501])
def test_trust_in_a_wall_is_that_of_its_points_and_fades_at_its_end(rng, height):
    """Up to a factor of two, by where the grid lies: in a cell, on a border between two, by noise in both."""
    noise = rng.normal(0, 0.004, 40_000)
    wall = np.column_stack([rng.uniform(0, 2, (40_000, 2)), height + noise])
    observed = observe(wall, np.full(len(wall), 0.8), CELL)
    inside = trust_at(observed, np.column_stack([rng.uniform(0.3, 1.7, (100, 2)), np.full(100, height)]))
    assert (inside >= 0.4 - 1e-6).all() and (inside <= 0.8 + 1e-6).all()
    ends = trust_at(observed, np.array([[x, 1, height] for x in (1.85, 1.95, 2.05, 2.15)]))
    assert (np.diff(ends) < 0).all() and ends[-1] == 0


def test_trust_has_no_steps(rng):
    observed = observe(rng.uniform(0, 1, (100, 3)), rng.uniform(0, 1, 100), CELL)
    along = np.linspace([-0.3, 0.2, 0.1], [1.3, 0.9, 0.8], 20_000)
    assert np.abs(np.diff(trust_at(observed, along))).max() < 1e-3


def test_without_points_nothing_is_observed():
    observed = observe(np.zeros((0, 3)), np.zeros(0), CELL)
    assert (trust_at(observed, np.zeros((4, 3))) == 0).all()
