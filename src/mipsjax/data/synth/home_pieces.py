"""What stands and hangs in a drawn home: each thing with the space it takes. Lengths in metres.

A thing has its back in the plane z = 0 about x = 0 and faces +z, as the pieces of `furniture` that stand
against a wall.
"""

from __future__ import annotations

from typing import NamedTuple

from mipsjax.data.synth.build import Vector, ball, block, post
from mipsjax.data.synth.draws import Draws
from mipsjax.data.synth.furniture import (
    Piece,
    bed,
    bench,
    body,
    chair,
    crate,
    cupboard,
    desk,
    fridge,
    kitchen_run,
    lamp,
    picture,
    plant,
    shelves,
    sofa,
    table,
    together,
)

_COLORS = ("red", "blue", "green", "yellow", "clay", "steel", "mint", "rose", "leather")
_WOODS = ("oak", "walnut", "white")


class Thing(NamedTuple):
    """A piece and its size."""

    piece: Piece
    size: Vector
    """Width, height and depth."""
    bottom: float = 0.0
    """Height of its lower end above the floor."""


def things(use: str, draws: Draws) -> list[Thing]:
    """What belongs into a room of that use, what matters most first."""
    match use:
        case "living":
            chosen = [_sofa, _bookcase, _low_table, _cupboard, _armchair, _lamp, _plant]
        case "kitchen":
            chosen = [_kitchen, _fridge, _dining_set, _sideboard, _stool, _plant]
        case "bedroom":
            chosen = [_bed, _cupboard, _sideboard, _rail, _chair, _lamp]
        case "study":
            chosen = [_desk, _bookcase, _chair, _cupboard, _bookcase, _plant]
        case "dining":
            chosen = [_dining_set, _sideboard, _cupboard, _lamp, _plant, _bench]
        case "store":
            chosen = [_rack, _cupboard, _rack, _rail, _crates, _crates]
        case _:
            chosen = [_picture, _narrow, _narrow]
    clutter = [] if use == "corridor" else [_crates, _ball, _stool, _radiator]
    wall = [_picture] * draws.pick((0, 1, 2, 3))
    return [make(draws) for make in (*chosen, *draws.shuffled(clutter)[:3], *wall)]


def pendant(height: float, material: str) -> Piece:
    """A lamp on a cord, from a ceiling of that height."""
    return Piece(
        (),
        (
            post((0.0, 0.0), height - 0.22, 0.008, 0.22, "metal"),
            post((0.0, 0.0), height - 0.40, 0.19, 0.18, material, 0.02),
        ),
    )


# Seats, beds and tables


def _sofa(draws: Draws) -> Thing:
    width = draws.between(1.5, 2.1)
    cover, pillow = draws.pick(("sofa", "leather", "green", "steel")), draws.pick(("pillow", "red", "yellow"))
    return Thing(sofa(width, cover, pillow), (width, 0.84, 0.90))


def _armchair(draws: Draws) -> Thing:
    return Thing(sofa(0.95, draws.pick(_COLORS), draws.pick(("pillow", "red", "blue"))), (0.95, 0.84, 0.90))


def _bed(draws: Draws) -> Thing:
    width = draws.pick((0.95, 1.2, 1.5))
    return Thing(bed(width, draws.pick(("sofa", "red", "mint", "rose", "sky"))), (width + 0.1, 1.0, 2.06))


def _bench(draws: Draws) -> Thing:
    width = draws.between(0.9, 1.3)
    return Thing(bench(width, draws.pick(_WOODS)), (width, 0.5, 0.45))


def _chair(draws: Draws) -> Thing:
    turn = draws.between(-25.0, 25.0)
    return Thing(chair(draws.pick(_COLORS)).at((0.0, 0.33), turn), (0.6, 0.9, 0.62))


