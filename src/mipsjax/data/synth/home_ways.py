"""The lines of a plan that are walked, and therefore kept free of furniture. Metres, places (x, z)."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.data.synth.build import Place
from mipsjax.data.synth.home_layout import WALL
from mipsjax.data.synth.home_plan import CLEAR, Door, Hub, Plan, Room

# Metres between points of a line
_STEP = 0.05
# A way from a door goes straight until so far from the wall's face
_STRAIGHT = CLEAR + 0.1
# It meets a loop so many radians before or after the point of the loop nearest to it: about along the loop
_TANGENT = np.radians(60.0)

Line = Float64[np.ndarray, "N 2"]


class Ways(NamedTuple):
    """Points that must stay clear, each by its own distance."""

    places: Line
    clear: Float64[np.ndarray, "N"]

    def moved(self, offset: Place) -> Ways:
        return Ways(self.places + np.array(offset), self.clear)


def line(*corners: tuple[float, float] | Float64[np.ndarray, "2"]) -> Line:
    """Straight from corner to corner in steps of about 5 cm."""
    parts = [np.array(corners[:1], np.float64)]
    for start, stop in pairwise(corners):
        count = max(1, round(float(np.hypot(*np.subtract(stop, start))) / _STEP))
        share = np.arange(1, count + 1)[:, None] / count
        parts.append((1.0 - share) * np.array(start) + share * np.array(stop))
    return np.concatenate(parts)


def ring(hub: Hub) -> Line:
    """The closed loop of a room without its first point again; of a corridor its middle line."""
    if hub.radius == 0.0:
        return line(hub.start, hub.stop)
    start, stop = np.array(hub.start), np.array(hub.stop)
    first = -np.pi / 2 if hub.stop[0] > hub.start[0] else 0.0
    count = round(np.pi * hub.radius / _STEP)
    angles = first + np.pi * np.arange(count + 1) / count
    cap = hub.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    loop = np.concatenate([stop + cap, line(stop + cap[-1], start - cap[0]), start - cap])
    loop = np.concatenate([loop, line(loop[-1], loop[0])])
    apart = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    return loop[apart > 1e-6]


def inward(room: Room, door: Door) -> float:
    """The sign of the direction along the door's axis that leads into a room."""
    return 1.0 if room.cell.middle()[door.axis] > door.place[door.axis] else -1.0


def approach(room: Room, door: Door, side: int) -> tuple[Line, int]:
    """From the middle of a door to the loop of a room, and the number of the point where it meets it.

    `side` is 1 to go on in the order of the loop's points and -1 against it. In a corridor the way is
    straight to the middle line, whatever the side.
    """
    loop, place = ring(room.hub), np.array(door.place)
    if room.hub.radius == 0.0:
        meet = int(np.argmin(np.linalg.norm(loop - place, axis=1)))
        return line(place, loop[meet]), meet
    front = place.copy()
    front[door.axis] += inward(room, door) * (WALL / 2 + _STRAIGHT)
    nearest = int(np.argmin(np.linalg.norm(loop - front, axis=1)))
    meet = (nearest + side * round(_TANGENT * room.hub.radius / _STEP)) % len(loop)
    return line(place, front, loop[meet]), meet


def ways(plan: Plan, number: int) -> Ways:
    """All that may be walked in one room."""
    room = plan.rooms[number]
    parts = [(ring(room.hub), CLEAR)]
    for door in plan.doors_of(number):
        parts += [(approach(room, door, side)[0], max(CLEAR, door.width / 2)) for side in (1, -1)]
    places = np.concatenate([points for points, _ in parts])
    return Ways(places, np.concatenate([np.full(len(points), clear) for points, clear in parts]))
