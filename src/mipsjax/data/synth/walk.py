"""Walks: where a camera in a walker's hand is and looks, along a line on the floor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d

from mipsjax.data.synth.build import Place

# Metres between samples of the line, and between the places handed on
_STEP, _PLACES_EVERY = 0.05, 0.8


class Gait(NamedTuple):
    """How somebody walks and looks about. Metres."""

    corner: float
    """Corners are rounded by a Gaussian of this standard deviation."""
    ahead: float
    """Looks at a point so far ahead on the line."""
    look_aside: float
    """The point looked at swings so far to both sides ..."""
    look_every: float
    """... once in about so many metres."""
    aside: float = 0.1
    """The camera leaves the line by so much, once in about 5 m."""
    height: tuple[float, float] = (1.45, 0.05)
    """Mean and swing of the camera's height."""
    look_height: tuple[float, float] = (1.0, 0.25)
    """Mean and swing of the height of the point looked at."""


def walk(
    corners: Sequence[Place], gait: Gait, *, closed: bool
) -> tuple[Float64[np.ndarray, "K 3"], Float64[np.ndarray, "K 3"]]:
    """Places of the camera and points it looks at, for `spline_path`, along straight lines between corners."""
    line = _rounded(np.array(corners, np.float64), gait, closed)
    beyond = 0 if closed else round(gait.ahead / _STEP)
    length = _STEP * (len(line) - beyond)
    count = round(length / _PLACES_EVERY)
    along = np.arange(count) * length / count
    at, ahead = along / _STEP, (along + gait.ahead) / _STEP

    def wave(every_m: float, phase: float) -> Float64[np.ndarray, "K"]:
        """A swing that fits a whole number of times into the walk."""
        return np.sin(2.0 * np.pi * (round(length / every_m) * along / length + phase))

    # 5 m and more: slower than steps, which a spline through places 0.8 m apart could not follow
    places = _raised(line, at, gait.aside * wave(5.0, 0.1), gait.height[0] + gait.height[1] * wave(6.0, 0.3))
    look_height = gait.look_height[0] + gait.look_height[1] * wave(7.0, 0.6)
    return places, _raised(line, ahead, gait.look_aside * wave(gait.look_every, 0.0), look_height)


def _rounded(corners: Float64[np.ndarray, "C 2"], gait: Gait, closed: bool) -> Float64[np.ndarray, "S 2"]:
    """The line in steps of about `_STEP`, an open one going on straight by `gait.ahead` at its end."""
    if closed:
        corners = np.vstack([corners, corners[:1]])
    else:
        last = corners[-1] - corners[-2]
        corners = np.vstack([corners, corners[-1] + gait.ahead * last / np.linalg.norm(last)])
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    along = np.linspace(0.0, lengths[-1], round(lengths[-1] / _STEP), endpoint=not closed)
    straight = np.stack([np.interp(along, lengths, column) for column in corners.T], axis=1)
    return gaussian_filter1d(straight, gait.corner / _STEP, axis=0, mode="wrap" if closed else "nearest")


def _raised(
    line: Float64[np.ndarray, "S 2"],
    at: Float64[np.ndarray, "K"],
    right: Float64[np.ndarray, "K"],
    height: Float64[np.ndarray, "K"],
) -> Float64[np.ndarray, "K 3"]:
    """World points over samples of the line (with fractions, cyclic), moved to its right."""
    rows = np.mod(np.round(at).astype(int), len(line))
    tangent = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
    # At the ends of an open line the differences go across to the other end
    tangent[[0, -1]] = tangent[[1, -2]]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    x, z = line[rows].T + right * np.stack([tangent[rows, 1], -tangent[rows, 0]])
    return np.stack([x, -height, z], axis=1)
