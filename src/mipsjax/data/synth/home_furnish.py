"""Furniture for the rooms of a plan, along the walls and clear of all that is walked. Lengths in metres."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.data.synth.build import Place, Vector, block
from mipsjax.data.synth.draws import Draws
from mipsjax.data.synth.furniture import Piece, together
from mipsjax.data.synth.home_pieces import Thing, pendant, things
from mipsjax.data.synth.home_plan import Door, Plan, Room, Window, home_plan, stream
from mipsjax.data.synth.home_ways import Ways, ways

DOOR_HEIGHT = 2.05
# Second word of the streams; see `stream`
_FURNITURE = 4
# Places tried for a thing before it is left out
_TRIES = 30
# Between things
_GAP = 0.04
# Walls stay free beside a door by so much, for its casing
_CASING = 0.14
# The greatest share of things that is left out of a home
_MOST_BARE = 0.3
# Rooms whose sides differ by no more are furnished alike, metres: less than things are sunk into walls
_SAME_SIZE = 0.015


class Space(NamedTuple):
    """An upright block of space, in x, height and z."""

    low: Vector
    high: Vector

    def meets(self, other: Space, gap: float) -> bool:
        """Whether less than a gap is between two."""
        pairs = zip(self.low, self.high, other.low, other.high, strict=True)
        return all(a < d + gap and c < b + gap for a, b, c, d in pairs)

    def moved(self, offset: Place) -> Space:
        dx, dz = offset
        (x, y, z), (a, b, c) = self.low, self.high
        return Space((x + dx, y, z + dz), (a + dx, b, c + dz))

    def middle(self) -> Vector:
        x, y, z = ((a + b) / 2 for a, b in zip(self.low, self.high, strict=True))
        return x, y, z


class Furnished(NamedTuple):
    """One room with its things."""

    piece: Piece
    spaces: tuple[Space, ...]
    """What each thing takes."""


@lru_cache(maxsize=8)
def furnished(seed: int) -> tuple[Furnished, ...]:
    """The things of every room of a home, the same in rooms that are alike."""
    plan = home_plan(seed)
    bare = stream(seed, _FURNITURE).between(0.0, _MOST_BARE)
    done = dict[int, Furnished]()
    for number in range(len(plan.rooms)):
        if number not in done:
            alike = [other for other in range(len(plan.rooms)) if _offset(plan, number, other) is not None]
            first = _furnish(plan, number, alike, bare)
            for other in alike:
                done[other] = _moved(first, _offset(plan, number, other) or (0.0, 0.0))
    return tuple(done[number] for number in range(len(plan.rooms)))


def _offset(plan: Plan, number: int, other: int) -> Place | None:
    """From a room to another of the same style and size; None to all others."""
    a, b = plan.rooms[number], plan.rooms[other]
    unlike = max(abs(a.cell.side(axis) - b.cell.side(axis)) for axis in (0, 1))
    if a.style != b.style or unlike > _SAME_SIZE:
        return None
    return b.cell.low[0] - a.cell.low[0], b.cell.low[1] - a.cell.low[1]


def _moved(room: Furnished, offset: Place) -> Furnished:
    return Furnished(room.piece.at(offset), tuple(space.moved(offset) for space in room.spaces))


def _furnish(plan: Plan, number: int, alike: list[int], bare: float) -> Furnished:
    """The things of one room, out of the way of the doors and windows of all that are alike."""
    room = plan.rooms[number]
    kept, walked = list[Space](), list[Ways]()
    for other in alike:
        dx, dz = _offset(plan, other, number) or (0.0, 0.0)
        kept += [space.moved((dx, dz)) for space in _openings(plan, other)]
        walked.append(ways(plan, other).moved((dx, dz)))
    found, pieces = list[Space](), [_ceiling_lamp(plan, room, stream(plan.seed, _FURNITURE, room.style, 0))]
    for rank, thing in enumerate(things(room.use, stream(plan.seed, _FURNITURE, room.style, 1))):
        # One of its own for each thing: however often one is tried, the others stay
        draws = stream(plan.seed, _FURNITURE, room.style, 2, rank)
        # What matters most is never left out to make a home barer
        if rank and draws.chance(bare):
            continue
        for _ in range(_TRIES):
            place, turn, space = _against_a_wall(room, thing, draws)
            is_free = all(_stays_clear(space, of_one) for of_one in walked)
            if is_free and not any(space.meets(other, _GAP) for other in (*kept, *found)):
                found.append(space)
                pieces.append(thing.piece.at(place, turn))
                break
    return Furnished(together(pieces), tuple(found))


def _against_a_wall(room: Room, thing: Thing, draws: Draws) -> tuple[Place, float, Space]:
    """Somewhere along one of the walls: place and turn for `Piece.at`, and the space taken."""
    axis, far, share = draws.pick((0, 1)), draws.chance(0.5), draws.between(0.0, 1.0)
    width, height, depth = thing.size
    low, high = room.cell.low, room.cell.high
    along = round(low[1 - axis] + width / 2 + share * (room.cell.side(1 - axis) - width), 3)
    wall = high[axis] if far else low[axis]
    inner = wall - depth if far else wall + depth
    spans = {axis: (min(wall, inner), max(wall, inner)), 1 - axis: (along - width / 2, along + width / 2)}
    space = Space((spans[0][0], thing.bottom, spans[1][0]), (spans[0][1], thing.bottom + height, spans[1][1]))
    turn = {(1, False): 0.0, (0, False): 90.0, (1, True): 180.0, (0, True): -90.0}[axis, far]
    return ((wall, along) if axis == 0 else (along, wall)), turn, space


def _stays_clear(space: Space, walked: Ways) -> bool:
    """Whether what is walked stays clear."""
    low, high = np.array(space.low)[[0, 2]], np.array(space.high)[[0, 2]]
    return bool(np.all(outside(walked.places, low, high) >= walked.clear))


def outside(
    places: Float64[np.ndarray, "N 2"], low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]
) -> Float64[np.ndarray, "N"]:
    """Distances of places from a rectangle, 0 inside."""
    return np.linalg.norm(np.maximum(np.maximum(low - places, places - high), 0.0), axis=1)


def _openings(plan: Plan, number: int) -> list[Space]:
    """The spaces in front of doors and windows."""
    doors = [
        _in_front(door, door.width / 2 + _CASING, 0.0, DOOR_HEIGHT + _CASING)
        for door in plan.doors_of(number)
    ]
    panes = [
        _in_front(window, window.width / 2 + 0.05, window.sill - 0.05, window.sill + window.height)
        for window in plan.windows
        if window.room == number
    ]
    return [*doors, *panes]


def _in_front(opening: Door | Window, half: float, bottom: float, top: float) -> Space:
    """Half a metre on both sides of a wall, `half` to both sides along it."""
    reach = (0.5, half) if opening.axis == 0 else (half, 0.5)
    (x, z), (dx, dz) = opening.place, reach
    return Space((x - dx, bottom, z - dz), (x + dx, top, z + dz))


def _ceiling_lamp(plan: Plan, room: Room, draws: Draws) -> Piece:
    """Over the middle of a room; with a rug below it in some."""
    rug = block(room.cell.middle(), 0.0, (1.9, 0.012, 1.4), draws.pick(("rug", "sofa", "rose")))
    below = (rug,) if room.use in ("living", "bedroom") and draws.chance(0.6) else ()
    lamp = pendant(plan.height, draws.pick(("shade", "white", "red"))).at(room.cell.middle())
    return together([lamp, Piece(below)])