def _stool(draws: Draws) -> Thing:
    """A round seat on four rods."""
    height = draws.between(0.42, 0.62)
    rods = [post((x, 0.25 + z), 0.0, 0.012, height, "metal") for x in (-0.12, 0.12) for z in (-0.12, 0.12)]
    seat = post((0.0, 0.25), height, 0.19, 0.04, draws.pick(_COLORS), 0.01)
    return Thing(Piece((), (*rods, seat)), (0.4, height + 0.04, 0.45))


def _low_table(draws: Draws) -> Thing:
    width, depth = draws.between(0.7, 1.0), draws.between(0.45, 0.6)
    piece = table((width, 0.42, depth), draws.pick(_WOODS), (draws.pick(_COLORS), draws.pick(_COLORS)))
    return Thing(piece.at((0.0, depth / 2 + 0.05)), (width, 0.6, depth + 0.08))


def _dining_set(draws: Draws) -> Thing:
    """A table near the wall with a chair at one end and one or two in front."""
    width, paint = draws.between(0.9, 1.3), draws.pick(_COLORS)
    board = table((width, 0.74, 0.75), draws.pick(_WOODS), (draws.pick(_COLORS), draws.pick(_COLORS)))
    chairs = [chair(paint).at((width / 2 + 0.15, 0.42), -90.0 + draws.between(-12.0, 12.0))]
    for x in (-0.25 * width, 0.25 * width):
        if draws.chance(0.6):
            chairs.append(chair(paint).at((x, 0.95), 180.0 + draws.between(-12.0, 12.0)))
    return Thing(together([board.at((0.0, 0.40)), *chairs]), (width + 0.8, 0.95, 1.2))


def _desk(draws: Draws) -> Thing:
    width = draws.between(1.2, 1.6)
    seat = chair(draws.pick(_COLORS)).at((-0.15 * width, 0.92), 180.0 + draws.between(-20.0, 20.0))
    return Thing(together([desk(width, draws.pick(_WOODS)), seat]), (width, 1.2, 1.2))


# Cupboards, shelves and machines


def _cupboard(draws: Draws) -> Thing:
    size = (draws.between(0.8, 1.6), draws.between(1.6, 2.1), draws.between(0.4, 0.6))
    return Thing(cupboard(size, draws.pick(_WOODS), draws.pick((*_WOODS, "mint", "sky"))), size)


def _sideboard(draws: Draws) -> Thing:
    size = (draws.between(0.7, 1.4), draws.between(0.6, 0.95), draws.between(0.36, 0.46))
    pot = post((draws.between(-0.2, 0.2), 0.2), size[1], 0.07, draws.between(0.15, 0.3), draws.pick(_COLORS))
    front = cupboard(size, draws.pick(_WOODS), draws.pick(_WOODS))
    return Thing(together([front, Piece((), (pot,))]), (size[0], size[1] + 0.3, size[2]))


def _narrow(draws: Draws) -> Thing:
    """What fits along the wall of a corridor."""
    size = (draws.between(0.6, 1.0), draws.between(0.75, 1.1), 0.2)
    return Thing(body(size, draws.pick(_WOODS), draws.pick(_WOODS)), size)


def _bookcase(draws: Draws) -> Thing:
    """Boards with rows of books of a few colours and heights."""
    width, height, depth = draws.between(0.8, 1.3), draws.between(1.3, 2.1), 0.3
    wood = draws.pick(_WOODS)
    sides = [block((s * width / 2, 0.14), 0.0, (0.03, height, depth), wood) for s in (-1, 1)]
    back = block((0.0, 0.0), 0.06, (width, height - 0.06, 0.03), wood)
    count = 4 if height > 1.7 else 3
    pitch = (height - 0.08) / count
    boards = [block((0.0, 0.14), 0.05 + row * pitch, (width, 0.03, depth), wood) for row in range(count + 1)]
    books = []
    for row in range(count):
        left = -width / 2 + 0.03
        while left < width / 2 - 0.3:
            wide = draws.between(0.12, 0.38)
            tall = draws.between(0.55, 0.85) * pitch
            paint = draws.pick(("books", "red", "blue", "green", "leather", "clay", "sand"))
            books.append(block((left + wide / 2, 0.13), 0.08 + row * pitch, (wide, tall, 0.2), paint))
            left += wide + draws.pick((0.01, 0.01, 0.15))
    return Thing(Piece((*sides, back, *boards, *books)), (width + 0.06, height + 0.02, depth))


