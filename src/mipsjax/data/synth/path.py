"""Smooth camera paths: splines through places and look-at targets, timed to keep speeds within limits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d

# Samples along a path for arc length and timing: under 5 mm apart in a room, 20 mm in the longest corridor
_SAMPLES = 4001
# Speed changes are spread over about this length of path (metres), so that accelerations stay human
_SMOOTHING_M = 0.15
# Limits are kept with this margin, for what smoothing and finite differences add
_MARGIN = 0.06
_DOWN = np.array([0.0, 1.0, 0.0])


class SpeedLimits(NamedTuple):
    """Least and greatest speed."""

    linear: tuple[float, float]
    """Metres a second."""
    angular: tuple[float, float]
    """Radians a second."""


@dataclass(frozen=True)
class CameraPath:
    """A camera moving along splines over a knot parameter; ask for poses by time."""

    position: CubicSpline
    target: CubicSpline
    roll: CubicSpline
    knot_at: PchipInterpolator
    """Knot parameter at a time in seconds."""
    duration: float
    """Seconds."""
    closed: bool
    """Whether the path returns to its start with the same motion and goes round again."""

    def poses(self, times: Float64[np.ndarray, "N"]) -> Float64[np.ndarray, "N 4 4"]:
        """Camera-to-world at times in seconds; a closed path goes on round, an open one rests at its ends."""
        within = np.mod(times, self.duration) if self.closed else np.clip(times, 0.0, self.duration)
        return _poses(self.position, self.target, self.roll, self.knot_at(within))


def spline_path(
    places: Float[np.ndarray, "K 3"],
    targets: Float[np.ndarray, "K 3"],
    limits: SpeedLimits,
    pace: Callable[[Float64[np.ndarray, "N"]], Float64[np.ndarray, "N"]],
    *,
    closed: bool,
    roll_deg: float = 0.0,
) -> CameraPath:
    """A path through `places` (world, metres), looking at `targets` there.

    `pace` gives the wished speed in metres a second at a fraction of the length in 0..1. The path goes as
    near to it as the limits allow; where linear and angular limits contradict each other the upper ones hold.
    The camera's horizon sways by up to `roll_deg`, as in a hand.
    """
    if closed:
        places, targets = np.vstack([places, places[:1]]), np.vstack([targets, targets[:1]])
    # Chord length to the power of a half: no cusps or loops between places at unequal distances
    knots = np.concatenate([[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(places, axis=0), axis=1)))])
    ends = "periodic" if closed else "natural"
    sway = np.radians(roll_deg) * np.sin(2.4 * np.arange(len(knots)))
    sway[-1] = sway[0] if closed else sway[-1]
    position, target, roll = (CubicSpline(knots, values, bc_type=ends) for values in (places, targets, sway))
    samples = np.linspace(0.0, knots[-1], _SAMPLES)
    times = _timing(_poses(position, target, roll, samples), limits, pace, closed)
    return CameraPath(position, target, roll, PchipInterpolator(times, samples), float(times[-1]), closed)


def speeds(
    T_world_cam: Float64[np.ndarray, "N 4 4"], seconds: float
) -> tuple[Float64[np.ndarray, "N-1"], Float64[np.ndarray, "N-1"]]:
    """Linear (m/s) and angular (rad/s) speed between poses that are `seconds` apart."""
    steps = np.linalg.norm(np.diff(T_world_cam[:, :3, 3], axis=0), axis=1)
    return steps / seconds, _angles(T_world_cam) / seconds


def _poses(
    position: CubicSpline, target: CubicSpline, roll: CubicSpline, knots: Float64[np.ndarray, "N"]
) -> Float64[np.ndarray, "N 4 4"]:
    """Axes as in OpenCV: z to the target, y down, then turned about z by the roll."""
    places, angles = position(knots), roll(knots)[:, None]
    z = _unit(target(knots) - places)
    x = _unit(np.cross(_DOWN, z))
    y = np.cross(z, x)
    T_world_cam = np.tile(np.eye(4), (len(knots), 1, 1))
    T_world_cam[:, :3, 0] = np.cos(angles) * x + np.sin(angles) * y
    T_world_cam[:, :3, 1] = np.cos(angles) * y - np.sin(angles) * x
    T_world_cam[:, :3, 2] = z
    T_world_cam[:, :3, 3] = places
    return T_world_cam


def _unit(vectors: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _angles(T_world_cam: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "N-1"]:
    """Angle of rotation between neighbours, by the chord |R1 - R2| = sqrt(8) sin(angle / 2)."""
    chord = np.linalg.norm(np.diff(T_world_cam[:, :3, :3], axis=0), axis=(1, 2))
    return 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))


def _timing(
    T_world_cam: Float64[np.ndarray, "S 4 4"],
    limits: SpeedLimits,
    pace: Callable[[Float64[np.ndarray, "N"]], Float64[np.ndarray, "N"]],
    closed: bool,
) -> Float64[np.ndarray, "S"]:
    """Seconds at each pose, from 0."""
    steps, turns = speeds(T_world_cam, 1.0)
    along = np.cumsum(steps) - 0.5 * steps
    low, high = _allowed(turns / steps, limits)
    width = _SMOOTHING_M / np.mean(steps)
    wished = np.clip(pace(along / np.sum(steps)), low, high)
    smooth = gaussian_filter1d(wished, width, mode="wrap" if closed else "nearest")
    # Once more within limits: smoothing carries speed over into narrow ones
    return np.concatenate([[0.0], np.cumsum(steps / np.clip(smooth, low, high))])


def _allowed(
    turn_per_metre: Float64[np.ndarray, "N"], limits: SpeedLimits
) -> tuple[Float64[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """Least and greatest linear speed where the camera turns by so many radians a metre."""
    turn = np.maximum(turn_per_metre, 1e-9)
    high = (1.0 - _MARGIN) * np.minimum(limits.linear[1], limits.angular[1] / turn)
    low = (1.0 + _MARGIN) * np.maximum(limits.linear[0], limits.angular[0] / turn)
    return np.minimum(low, high), high
