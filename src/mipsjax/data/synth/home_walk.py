"""How a home is walked: where the camera in a walker's hand looks along a route, and how fast it goes.

It looks ahead, about, and now and then at a thing or a doorway that comes into sight. Angles in radians.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import gaussian_filter1d

from mipsjax.data.synth.build import Vector
from mipsjax.data.synth.draws import Draws
from mipsjax.data.synth.home_furnish import furnished
from mipsjax.data.synth.home_plan import Plan, home_plan, stream
from mipsjax.data.synth.home_route import STEP, route
from mipsjax.data.synth.home_ways import Line
from mipsjax.data.synth.path import CameraPath, SpeedLimits, spline_path

# Second word of the stream; see `stream`
_WALK = 6
# Looks at the line so far ahead, metres
_AHEAD = 1.4
# Looks about by so much to both sides, and up and down, once in so many metres; mean angle below the horizon
_ASIDE, _UPDOWN, _ABOUT_M, _DOWN = 0.30, 0.10, 3.6, 0.18
# A glance about every so many metres lasts for so many; no farther to the side or down than this
_GLANCE_EVERY, _GLANCE_M, _GLANCE_ASIDE, _GLANCE_DOWN = 2.6, 1.9, 1.2, 0.42
# Things nearer or farther than this are not glanced at, metres
_GLANCE_NEAR, _GLANCE_FAR = 0.7, 4.5
# Greatest turn to the side, and up or down, a metre: what the fastest walk can follow at its least speed
_YAW_SLOPE, _PITCH_SLOPE = 1.5, 0.35
# Turns are rounded by a Gaussian of this standard deviation, metres
_SMOOTH = 0.15
# Metres between the places handed on, and to what is looked at
_KNOTS_M, _TARGET_M = 0.2, 2.0
# Swing of the height over some metres, and that of each pair of steps
_SWAY, _SWAY_M, _BOB, _STRIDE_M = 0.05, 6.0, 0.012, 1.4
_ROLL_DEG = 1.0

Samples = Float64[np.ndarray, "S"]


class Tempo(NamedTuple):
    """How fast somebody goes."""

    limits: SpeedLimits
    turning: float
    """The speed is chosen for the camera to turn so much a second where it can, rad/s."""
    acceleration: float
    """Greatest change of that speed, m/s^2."""
    fps: float
    """Frames a second of the camera."""


SLOW = Tempo(SpeedLimits(linear=(0.4, 1.0), angular=(0.0, 1.0)), turning=0.85, acceleration=0.5, fps=15.0)
FAST = Tempo(SpeedLimits(linear=(1.0, 4.0), angular=(0.0, 2.2)), turning=1.8, acceleration=6.0, fps=30.0)


@lru_cache(maxsize=8)
def home_walk(seed: int, tempo: Tempo) -> CameraPath:
    """The same way at every tempo."""
    plan, draws = home_plan(seed), stream(seed, _WALK)
    line = route(plan)
    yaw, pitch = _gaze(plan, line, draws)
    pace = _pace(yaw, pitch, tempo)
    count = round(STEP * len(line) / _KNOTS_M)
    at = np.arange(count) * len(line) / count if plan.returns else np.linspace(0, len(line) - 1, count)
    height = draws.between(1.35, 1.55) + _bob(STEP * np.arange(len(line)))
    places = np.stack([line[:, 0], -height, line[:, 1]], axis=1)
    sight = np.stack([np.cos(pitch) * np.sin(yaw), np.sin(pitch), np.cos(pitch) * np.cos(yaw)], axis=1)
    rows = np.round(at).astype(int)
    return spline_path(
        places[rows],
        (places + _TARGET_M * sight)[rows],
        tempo.limits,
        lambda share: np.interp(share, np.linspace(0.0, 1.0, len(pace)), pace),
        closed=plan.returns,
        roll_deg=_ROLL_DEG,
    )


def _bob(along: Samples) -> Samples:
    """How a hand goes up and down, metres."""
    return _SWAY * np.sin(_waves(along, _SWAY_M)) + _BOB * np.sin(_waves(along, _STRIDE_M))


def _waves(along: Samples, every_m: float) -> Samples:
    """Phases that fit a whole number of times into a walk."""
    length = along[-1] + STEP
    return 2.0 * np.pi * max(1, round(length / every_m)) * along / length


def _gaze(plan: Plan, line: Line, draws: Draws) -> tuple[Samples, Samples]:
    """Angle from z towards x, unwrapped, and angle below the horizon, at every point of a line."""
    along = STEP * np.arange(len(line))
    heading = _heading(line, plan.returns)
    aside = _ASIDE * np.sin(_waves(along, _ABOUT_M))
    down = _DOWN + _UPDOWN * np.cos(_waves(along, _ABOUT_M))
    sights = [_sights(plan, number) for number in range(len(plan.rooms))]
    for center in np.arange(0.5 * _GLANCE_EVERY, along[-1] - 0.5 * _GLANCE_EVERY, _GLANCE_EVERY):
        row = round((center + draws.between(-0.4, 0.4)) / STEP)
        seen = sights[_room_at(plan, line[row])]
        angles = [_towards(target, line[row : row + 1], heading[row : row + 1]) for target in seen]
        shown = [target for target, (side, _, far) in zip(seen, angles, strict=True) if _catches(side, far)]
        if not shown:
            continue
        side, below, _ = _towards(draws.pick(shown), line, heading)
        weight = np.clip(np.cos(np.clip((along - along[row]) / _GLANCE_M, -0.5, 0.5) * np.pi) * 1.3, 0.0, 1.0)
        aside += weight * (np.clip(side, -_GLANCE_ASIDE, _GLANCE_ASIDE) - aside)
        down += weight * (np.clip(below, 0.0, _GLANCE_DOWN) - down)
    return (
        _steadied(heading + aside, _YAW_SLOPE, plan.returns),
        _steadied(down, _PITCH_SLOPE, plan.returns),
    )


def _catches(side: Samples, far: Samples) -> bool:
    """Whether something is in front of a walker, at a distance to be looked at."""
    return bool(abs(side[0]) < _GLANCE_ASIDE and _GLANCE_NEAR < far[0] < _GLANCE_FAR)


def _sights(plan: Plan, number: int) -> list[Vector]:
    """What can be looked at in a room: its things and its doorways, as x, height and z."""
    doors = [(door.place[0], 1.0, door.place[1]) for door in plan.doors_of(number)]
    return [*(space.middle() for space in furnished(plan.seed)[number].spaces), *doors]


def _room_at(plan: Plan, place: Float64[np.ndarray, "2"]) -> int:
    """The room nearest to a place."""
    gaps = [float(np.max(np.maximum(room.cell.low - place, place - room.cell.high))) for room in plan.rooms]
    return int(np.argmin(gaps))


def _heading(line: Line, closed: bool) -> Samples:
    """Angle to the point of the line that is `_AHEAD`; an open line goes on straight."""
    count = round(_AHEAD / STEP)
    beyond = line[:count] if closed else line[-1] + np.arange(1, count + 1)[:, None] * (line[-1] - line[-2])
    ahead = np.concatenate([line, beyond])[count:] - line
    return np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))


def _towards(target: Vector, line: Line, heading: Samples) -> tuple[Samples, Samples, Samples]:
    """Angles aside from the heading and below the horizon, and metres, from a line to a target."""
    x, height, z = target
    right, ahead = x - line[:, 0], z - line[:, 1]
    far = np.hypot(right, ahead)
    side = np.mod(np.arctan2(right, ahead) - heading + np.pi, 2.0 * np.pi) - np.pi
    return side, np.arctan2(1.45 - height, far), far


def _steadied(angle: Samples, slope: float, closed: bool) -> Samples:
    """An angle that changes by at most `slope` a metre: midway between the two nearest ones that bound it."""
    count = len(angle)
    if closed:
        # Three times round, and the middle one taken: the bound holds across the end as well
        turns = 2.0 * np.pi * np.round((angle[-1] - angle[0]) / (2.0 * np.pi))
        angle = np.concatenate([angle - turns, angle, angle + turns])
    bounded = 0.5 * (_below(angle, slope * STEP) - _below(-angle, slope * STEP))
    smooth = gaussian_filter1d(bounded, _SMOOTH / STEP, mode="nearest")
    return smooth[count : 2 * count] if closed else smooth


def _pace(yaw: Samples, pitch: Samples, tempo: Tempo) -> Samples:
    """Speeds along a line, metres a second: slow in time before the camera turns much."""
    turn = np.hypot(np.gradient(yaw), np.gradient(pitch)) / STEP
    wished = np.clip(tempo.turning / np.maximum(turn, 1e-6), *tempo.limits.linear)
    # At an acceleration a the square of the speed changes by 2 a in a metre
    return np.sqrt(_below(wished**2, 2.0 * tempo.acceleration * STEP))


def _below(values: Samples, rise: float) -> Samples:
    """The greatest values that are nowhere above the given ones and differ by at most `rise` from the next."""
    ramp = rise * np.arange(len(values))
    forward = np.minimum.accumulate(values - ramp) + ramp
    backward = np.minimum.accumulate((values + ramp)[::-1])[::-1] - ramp
    return np.minimum(forward, backward)
