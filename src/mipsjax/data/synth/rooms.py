"""The furnished rooms. Lengths in metres; a place is (x, z) on the floor and heights are above the floor."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from mipsjax.data.synth.build import Paint, Place, Solid, assemble, ball, block, hollow, post
from mipsjax.data.synth.scene import Scene

_NOISE, _CHECKS, _STRIPES = (1.0, 0.0, 0.0, 0.0, 0.0), (0.3, 0.7, 0.0, 0.0, 0.0), (0.35, 0.0, 0.65, 0.0, 0.0)
_WOOD, _PICTURE = (0.45, 0.0, 0.0, 0.55, 0.0), (0.9, 0.0, 0.0, 0.0, 0.65)

PAINTS: dict[str, Paint] = {
    "parquet": Paint((0.22, 0.11, 0.05), (0.55, 0.33, 0.17), (8.0, 1.0, 1.6), _WOOD),
    "plaster": Paint((0.46, 0.44, 0.36), (0.80, 0.76, 0.66), (5.0, 5.0, 5.0), _NOISE),
    "ceiling": Paint((0.62, 0.62, 0.60), (0.85, 0.85, 0.83), (2.5, 2.5, 2.5), _NOISE),
    "door": Paint((0.30, 0.33, 0.30), (0.55, 0.58, 0.52), (3.0, 1.0, 7.0), _NOISE),
    "glass": Paint((0.45, 0.62, 0.80), (0.95, 0.97, 0.99), (1.5, 2.5, 1.5), _NOISE),
    "rug": Paint((0.35, 0.05, 0.06), (0.80, 0.66, 0.42), (2.5, 0.0, 2.5), _CHECKS),
    "oak": Paint((0.28, 0.15, 0.06), (0.62, 0.40, 0.20), (9.0, 5.0, 1.5), _WOOD),
    "walnut": Paint((0.09, 0.045, 0.025), (0.30, 0.17, 0.10), (10.0, 2.0, 3.0), _WOOD),
    "white": Paint((0.62, 0.62, 0.60), (0.88, 0.88, 0.86), (5.0, 5.0, 5.0), _NOISE),
    "sofa": Paint((0.05, 0.14, 0.24), (0.16, 0.36, 0.50), (12.0, 12.0, 12.0), _NOISE),
    "pillow": Paint((0.70, 0.30, 0.05), (0.92, 0.78, 0.40), (9.0, 4.0, 4.0), _STRIPES),
    "leather": Paint((0.20, 0.07, 0.03), (0.42, 0.18, 0.09), (9.0, 9.0, 9.0), _NOISE),
    "metal": Paint((0.20, 0.21, 0.23), (0.45, 0.46, 0.48), (8.0, 8.0, 8.0), _NOISE),
    "shade": Paint((0.80, 0.66, 0.40), (0.98, 0.90, 0.68), (10.0, 3.0, 10.0), _NOISE),
    "leaf": Paint((0.03, 0.12, 0.03), (0.20, 0.46, 0.12), (14.0, 14.0, 14.0), _NOISE),
    "clay": Paint((0.42, 0.16, 0.08), (0.68, 0.34, 0.20), (6.0, 10.0, 6.0), _NOISE),
    "red": Paint((0.42, 0.03, 0.03), (0.78, 0.14, 0.10), (8.0, 8.0, 8.0), _NOISE),
    "blue": Paint((0.04, 0.10, 0.40), (0.14, 0.34, 0.72), (8.0, 8.0, 8.0), _NOISE),
    "green": Paint((0.05, 0.26, 0.10), (0.22, 0.56, 0.26), (8.0, 8.0, 8.0), _NOISE),
    "books": Paint((0.08, 0.05, 0.04), (0.62, 0.50, 0.32), (1.0, 0.6, 14.0), (0.9, 0.0, 0.0, 0.0, 0.6)),
    "abstract": Paint((0.10, 0.05, 0.05), (0.90, 0.80, 0.60), (4.5, 4.5, 4.5), _PICTURE),
    "landscape": Paint((0.05, 0.10, 0.16), (0.80, 0.85, 0.90), (2.0, 6.0, 2.0), _PICTURE),
    "screen": Paint((0.01, 0.012, 0.02), (0.06, 0.07, 0.09), (4.0, 4.0, 4.0), _NOISE),
}


def _chair(place: Place, turn_deg: float) -> tuple[list[Solid], list[Solid]]:
    """Seat and back, and four legs; turned by 0 it faces +z."""
    angle = np.radians(turn_deg)

    def at(x: float, z: float) -> Place:
        turned_x, turned_z = x * np.cos(angle) + z * np.sin(angle), z * np.cos(angle) - x * np.sin(angle)
        return place[0] + float(turned_x), place[1] + float(turned_z)

    seat = block(place, 0.42, (0.44, 0.05, 0.44), "leather", rounding=0.015, turn_deg=turn_deg)
    back = block(at(0.0, -0.20), 0.50, (0.42, 0.40, 0.035), "oak", rounding=0.01, turn_deg=turn_deg)
    legs = [post(at(x, z), 0.0, 0.02, 0.43, "oak") for x in (-0.18, 0.18) for z in (-0.18, 0.18)]
    return [seat, back], legs


def _sofa() -> list[Solid]:
    return [
        block((-0.35, -1.52), 0.08, (2.0, 0.30, 0.86), "sofa", rounding=0.03),
        block((-0.35, -1.85), 0.30, (2.0, 0.52, 0.24), "sofa", rounding=0.07),
        block((-1.25, -1.52), 0.08, (0.22, 0.52, 0.88), "sofa", rounding=0.06),
        block((0.55, -1.52), 0.08, (0.22, 0.52, 0.88), "sofa", rounding=0.06),
        block((-0.75, -1.45), 0.36, (0.76, 0.13, 0.64), "sofa", rounding=0.05),
        block((0.05, -1.45), 0.36, (0.76, 0.13, 0.64), "sofa", rounding=0.05),
        block((-0.88, -1.60), 0.48, (0.42, 0.38, 0.13), "pillow", rounding=0.06, turn_deg=24.0),
        block((0.22, -1.62), 0.48, (0.38, 0.34, 0.12), "red", rounding=0.055, turn_deg=-18.0),
    ]


def _shelf() -> list[Solid]:
    """Against the wall x = -2.5, with what stands on its boards."""
    x, depth = -2.34, 0.32
    sides = [block((x, z), 0.0, (depth, 1.95, 0.03), "oak") for z in (0.20, 1.50)]
    boards = [
        block((x, 0.85), bottom, (depth, 0.03, 1.30), "oak") for bottom in (0.08, 0.50, 0.92, 1.34, 1.92)
    ]
    things = [
        block((x, 0.52), 0.53, (0.22, 0.27, 0.46), "books"),
        block((x, 1.20), 0.11, (0.26, 0.28, 0.40), "clay", rounding=0.02, turn_deg=8.0),
        block((x, 1.10), 0.95, (0.20, 0.30, 0.60), "books"),
        block((x, 0.50), 1.37, (0.20, 0.25, 0.34), "blue", turn_deg=12.0),
        block((x, 0.55), 0.11, (0.24, 0.24, 0.50), "green"),
        ball((x, 1.20), 0.53, 0.12, "red"),
        ball((x, 0.48), 0.95, 0.10, "shade"),
    ]
    return sides + boards + things


def _table() -> tuple[list[Solid], list[Solid]]:
    top = block((0.35, 0.25), 0.70, (1.25, 0.04, 0.78), "walnut", rounding=0.01)
    legs = [post((x, z), 0.0, 0.035, 0.70, "walnut") for x in (-0.19, 0.89) for z in (-0.06, 0.56)]
    things = [
        block((0.62, 0.30), 0.74, (0.24, 0.05, 0.17), "books", turn_deg=25.0),
        ball((0.10, 0.36), 0.74, 0.07, "green"),
    ]
    return [top, *things], [*legs, post((0.36, 0.12), 0.74, 0.045, 0.11, "blue", 0.005)]


def _boards() -> list[Solid]:
    """Skirting along the walls, leaving out the door."""
    height, thick = 0.09, 0.03
    return [
        block((0.0, -1.985), 0.0, (5.0, height, thick), "white"),
        block((0.0, 1.985), 0.0, (5.0, height, thick), "white"),
        block((-2.485, 0.0), 0.0, (thick, height, 4.0), "white"),
        block((2.485, -0.78), 0.0, (thick, height, 2.44), "white"),
        block((2.485, 1.68), 0.0, (thick, height, 0.64), "white"),
    ]


def _walls() -> list[Solid]:
    """What hangs on the walls or stands in the corners."""
    return [
        block((-0.95, -1.975), 1.25, (0.62, 0.48, 0.05), "abstract"),
        block((0.15, -1.98), 1.15, (0.85, 0.62, 0.04), "landscape"),
        block((-2.475, -0.35), 1.20, (0.05, 0.70, 0.52), "landscape"),
        block((2.47, -0.15), 1.15, (0.06, 0.60, 0.62), "abstract"),
        block((2.22, -1.45), 0.0, (0.56, 2.05, 1.10), "white", rounding=0.01),
        block((1.92, -1.42), 0.95, (0.05, 0.22, 0.03), "metal"),
        block((-1.72, 1.98), 1.45, (0.50, 0.62, 0.04), "abstract"),
        block((1.45, 1.97), 1.40, (0.74, 0.46, 0.06), "landscape"),
        block((2.33, 1.83), 0.0, (0.34, 2.60, 0.34), "plaster"),
        block((0.05, 1.93), 0.12, (1.20, 0.58, 0.10), "white", rounding=0.03),
        block((0.05, 1.95), 0.84, (1.55, 0.04, 0.26), "oak"),
        block((1.45, 1.77), 0.0, (1.05, 0.52, 0.42), "walnut", rounding=0.01),
        block((1.45, 1.84), 0.56, (0.92, 0.54, 0.05), "screen", rounding=0.01),
        block((-1.75, 1.86), 0.0, (0.60, 1.05, 0.28), "walnut"),
        block((2.45, 0.52), 0.98, (0.10, 0.03, 0.12), "metal", rounding=0.01),
    ]


@lru_cache(maxsize=1)
def living_room() -> Scene:
    """A furnished living room of 5 x 4 x 2.6 m: structure for depth and texture for colour in every view."""
    carved = [
        hollow((-2.5, -2.0), (2.5, 2.0), 0.0, 2.6, ("parquet", "plaster", "ceiling")),
        # Well into the room, as the window's: where boxes overlap little, distances in them are short
        hollow((1.5, 0.45), (2.68, 1.35), 0.0, 2.05, ("parquet", "door", "white")),
        hollow((-0.65, 1.0), (0.75, 2.22), 0.88, 1.25, ("oak", "glass", "white")),
    ]
    chairs = [_chair((0.10, -0.42), 10.0), _chair((1.25, 0.15), -75.0), _chair((0.55, 0.98), 168.0)]
    table, table_posts = _table()
    rug = block((0.1, -0.1), 0.0, (2.6, 0.012, 1.9), "rug", turn_deg=4.0)
    plant = [ball((-2.12, -1.62), 0.62, 0.24, "leaf"), ball((-1.98, -1.50), 0.50, 0.16, "leaf")]
    boxes = [
        rug,
        *plant,
        *table,
        *_sofa(),
        *_shelf(),
        *_walls(),
        *_boards(),
        *(s for chair in chairs for s in chair[0]),
    ]
    cylinders = [
        *table_posts,
        *(leg for chair in chairs for leg in chair[1]),
        post((-2.10, -1.60), 0.0, 0.17, 0.34, "clay", 0.01),
        post((-2.10, -1.60), 0.34, 0.025, 0.40, "leaf"),
        post((1.28, -1.62), 0.0, 0.15, 0.03, "metal", 0.01),
        post((1.28, -1.62), 0.03, 0.015, 1.40, "metal"),
        post((1.28, -1.62), 1.38, 0.19, 0.28, "shade", 0.02),
        post((0.2, 0.0), 2.42, 0.20, 0.18, "shade", 0.03),
        post((-1.75, 1.86), 1.05, 0.09, 0.24, "blue", 0.03),
    ]
    lights = [
        ((0.2, 2.2, 0.0), (1.5, 1.42, 1.28)),
        ((0.05, 1.6, 1.7), (0.45, 0.50, 0.60)),
        ((1.28, 1.2, -1.2), (0.3, 0.24, 0.15)),
    ]
    return assemble(PAINTS, carved, boxes, cylinders, lights)
