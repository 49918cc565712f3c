"""How far colour is to be trusted: as far as depth images do not contradict it.

Colour that was not taken at the moment of the depth, or not from where it is said to be, moves all of a frame's image
together: corners and brightness agree with each other, and only surfaces can tell. The map and the errors of a run are
those of surfaces, so it is colour that counts for less then.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.core.relative import Relative

ALLOWED = 0.03
"""Largest median of what `contradiction` gives of pairs of keyframes at which colour has all trust. Recordings that are
rendered, colour and depth together, have less; the kitchen, whose colour is of another moment, ten times as much."""
ALLOWED_TRACKED = 0.1
"""The same of frames as they are tracked, against a map of which each knows another part: rendered ones 0.01 to 0.05,
the excerpt of TUM 0.3, the kitchen 1."""
FEWEST = 10
"""Pairs, or frames, that say anything; fewer may contradict themselves by chance."""
RECENT = 50
"""Frames by which colour is judged as the run goes."""
STEPS = np.geomspace(1, 1e-4, 81)
"""Of trust that are tried, from all of it downwards."""
ROUNDING = 1e-5
"""Of an information, relative to the largest: single precision knows no better."""
MATCHED = 0.3
"""Least share of a frame's points on surfaces of the other, so that these hold the pair without colour."""


class Differing(NamedTuple):
    """How a frame's pose by colour differs from its pose by surfaces, along six directions in which each errs alone."""

    squares: Float64[np.ndarray, "*N 6"]
    """Of the difference, in variances of the pose by surfaces."""
    ratio: Float64[np.ndarray, "*N 6"]
    """Variance of the pose by colour, where this has all trust, over that by surfaces."""

    def contradiction(self, trust: float | Float64[np.ndarray, "S 1 1"]) -> Float64[np.ndarray, "*N"]:
        """The mean square of the difference, in deviations that are expected of it; 1 if these were exact. Of several
        trusts one row each."""
        return np.mean(self.squares / (1 + self.ratio / trust), -1)


def differing(
    twist: Float64[np.ndarray, "6"],
    surfaces: Float64[np.ndarray, "6 6"],
    colour: Float64[np.ndarray, "6 6"],
) -> Differing | None:
    """Of a difference, metres and radians, and inverse covariances of both poses; None where one of both alone does not
    hold the frame."""
    twist, surfaces, colour = (np.asarray(part, np.float64) for part in (twist, surfaces, colour))
    if not all(np.isfinite(part).all() for part in (surfaces, colour, twist)):
        return None
    for strength in map(np.linalg.eigvalsh, (surfaces, colour)):
        if strength[0] <= ROUNDING * strength[-1]:
            return None
    # Both covariances become diagonal in the same axes: the generalised eigenvalues are ratios of variances
    root = np.linalg.cholesky(surfaces)
    ratio, directions = np.linalg.eigh(root.T @ np.linalg.inv(colour) @ root)
    return Differing((directions.T @ root.T @ twist) ** 2, np.maximum(ratio, 0))


def of_pair(measured: Relative, place: int) -> Differing | None:
    """Of one of the pairs, measured with all trust; None also where hardly any surface is in both."""
    if measured.matched[place] < MATCHED:
        return None
    twist = np.asarray(measured.to_surfaces[place] - measured.to_colour[place])
    return differing(twist, np.asarray(measured.surfaces[place]), np.asarray(measured.colour[place]))


def trusted(differences: Sequence[Differing], allowed: float, otherwise: float = 1.0) -> float:
    """The most trust with which half of the differences contradict no more than is allowed, the least that is tried
    where none will do; `otherwise` for too few."""
    if len(differences) < FEWEST:
        return otherwise
    together = Differing(*(np.stack(parts) for parts in zip(*differences, strict=True)))
    # The median: a few frames with a moving person in them should not take trust from the rest
    usual = np.median(together.contradiction(STEPS[:, None, None]), -1)
    enough = np.flatnonzero(usual <= allowed)
    return float(STEPS[enough[0] if len(enough) else -1])
