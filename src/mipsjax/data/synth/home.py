"""The scene of a drawn home: its plan carved out and furnished."""

from __future__ import annotations

from functools import lru_cache

from mipsjax.data.synth.build import RGB, Solid, Vector, assemble, block, hollow
from mipsjax.data.synth.furniture import Piece, casing, together
from mipsjax.data.synth.home_furnish import DOOR_HEIGHT, furnished
from mipsjax.data.synth.home_layout import WALL
from mipsjax.data.synth.home_plan import MOST_ROOMS, Door, Plan, Room, Window, home_plan, stream
from mipsjax.data.synth.paints import FLOORS, GLOWS, HOME_PAINTS, PLAIN_WALLS, WALLS
from mipsjax.data.synth.scene import Scene

# Second word of the stream; see `stream`
_PAINT = 7
# The opening of a door or window reaches so far into the rooms: distances in a union of boxes are short where
# the overlap is thin
_OVERLAP = 0.6
# The floor of an opening is higher, or rounding would choose between its paint and the room's
_SILL = 0.004
_NICHE, _PANE, _BAR = 0.2, 0.02, 0.035
# Every home has as many lights, so that homes share compiled code; those too many are dark
_LIGHTS = MOST_ROOMS + 2


@lru_cache(maxsize=4)
def home(seed: int) -> Scene:
    """A furnished home of one to eight rooms, the same for a seed every time."""
    plan = home_plan(seed)
    carved = [_room(plan, room) for room in plan.rooms]
    carved += [_doorway(door) for door in plan.doors]
    carved += [_niche(window) for window in plan.windows]
    pieces = together(
        [
            *(room.piece for room in furnished(seed)),
            *(_casings(door) for door in plan.doors),
            *(_pane(window) for window in plan.windows),
        ]
    )
    return assemble(HOME_PAINTS, carved, pieces.boxes, pieces.cylinders, _lights(plan), GLOWS)


def _room(plan: Plan, room: Room) -> Solid:
    """The space of a room, half of them with walls of one colour."""
    draws = stream(plan.seed, _PAINT, room.style)
    wall = draws.pick(PLAIN_WALLS if draws.chance(0.5) else WALLS)
    return hollow(room.cell.low, room.cell.high, 0.0, plan.height, (draws.pick(FLOORS), wall, "chalk"))


def _doorway(door: Door) -> Solid:
    through, half = WALL / 2 + _OVERLAP, door.width / 2
    return _opening(door.axis, door.place, (-through, through), half, (_SILL, DOOR_HEIGHT), "oak")


def _niche(window: Window) -> Solid:
    ends = sorted((-window.outward * _OVERLAP, window.outward * _NICHE))
    heights = (window.sill, window.sill + window.height)
    return _opening(window.axis, window.place, (ends[0], ends[1]), window.width / 2, heights, "white")


def _opening(
    axis: int,
    place: tuple[float, float],
    through: tuple[float, float],
    half: float,
    heights: tuple[float, float],
    floor: str,
) -> Solid:
    """Free space from `through[0]` to `through[1]` along an axis, `half` to both sides of it."""
    (x, z), (near, far) = place, through
    low = (x + near, z - half) if axis == 0 else (x - half, z + near)
    high = (x + far, z + half) if axis == 0 else (x + half, z + far)
    return hollow(low, high, heights[0], heights[1] - heights[0], (floor, "white", "white"))


def _casings(door: Door) -> Piece:
    """Round an opening, on both sides of the wall."""
    frame, (x, z) = casing(door.width, DOOR_HEIGHT), door.place
    if door.axis == 0:
        return together([frame.at((x + WALL / 2, z), 90.0), frame.at((x - WALL / 2, z), -90.0)])
    return together([frame.at((x, z + WALL / 2), 0.0), frame.at((x, z - WALL / 2), 180.0)])


def _pane(window: Window) -> Piece:
    """Glass at the outer end of its niche, and the bars that hold it."""
    width, height = window.width, window.height
    glass = block((0.0, -_NICHE), window.sill, (width + 0.02, height, _PANE), "outside")
    size = (_BAR, height, _BAR)
    upright = [block((x, 0.02 - _NICHE), window.sill, size, "white") for x in (-width / 2, 0.0, width / 2)]
    level = [
        block((0.0, 0.02 - _NICHE), bottom, (width, _BAR, _BAR), "white")
        for bottom in (window.sill, window.sill + height - _BAR)
    ]
    turn = {(1, -1): 0.0, (0, -1): 90.0, (1, 1): 180.0, (0, 1): -90.0}[window.axis, window.outward]
    return Piece((glass, *upright, *level)).at(window.place, turn)


def _lights(plan: Plan) -> list[tuple[Vector, RGB]]:
    """One in every room, two in a corridor."""
    places = []
    for room in plan.rooms:
        ends = (room.hub.start, room.hub.stop) if room.use == "corridor" else (room.cell.middle(),)
        places += ends
    lights = [((x, plan.height - 0.45, z), (1.35, 1.28, 1.15)) for x, z in places]
    return [*lights, *[((0.0, 1.0, 0.0), (0.0, 0.0, 0.0))] * (_LIGHTS - len(lights))]
