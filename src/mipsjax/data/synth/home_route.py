"""The line on the floor along which a home is walked: through every room, round each where there is space."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from mipsjax.data.synth.home_plan import Door, Plan, Room, stream
from mipsjax.data.synth.home_ways import Line, approach, ring

STEP = 0.05
"""Metres between the points of a route."""
# Second word of the stream; see `stream`
_ROUTE = 5
# Corners are rounded by a Gaussian of this standard deviation, metres: little enough to stay clear
# of all things
_CORNER = 0.15
# Rounds in a home of one room
_LAPS = 3
# Share of a loop that is walked in the room where a walk begins or ends
_SHARE = 0.75


def route(plan: Plan) -> Line:
    """Points `STEP` apart on the way through all rooms. That of a plan that `returns` is closed."""
    order = room_order(plan)
    if len(order) == 1:
        return _even(np.concatenate([ring(plan.rooms[0].hub)] * _LAPS), plan.returns)
    parts, seen = list[Line](), {order[0]}
    for before, here, after in zip(order, order[1:], order[2:], strict=False):
        doors = _door(plan, before, here), _door(plan, here, after)
        parts.append(_passage(plan.rooms[here], *doors, long=here not in seen))
        seen.add(here)
    if plan.returns:
        doors = _door(plan, order[-2], order[0]), _door(plan, order[0], order[1])
        last = _passage(plan.rooms[order[0]], *doors, long=True)
        parts = [last[len(last) // 2 :], *parts, last[: len(last) // 2]]
    else:
        sides = stream(plan.seed, _ROUTE, 1)
        begin = _stay(plan, order[0], order[1], sides.pick((1, -1)))
        parts = [begin[::-1], *parts, _stay(plan, order[-1], order[-2], sides.pick((1, -1)))]
    return _even(np.concatenate(parts), plan.returns)


def room_order(plan: Plan) -> list[int]:
    """Rooms as they are entered, neighbours joined by a door; from the last back to the first if it `returns`.

    Always on to one of the nearest rooms that have not been seen.
    """
    rooms = [number for number, room in enumerate(plan.rooms) if room.use != "corridor"]
    order = [stream(plan.seed, _ROUTE, 0).pick(rooms)]
    unseen = set(range(len(plan.rooms))) - set(order)
    while unseen:
        found = _shortest(plan, order, unseen)
        order += found
        unseen -= set(found)
    if plan.returns and len(plan.rooms) > 1:
        order += _shortest(plan, order, {order[0]})
    return order


def _shortest(plan: Plan, order: list[int], goals: set[int]) -> list[int]:
    """The rooms on from the last of `order` to one of some others, through the fewest doors.

    Of several such ways it is the one whose doors are nearest to each other.
    """
    waiting = [[order[-1]]]
    for trail in waiting:
        if trail[-1] in goals:
            return trail[1:]
        nexts = _neighbours(plan, [*order[:-1], *trail])
        waiting += [[*trail, room] for room in nexts if room not in trail]
    raise AssertionError("rooms are joined")


def _neighbours(plan: Plan, order: list[int]) -> list[int]:
    """The rooms beside the last of `order`, those first whose door is nearest to the one it was entered by."""
    room = order[-1]
    entry = _door(plan, *order[-2:]).place if len(order) > 1 else plan.rooms[room].hub.start
    doors = sorted(plan.doors_of(room), key=lambda door: np.hypot(*np.subtract(door.place, entry)))
    return [door.rooms[0] + door.rooms[1] - room for door in doors]


def _door(plan: Plan, first: int, second: int) -> Door:
    return next(door for door in plan.doors if set(door.rooms) == {first, second})


def _passage(room: Room, entry: Door, leave: Door, *, long: bool) -> Line:
    """From door to door along the loop of a room, on its longer or its shorter side."""
    if room.hub.radius == 0.0:
        (there, first), (back, last) = approach(room, entry, 1), approach(room, leave, 1)
        step = 1 if last >= first else -1
        return np.concatenate([there, ring(room.hub)[first:last:step], back[::-1]])
    found = []
    for side in (1, -1):
        (there, first), (back, last) = approach(room, entry, side), approach(room, leave, -side)
        found.append((there, _along(ring(room.hub), first, last, side), back[::-1]))
    chosen = (max if long else min)(found, key=lambda parts: len(parts[1]))
    return np.concatenate(chosen)


def _stay(plan: Plan, here: int, other: int, side: int) -> Line:
    """From the door of another room into one, and round it: where an open walk ends, or begins backwards."""
    room = plan.rooms[here]
    there, meet = approach(room, _door(plan, here, other), side)
    loop = ring(room.hub)
    if room.hub.radius == 0.0:
        return np.concatenate([there, loop[meet:] if len(loop) > 2 * meet else loop[meet::-1]])
    return np.concatenate([there, _along(loop, meet, meet + side * round(_SHARE * len(loop)), side)])


def _along(loop: Line, first: int, last: int, side: int) -> Line:
    """Points of a closed loop from one to another, in their order or against it."""
    count = (side * (last - first)) % len(loop)
    return loop[(first + side * np.arange(count + 1)) % len(loop)]


def _even(points: Line, closed: bool) -> Line:
    """The line with rounded corners, its points about `STEP` apart; a closed one without its first again."""
    # Rounded corners bring points closer together: the second time they are only spaced evenly
    for width in (_CORNER / STEP, 0.0):
        corners = np.concatenate([points, points[:1]]) if closed else points
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
        kept = np.concatenate([[True], np.diff(along) > 1e-9])
        count = round(along[-1] / STEP)
        samples = np.linspace(0.0, along[-1], count, endpoint=not closed)
        points = np.stack([np.interp(samples, along[kept], row[kept]) for row in corners.T], axis=1)
        if width:
            points = gaussian_filter1d(points, width, axis=0, mode="wrap" if closed else "nearest")
    return points
