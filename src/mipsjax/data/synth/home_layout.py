"""How the floor of a home is divided into rooms: rectangles with walls between them. Lengths in metres."""

from __future__ import annotations

from typing import NamedTuple

from mipsjax.data.synth.build import Place
from mipsjax.data.synth.draws import Draws

WALL = 0.16
"""Thickness of the walls."""


class Cell(NamedTuple):
    """A rectangle of floor between walls."""

    low: Place
    high: Place

    def side(self, axis: int) -> float:
        return self.high[axis] - self.low[axis]

    def middle(self) -> Place:
        return (self.low[0] + self.high[0]) / 2, (self.low[1] + self.high[1]) / 2


def layout(count: int, draws: Draws, even: bool) -> tuple[list[Cell], Cell | None]:
    """Rooms on both sides of a corridor, or without one; `even` makes rooms of one size."""
    axis = draws.pick((0, 1))
    if count < 3 or draws.chance(0.15 if count > 4 else 0.4):
        area = draws.between(17.0, 24.0) if count == 1 else count * draws.between(13.0, 19.0)
        across = round((area / draws.between(1.0, 1.6)) ** 0.5, 2)
        return _divided(_cell(axis, 0.0, 0.0, area / across, across), count, draws, even), None
    length = (count + 1) // 2 * draws.between(3.3, 4.4)
    near, hall, far = draws.between(3.3, 4.6), draws.between(1.35, 1.75), draws.between(3.3, 4.6)
    rows = _cell(axis, 0.0, 0.0, length, near), _cell(axis, 0.0, near + hall + 2 * WALL, length, far)
    rooms = [
        *_row(rows[0], axis, (count + 1) // 2, draws, even),
        *_row(rows[1], axis, count // 2, draws, even),
    ]
    return rooms, _cell(axis, 0.0, near + WALL, length, hall)


def _cell(axis: int, along: float, across: float, length: float, depth: float) -> Cell:
    """A rectangle of that length along an axis and that depth along the other."""
    end, far = round(along + length, 2), round(across + depth, 2)
    return Cell((along, across), (end, far)) if axis == 0 else Cell((across, along), (far, end))


def _divided(cell: Cell, count: int, draws: Draws, even: bool) -> list[Cell]:
    """A rectangle cut across its longer side until there are `count` rooms."""
    if count == 1:
        return [cell]
    axis = 0 if cell.side(0) >= cell.side(1) else 1
    first = count // 2
    near, far = _cut(cell, axis, first / count * (1.0 if even else draws.between(0.85, 1.15)))
    return [*_divided(near, first, draws, even), *_divided(far, count - first, draws, even)]


def _row(cell: Cell, axis: int, count: int, draws: Draws, even: bool) -> list[Cell]:
    """A rectangle cut into `count` rooms side by side along an axis."""
    if count == 1:
        return [cell]
    near, rest = _cut(cell, axis, (1.0 if even else draws.between(0.85, 1.15)) / count)
    return [near, *_row(rest, axis, count - 1, draws, even)]


def _cut(cell: Cell, axis: int, share: float) -> tuple[Cell, Cell]:
    """Two parts with a wall between them; `share` is that of the first."""
    # As if a wall stood behind the last room, too: even shares then make rooms of one size
    end = round(cell.low[axis] + share * (cell.side(axis) + WALL) - WALL, 2)
    begin = round(end + WALL, 2)
    if axis == 0:
        return Cell(cell.low, (end, cell.high[1])), Cell((begin, cell.low[1]), cell.high)
    return Cell(cell.low, (cell.high[0], end)), Cell((cell.low[0], begin), cell.high)
