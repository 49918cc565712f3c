"""The built-in sequences by name: a scene, a camera path through it, and an image size."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mipsjax.core.camera import Intrinsics
from mipsjax.data.synth.path import CameraPath, SpeedLimits, spline_path
from mipsjax.data.synth.rooms import living_room
from mipsjax.data.synth.scene import Scene

FPS = 30.0
"""Frames a second of every sequence."""

# A field of view of 62.7 x 49.1 degrees, as the usual structured-light cameras have
QVGA = Intrinsics(fx=262.5, fy=262.5, cx=159.5, cy=119.5, width=320, height=240)


class Spec(NamedTuple):
    """How to make one sequence. Scene and path are made when first needed."""

    scene: Callable[[], Scene]
    path: Callable[[], CameraPath]
    intrinsics: Intrinsics
    frames: int
    """Number of frames at `FPS` from the start of the path."""
    about: str
    """One line for a user who chooses."""


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


SPECS: dict[str, Spec] = {
    "room": Spec(living_room, _room_slow, QVGA, 480, "living room, slow: 0.3 m/s, once round"),
    "room-fast": Spec(living_room, _room_fast, QVGA, 200, "living room, 1 to 4 m/s, twice round"),
    "tiny": Spec(living_room, _room_slow, QVGA.resized(80, 60), 16, "living room, 16 frames of 80 x 60"),
}
