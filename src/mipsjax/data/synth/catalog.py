"""The built-in sequences by name: a scene, a camera path through it, and an image size.

Besides those of `SPECS` there is one for every whole number: `home-SEED`, and `home-SEED-fast`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from mipsjax.core.camera import Intrinsics
from mipsjax.data.synth.apartment import WALK, apartment
from mipsjax.data.synth.corridors import RING, STAIR, corridor_loop, winding_corridor
from mipsjax.data.synth.home import home
from mipsjax.data.synth.home_walk import FAST, SLOW, home_walk
from mipsjax.data.synth.path import CameraPath, SpeedLimits, spline_path
from mipsjax.data.synth.rooms import living_room
from mipsjax.data.synth.scene import Scene
from mipsjax.data.synth.walk import Gait, walk

FPS = 30.0
"""Frames a second, unless a sequence says otherwise."""

# A field of view of 62.7 x 49.1 degrees, as the usual structured-light cameras have
QVGA = Intrinsics(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)


class Spec(NamedTuple):
    """How to make one sequence. Scene and path are made when first needed."""

    scene: Callable[[], Scene]
    path: Callable[[], CameraPath]
    intrinsics: Intrinsics
    frames: int
    """Number of frames from the start of the path."""
    about: str
    """One line for a user who chooses."""
    fps: float = FPS
    """Frames a second."""


@lru_cache(maxsize=1)
def _room_slow() -> CameraPath:
    """Once round, looking across the room: 0.3 m/s."""
    heights, looks = (1.50, 1.38, 1.55, 1.42), (0.8, 1.4, 0.6, 1.5, 0.7, 1.1, 0.5)
    places, targets = _around((0.85, 0.70), (1.5, 1.2), heights, looks, laps=1, knots=10)
    limits = SpeedLimits(linear=(0.0, 0.4), angular=(0.0, 0.5))
    return spline_path(places, targets, limits, lambda s: np.full_like(s, 0.33), closed=True, roll_deg=2.0)


@lru_cache(maxsize=1)
def _room_fast() -> CameraPath:
    """Twice round a long ellipse, at the speeds of FastCaMo-Synth: 1 to 4 m/s and 0.9 to 2.2 rad/s.

    Fast along the sides, where the camera turns little per metre, slow round the ends; the first lap is
    the faster one.
    """
    heights, looks = (1.50, 1.40, 1.60, 1.45, 1.35, 1.55, 1.45), (0.0, -0.3, -0.2, 0.2, -0.4)
    places, targets = _around((1.55, 0.70), (4.0, 6.0), heights, looks, laps=2, knots=8)
    limits = SpeedLimits(linear=(1.0, 4.0), angular=(0.9, 2.2))

    def pace(s: np.ndarray) -> np.ndarray:
        return 2.5 - 1.3 * np.cos(8.0 * np.pi * s) + 0.9 * np.sin(2.0 * np.pi * s)

    return spline_path(places, targets, limits, pace, closed=True, roll_deg=2.0)


def _around(
    radii: tuple[float, float],
    look_radii: tuple[float, float],
    heights: tuple[float, ...],
    look_heights: tuple[float, ...],
    laps: int,
    knots: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Places on an ellipse about the origin and targets on the far side of another, heights taken in turn."""
    number = np.arange(laps * knots)
    angle = 2.0 * np.pi * number / knots
    height = np.take(heights, number, mode="wrap")
    look_height = np.take(look_heights, number, mode="wrap")
    places = np.stack([radii[0] * np.cos(angle), -height, radii[1] * np.sin(angle)], axis=1)
    targets = np.stack([-look_radii[0] * np.cos(angle), -look_height, -look_radii[1] * np.sin(angle)], axis=1)
    return places, targets


@lru_cache(maxsize=1)
def _apartment() -> CameraPath:
    """Through all rooms at walking speed, looking about."""
    gait = Gait(corner=0.35, ahead=2.2, look_aside=1.1, look_every=6.0)
    limits = SpeedLimits(linear=(0.5, 0.8), angular=(0.0, np.radians(40.0)))
    places, targets = walk(WALK, gait, closed=True)
    return spline_path(places, targets, limits, lambda s: np.full_like(s, 0.75), closed=True, roll_deg=1.0)


@lru_cache(maxsize=1)
def _corridor_loop() -> CameraPath:
    """Once round at a brisk walk, looking from wall to wall."""
    places, targets = walk(RING, _IN_CORRIDORS, closed=True)
    return spline_path(places, targets, _BRISK, lambda s: np.full_like(s, 1.3), closed=True, roll_deg=1.0)


@lru_cache(maxsize=1)
def _no_loop() -> CameraPath:
    """From one end to 2 m before the other."""
    stop = (STAIR[-1][0] - 2.0, STAIR[-1][1])
    places, targets = walk((*STAIR[:-1], stop), _IN_CORRIDORS, closed=False)
    return spline_path(places, targets, _BRISK, lambda s: np.full_like(s, 1.2), closed=False, roll_deg=1.0)


_IN_CORRIDORS = Gait(corner=0.6, ahead=2.4, look_aside=0.9, look_every=7.0)
_BRISK = SpeedLimits(linear=(0.9, 1.5), angular=(0.0, np.radians(60.0)))

SPECS: dict[str, Spec] = {
    "room": Spec(living_room, _room_slow, QVGA, 480, "living room, slow: 0.3 m/s, once round"),
    "room-fast": Spec(living_room, _room_fast, QVGA, 200, "living room, 1 to 4 m/s, twice round"),
    "tiny": Spec(living_room, _room_slow, QVGA.resized(80, 60), 16, "living room, 16 frames of 80 x 60"),
    "apartment": Spec(
        apartment, _apartment, QVGA, 1370, "six rooms, 16 x 12 m, walking: 0.75 m/s, through all and back"
    ),
    "corridor-loop": Spec(
        corridor_loop, _corridor_loop, QVGA, 1590, "ring of corridors, 64 m, 1.3 m/s, once round and 4 m more"
    ),
    "no-loop": Spec(
        winding_corridor,
        _no_loop,
        QVGA,
        1040,
        "corridor of four legs that look alike, 42 m, 1.2 m/s, no return",
    ),
}

HOMES: dict[str, str] = {
    "home-SEED": "a furnished home of one to eight rooms drawn from SEED, a whole number: 0.4 to 1 m/s, 15 Hz",
    "home-SEED-fast": "the same home and walk at 1 to 4 m/s, 30 Hz",
}
"""Families of sequences by the form of their names, with a line about each."""
# As many digits as are no nuisance in a file name
_HOME = re.compile(r"home-(0|[1-9][0-9]{0,17})(-fast)?", re.ASCII)
# Seconds for which a walk that has come back goes on
_AGAIN_S = 1.0


def find(name: str) -> Spec | None:
    """The sequence of that name, or None."""
    match = _HOME.fullmatch(name)
    if match is None:
        return SPECS.get(name)
    return _home(int(match[1]), fast=match[2] is not None)


@lru_cache(maxsize=8)
def _home(seed: int, *, fast: bool) -> Spec:
    tempo = FAST if fast else SLOW
    path = home_walk(seed, tempo)
    seconds = path.duration + _AGAIN_S if path.closed else path.duration
    return Spec(
        partial(home, seed),
        lambda: path,
        QVGA,
        1 + int(seconds * tempo.fps),
        HOMES["home-SEED-fast" if fast else "home-SEED"],
        tempo.fps,
    )