def _rack(draws: Draws) -> Thing:
    width, things = draws.between(0.9, 1.4), tuple(draws.pick(_COLORS) for _ in range(4))
    levels = (0.10, 0.55, 1.0, 1.4, 1.75)
    return Thing(shelves(width, levels, things, depth=0.38), (width + 0.05, 1.8, 0.38))


def _rail(draws: Draws) -> Thing:
    """Clothes on a rod between two others."""
    width = draws.between(0.8, 1.2)
    ends = [post((side * width / 2, 0.25), 0.0, 0.015, 1.55, "metal") for side in (-1, 1)]
    feet = [block((side * width / 2, 0.25), 0.0, (0.04, 0.03, 0.45), "metal") for side in (-1, 1)]
    rod = block((0.0, 0.25), 1.54, (width, 0.025, 0.025), "metal")
    places = [-0.4 * width + 0.16 * row for row in range(int(0.8 * width / 0.16))]
    clothes = [
        block((x, 0.25), 0.65, (0.05, 0.86, 0.4), draws.pick(_COLORS), turn_deg=draws.between(-12.0, 12.0))
        for x in places
        if draws.chance(0.7)
    ]
    return Thing(Piece((*feet, rod, *clothes), tuple(ends)), (width + 0.08, 1.6, 0.5))


def _kitchen(draws: Draws) -> Thing:
    width = draws.pick((1.9, 2.3, 2.7))
    return Thing(kitchen_run(width), (width, 2.4, 0.66))


def _fridge(draws: Draws) -> Thing:
    return Thing(fridge(), (0.64, 1.9, 0.74))


# Small things


def _lamp(draws: Draws) -> Thing:
    height = draws.between(1.3, 1.7)
    return Thing(lamp(height).at((0.0, 0.22)), (0.42, height, 0.42))


def _plant(draws: Draws) -> Thing:
    height = draws.between(0.7, 1.5)
    wide = 0.2 + 0.5 * height
    return Thing(plant(height, draws.pick(("clay", "blue", "white"))), (wide, height + 0.1, wide))


def _crates(draws: Draws) -> Thing:
    """One box on another."""
    wide, high = draws.between(0.3, 0.45), draws.between(0.25, 0.4)
    low = crate((wide, high, 0.32), draws.pick(_COLORS), draws.between(-15.0, 15.0)).at((0.0, 0.25))
    small = crate((0.24, 0.2, 0.2), draws.pick(_COLORS), draws.between(-30.0, 30.0))
    return Thing(together([low, small.at((0.02, 0.25), lift=high)]), (wide + 0.1, high + 0.2, 0.48))


def _ball(draws: Draws) -> Thing:
    radius = draws.between(0.1, 0.17)
    return Thing(Piece((ball((0.0, radius + 0.02), 0.0, radius, draws.pick(_COLORS)),)), (0.36, 0.34, 0.36))


def _radiator(draws: Draws) -> Thing:
    width = draws.between(0.7, 1.2)
    return Thing(body((width, 0.55, 0.12), "white").at((0.0, 0.0), lift=0.1), (width, 0.66, 0.12))


def _picture(draws: Draws) -> Thing:
    width, height, bottom = draws.between(0.4, 1.0), draws.between(0.35, 0.8), draws.between(1.15, 1.4)
    board = picture((width, height), draws.pick(("abstract", "landscape")), bottom=bottom, thick=0.04)
    return Thing(board, (width, height, 0.05), bottom)
