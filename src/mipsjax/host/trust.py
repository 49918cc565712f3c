"""How far corners of the image are to be trusted: as far as depth images do not contradict them.

Colour that was not taken at the moment of the depth, or not from where it is said to be, moves all corners of a frame
together: they agree with each other, and only surfaces can tell. The map and the errors of a run are those of surfaces,
so it is corners that count for less then.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.core.relative import Relative

ALLOWED = 0.03
"""Largest median of what `contradiction` gives at which corners have all trust. Rendered recordings, where colour and
depth belong together, have less; the kitchen, whose colour is of another moment, ten times as much."""
FEWEST = 10
"""Pairs that say anything; fewer may contradict themselves by chance."""
STEPS = np.geomspace(1, 1e-4, 81)
"""Of trust that are tried, from all of it downwards."""
ROUNDING = 1e-5
"""Of the information of corners, relative to the largest: single precision knows no better."""
MATCHED = 0.3
"""Least share of a frame's points on surfaces of the other, so that these hold the pair without corners."""


class Differing(NamedTuple):
    """One pair of frames: how its pose by corners differs from its pose by surfaces."""

    twist: Float64[np.ndarray, "6"]
    """Of the second frame, metres and radians."""
    surfaces: Float64[np.ndarray, "6 6"]
    """Covariance of the pose by surfaces."""
    corners: Float64[np.ndarray, "6 6"]
    """Of that by corners, where these have all trust."""

    def contradiction(self, trust: float) -> float:
        """The difference, squared, in deviations that are expected of it; 1 in the mean if these were exact."""
        covariance = self.surfaces + self.corners / trust
        return float(self.twist @ np.linalg.solve(covariance, self.twist)) / len(self.twist)


def differing(measured: Relative, place: int) -> Differing | None:
    """Of one of the pairs, measured with all trust; None where one of both alone does not hold it."""
    surfaces, corners = (
        np.asarray(part[place], np.float64) for part in (measured.surfaces, measured.corners)
    )
    twist = np.asarray(measured.to_surfaces[place] - measured.to_corners[place], np.float64)
    if not all(np.isfinite(part).all() for part in (surfaces, corners, twist)):
        return None
    strength = np.linalg.eigvalsh(corners)
    if strength[0] <= ROUNDING * strength[-1] or measured.matched[place] < MATCHED:
        return None
    return Differing(twist, np.linalg.inv(surfaces), np.linalg.inv(corners))


def trusted(pairs: list[Differing]) -> float:
    """The most trust with which half of the pairs contradict themselves no more than is allowed, the least that is
    tried where none will do; all of it for too few pairs."""
    if len(pairs) < FEWEST:
        return 1.0
    for trust in STEPS:
        if np.median([pair.contradiction(trust) for pair in pairs]) <= ALLOWED:
            return float(trust)
    return float(STEPS[-1])
