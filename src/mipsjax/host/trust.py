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

USUAL = 0.03
"""Median of what `contradiction` gives where colour and depth belong together: 0.007 to 0.02 in rendered recordings."""
STEPS = np.geomspace(1, 1e-4, 81)
"""Of trust that are tried, from all of it downwards."""
ROUNDING = 1e-5
"""Of the information of corners, relative to the largest: single precision knows no better."""


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


def differing(measured: Relative, place: int, trust: float) -> Differing | None:
    """Of one of the pairs that were measured with this trust; None where corners alone do not hold it."""
    surfaces, corners = (
        np.asarray(part[place], np.float64) for part in (measured.surfaces, measured.corners)
    )
    if not (np.isfinite(surfaces).all() and np.isfinite(corners).all()):
        return None
    strength = np.linalg.eigvalsh(corners)
    if strength[0] <= ROUNDING * strength[-1]:
        return None
    by_surfaces, by_corners = np.linalg.inv(surfaces), np.linalg.inv(corners)
    # Each alone would be where its own slope vanishes; at the pose between them both pull alike
    twist = (by_surfaces + by_corners) @ np.asarray(measured.pull[place], np.float64)
    return Differing(twist, by_surfaces, trust * by_corners)


def trusted(pairs: list[Differing]) -> float:
    """The most trust with which half of the pairs contradict themselves no more than is usual; all of it for none."""
    for trust in STEPS if pairs else ():
        if np.median([pair.contradiction(trust) for pair in pairs]) <= USUAL:
            return float(trust)
    return float(STEPS[-1]) if pairs else 1.0
