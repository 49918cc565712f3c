"""The plan of a home drawn from a seed: rooms, doors, windows, and where in each room there is space to walk.

Lengths in metres; places are (x, z) on the floor, axis 0 is x and axis 1 is z.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations
from typing import NamedTuple

from mipsjax.data.synth.build import Place
from mipsjax.data.synth.draws import Draws
from mipsjax.data.synth.home_layout import WALL, Cell, layout

MOST_ROOMS = 8
CLEAR = 0.47
"""Nothing stands nearer than this to the lines that are walked."""
# First word of every stream of a home, so that other uses of a seed draw other numbers
_FAMILY = 7043
# What streams are for: the second word
_COUNT, _LAYOUT, _STYLE = 1, 2, 3
_SIDE = 2.9  # the shortest side of a room
_DOOR_JAMB = 0.3  # from a door to the corner of a room, at least
_MOST_ATTEMPTS = 1000
_USES = ("living", "kitchen", "bedroom", "study", "dining", "bedroom", "store", "study")


class Hub(NamedTuple):
    """Where one walks in a room: round a straight line, at a distance; along it if the distance is 0."""

    start: Place
    stop: Place
    radius: float


class Room(NamedTuple):
    """A room, or a corridor."""

    cell: Cell
    use: str
    """What it is furnished for; `corridor` is not counted as a room."""
    style: int
    """Rooms of one style are painted and furnished alike."""
    hub: Hub


class Door(NamedTuple):
    """An opening in a wall."""

    rooms: tuple[int, int]
    place: Place
    """Middle of the opening, in the middle of the wall."""
    axis: int
    """The axis along which one passes it."""
    width: float


class Window(NamedTuple):
    """A pane of glass in an outer wall."""

    room: int
    place: Place
    """Middle of the window on the inner face of the wall."""
    axis: int
    """The axis across the wall."""
    outward: int
    """1 where the outside is towards greater coordinates, else -1."""
    width: float
    sill: float
    height: float


class Plan(NamedTuple):
    """A home without its furniture."""

    seed: int
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]
    windows: tuple[Window, ...]
    height: float
    returns: bool
    """Whether the walk ends where it began."""

    def room_count(self) -> int:
        """How many rooms there are, not counting a corridor."""
        return sum(room.use != "corridor" for room in self.rooms)

    def doors_of(self, room: int) -> list[Door]:
        return [door for door in self.doors if room in door.rooms]


def stream(seed: int, *name: int) -> Draws:
    """The choices of one kind for one home."""
    return Draws(_FAMILY, seed, *name)


@lru_cache(maxsize=8)
def home_plan(seed: int) -> Plan:
    """One to eight rooms, every one with a way to every other."""
    draws = stream(seed, _COUNT)
    count, height = draws.pick(range(1, MOST_ROOMS + 1)), draws.between(2.4, 2.8)
    returns, twins = draws.chance(0.55), draws.chance(0.45)
    for attempt in range(_MOST_ATTEMPTS):
        draws = stream(seed, _LAYOUT, attempt)
        cells, corridor = layout(count, draws, twins)
        doors = _doors(cells, corridor, draws)
        if doors is not None and min(cell.side(axis) for cell in cells for axis in (0, 1)) >= _SIDE:
            rooms = _rooms(seed, cells, draws, twins)
            if corridor is not None:
                rooms = (*rooms, Room(corridor, "corridor", count, _hall_hub(corridor)))
            return Plan(seed, rooms, doors, _windows(rooms, draws), height, returns)
    raise AssertionError(f"no plan for seed {seed}")


# Rooms


def _rooms(seed: int, cells: list[Cell], draws: Draws, twins: bool) -> tuple[Room, ...]:
    """Uses for all cells, the largest a living room; with `twins`, the two nearest in size are alike."""
    order = sorted(range(len(cells)), key=lambda row: -cells[row].side(0) * cells[row].side(1))
    uses = dict(zip(order, (_USES[0], *draws.shuffled(_USES[1:])), strict=False))
    styles = {row: row for row in order}
    if twins and len(cells) > 2:
        first, second = min(combinations(order[1:], 2), key=lambda pair: _unlike(cells, *pair))
        uses[second], styles[second] = uses[first], first
    return tuple(
        Room(
            cell, uses[row], styles[row], _room_hub(cell, len(cells) == 1, stream(seed, _STYLE, styles[row]))
        )
        for row, cell in enumerate(cells)
    )


def _unlike(cells: list[Cell], first: int, second: int) -> float:
    return sum(abs(cells[first].side(axis) - cells[second].side(axis)) for axis in (0, 1))


def _room_hub(cell: Cell, alone: bool, draws: Draws) -> Hub:
    """A loop that leaves room for furniture along the walls, longer in a longer room.

    In the only room of a home it is wider: there one goes round and round, and the camera with one.
    """
    axis = 0 if cell.side(0) >= cell.side(1) else 1
    radius = 0.75 if alone else 0.5 if cell.side(1 - axis) < 4.0 else draws.between(0.5, 0.7)
    spare = [cell.side(a) / 2 - radius - CLEAR - 0.1 for a in (0, 1)]
    reach = max(0.1 if alone else 0.0, (spare[axis] - 0.6) * draws.between(0.2, 0.8))
    shift = [0.6 * draws.between(-1.0, 1.0) * (spare[a] - (reach if a == axis else 0.0)) for a in (0, 1)]
    center = [cell.middle()[a] + shift[a] for a in (0, 1)]
    ends = [tuple(center[a] + sign * (reach if a == axis else 0.0) for a in (0, 1)) for sign in (-1, 1)]
    return Hub((ends[0][0], ends[0][1]), (ends[1][0], ends[1][1]), radius)


def _hall_hub(cell: Cell) -> Hub:
    """The middle line of a corridor."""
    x, z = cell.middle()
    if cell.side(0) >= cell.side(1):
        return Hub((cell.low[0] + 0.7, z), (cell.high[0] - 0.7, z), 0.0)
    return Hub((x, cell.low[1] + 0.7), (x, cell.high[1] - 0.7), 0.0)


# Doors and windows


def _doors(cells: list[Cell], corridor: Cell | None, draws: Draws) -> tuple[Door, ...] | None:
    """A door wherever rooms would not be joined without it, and a few more; None if some stay apart.

    Doors into the corridor come before doors between rooms.
    """
    rooms = [*cells, corridor] if corridor is not None else cells
    # Rooms of one number have a way to each other
    group = list(range(len(rooms)))
    found, wished = list[Door](), list[Door]()
    for pair in sorted(combinations(range(len(rooms)), 2), key=lambda pair: pair[1] < len(cells)):
        door = _door(rooms, pair, draws)
        wished += [door] if door else []
    halls, others = ([d for d in wished if (d.rooms[1] >= len(cells)) == hall] for hall in (True, False))
    for door in (*draws.shuffled(halls), *draws.shuffled(others)):
        a, b = (group[room] for room in door.rooms)
        if a != b or draws.chance(0.15):
            found.append(door)
            group = [a if g == b else g for g in group]
    return tuple(found) if len(set(group)) == 1 else None


def _door(rooms: list[Cell], pair: tuple[int, int], draws: Draws) -> Door | None:
    """A door in the wall between two rooms, if they have a wall in common that is wide enough."""
    # Drawn whether there is room or not, so that a door moves no draw of another pair's
    width = draws.between(1.0, 1.25)
    place = draws.between(0.0, 1.0)
    a, b = rooms[pair[0]], rooms[pair[1]]
    for axis in (0, 1):
        for near, far in ((a, b), (b, a)):
            if abs(far.low[axis] - near.high[axis] - WALL) > 1e-6:
                continue
            begin = max(a.low[1 - axis], b.low[1 - axis]) + _DOOR_JAMB + width / 2
            end = min(a.high[1 - axis], b.high[1 - axis]) - _DOOR_JAMB - width / 2
            if end > begin:
                across = round(near.high[axis] + WALL / 2, 3)
                along = round(begin + place * (end - begin), 3)
                return Door(pair, (across, along) if axis == 0 else (along, across), axis, width)
    return None


def _windows(rooms: tuple[Room, ...], draws: Draws) -> tuple[Window, ...]:
    """In most outer walls, one."""
    found = list[Window]()
    for axis in (0, 1):
        ends = min(room.cell.low[axis] for room in rooms), max(room.cell.high[axis] for room in rooms)
        for number, room in enumerate(rooms):
            for end, outward in zip((room.cell.low, room.cell.high), (-1, 1), strict=True):
                # Nothing is built beyond the outermost walls; others may have a room behind them
                if end[axis] not in ends or not draws.chance(0.7):
                    continue
                width = min(draws.between(0.9, 1.8), room.cell.side(1 - axis) - 0.7)
                slack = room.cell.side(1 - axis) / 2 - width / 2 - 0.3
                along = round(room.cell.middle()[1 - axis] + draws.between(-1.0, 1.0) * slack, 3)
                place = (end[axis], along) if axis == 0 else (along, end[axis])
                sill = draws.between(0.85, 1.0)
                found.append(Window(number, place, axis, outward, width, sill, draws.between(1.05, 1.3)))
    return tuple(found)
