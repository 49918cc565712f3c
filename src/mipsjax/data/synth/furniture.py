"""Furniture for larger scenes: each piece stands about the origin and is put into place by `Piece.at`.

Lengths in metres. A piece that stands against a wall has its back in the plane z = 0 and faces +z, sunk into
the wall by `_SINK` so that no two faces share a plane.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from mipsjax.data.synth.build import Place, Solid, Vector, ball, block, post

_SINK = 0.02


class Piece(NamedTuple):
    """Solids that belong together."""

    boxes: tuple[Solid, ...] = ()
    cylinders: tuple[Solid, ...] = ()

    def at(self, place: Place, turn_deg: float = 0.0, lift: float = 0.0) -> Piece:
        """Turned about the origin (0 faces +z, 90 faces +x), then moved there and up by `lift` metres."""
        angle = np.radians(turn_deg)
        cosine, sine = float(np.cos(angle)), float(np.sin(angle))

        def moved(solid: Solid) -> Solid:
            x, y, z = solid.center
            # y is down: what is lifted has less of it
            center = (place[0] + cosine * x + sine * z, y - lift, place[1] + cosine * z - sine * x)
            return solid._replace(center=center, turn_deg=solid.turn_deg + turn_deg)

        return Piece(tuple(map(moved, self.boxes)), tuple(map(moved, self.cylinders)))


def together(pieces: Iterable[Piece]) -> Piece:
    """All solids of some pieces as one."""
    rows = list(pieces)
    return Piece(
        tuple(solid for piece in rows for solid in piece.boxes),
        tuple(solid for piece in rows for solid in piece.cylinders),
    )


def body(size: Vector, material: str, top: str | None = None, rounding: float = 0.0) -> Piece:
    """A plain body against a wall: radiator, box, washing machine. `size` = (width, height, depth)."""
    width, height, depth = size
    middle = (0.0, (depth - _SINK) / 2)
    return Piece((block(middle, 0.0, (width, height, depth + _SINK), material, rounding=rounding, top=top),))


def crate(size: Vector, material: str, turn_deg: float = 0.0) -> Piece:
    """A box on the floor about the origin."""
    return Piece((block((0.0, 0.0), 0.0, size, material, rounding=0.01, turn_deg=turn_deg),))


def cupboard(size: Vector, material: str, front: str) -> Piece:
    """A body with two doors that stand out and a plinth that stands back."""
    width, height, depth = size
    wing = (width / 2 - 0.03, height - 0.16, 0.03)
    doors = [block((side * width / 4, depth), 0.12, wing, front, rounding=0.005) for side in (-1, 1)]
    handles = [
        block((side * 0.05, depth + 0.03), 0.45 * height, (0.02, 0.16, 0.03), "metal") for side in (-1, 1)
    ]
    body = block((0.0, (depth - _SINK) / 2), 0.08, (width, height - 0.08, depth + _SINK), material)
    plinth = block((0.0, depth / 2 - 0.04), 0.0, (width - 0.06, 0.1, depth - 0.08), "metal")
    return Piece((body, plinth, *doors, *handles))


def shelves(width: float, levels: tuple[float, ...], things: tuple[str, ...], depth: float = 0.32) -> Piece:
    """An open shelf with a board at each level, the last one on top, and a thing on each of the others."""
    height, middle = levels[-1], depth / 2 - _SINK
    sides = [block((side * width / 2, middle), 0.0, (0.03, height, depth), "oak") for side in (-1, 1)]
    boards = [block((0.0, middle), level, (width, 0.03, depth), "oak") for level in levels]
    rows = zip(levels[:-1], levels[1:], things, strict=True)
    goods = [
        block(
            ((-1) ** row * 0.12 * width, middle),
            low + 0.03,
            ((0.45 + 0.1 * (row % 3)) * width, min(0.28, 0.75 * (high - low)), 0.7 * depth),
            thing,
            turn_deg=3.0 * row,
        )
        for row, (low, high, thing) in enumerate(rows)
    ]
    return Piece((*sides, *boards, *goods))


def casing(width: float, height: float) -> Piece:
    """Round an opening of that size in a wall."""
    wide, thick = 0.12, 0.07
    post_size, head_size = (wide, height, thick + _SINK), (width + 2 * wide, wide, thick + _SINK)
    middle = (thick - _SINK) / 2
    posts = [block((side * (width + wide) / 2, middle), 0.0, post_size, "white") for side in (-1, 1)]
    return Piece((*posts, block((0.0, middle), height, head_size, "white")))


def picture(size: tuple[float, float], material: str, bottom: float = 1.2, thick: float = 0.06) -> Piece:
    """A board on the wall, (width, height), standing out by its thickness."""
    return Piece((block((0.0, thick / 2), bottom, (size[0], size[1], thick), material),))


def pillar(width: float, depth: float, height: float, material: str = "plaster") -> Piece:
    """A pilaster from the floor to the ceiling."""
    return Piece((block((0.0, depth / 2), 0.0, (width, height, depth), material),))


def column(radius: float, height: float, material: str) -> Piece:
    """A round pillar half in the wall."""
    return Piece((), (post((0.0, radius / 2), 0.0, radius, height, material),))


def plant(height: float, pot: str = "clay") -> Piece:
    """A pot with a stem and two crowns."""
    radius = 0.13 + 0.04 * height
    crowns = (
        ball((0.02, 0.26), 0.62 * height, 0.22 * height, "leaf"),
        ball((-0.10, 0.30), 0.45 * height, 0.15 * height, "leaf"),
    )
    stems = (
        post((0.0, 0.26), 0.0, radius, 0.34 * height, pot, 0.01),
        post((0.0, 0.26), 0.3 * height, 0.03, 0.4 * height, "walnut"),
    )
    return Piece(crowns, stems)


def lamp(height: float = 1.6) -> Piece:
    """A standing lamp about the origin."""
    return Piece(
        (),
        (
            post((0.0, 0.0), 0.0, 0.15, 0.03, "metal", 0.01),
            post((0.0, 0.0), 0.03, 0.018, height - 0.3, "metal"),
            post((0.0, 0.0), height - 0.3, 0.19, 0.28, "shade", 0.02),
        ),
    )


def bench(width: float, material: str) -> Piece:
    """A seat on two blocks."""
    legs = [block((side * (width / 2 - 0.15), 0.22), 0.0, (0.10, 0.42, 0.34), "metal") for side in (-1, 1)]
    return Piece((block((0.0, 0.22), 0.42, (width, 0.07, 0.44), material, rounding=0.02), *legs))


def sofa(width: float, material: str, pillow: str) -> Piece:
    """Seat, back, two arms and a pillow."""
    arm = (width - 0.22) / 2
    return Piece(
        (
            block((0.0, 0.45), 0.08, (width, 0.34, 0.86), material, rounding=0.03),
            block((0.0, 0.12), 0.30, (width, 0.54, 0.24), material, rounding=0.07),
            *(
                block((side * arm, 0.45), 0.08, (0.22, 0.52, 0.88), material, rounding=0.06)
                for side in (-1, 1)
            ),
            block((0.25 * width, 0.36), 0.44, (0.42, 0.38, 0.13), pillow, rounding=0.06, turn_deg=-20.0),
        )
    )


def bed(width: float, blanket: str) -> Piece:
    """Head at the wall."""
    return Piece(
        (
            block((0.0, 0.03), 0.0, (width + 0.1, 1.0, 0.10), "walnut", rounding=0.01),
            block((0.0, 1.05), 0.12, (width, 0.22, 2.0), "walnut", rounding=0.01),
            block((0.0, 1.02), 0.34, (width - 0.06, 0.18, 1.92), "white", rounding=0.06),
            block((0.0, 1.35), 0.42, (width + 0.02, 0.14, 1.25), blanket, rounding=0.06),
            *(
                block((side * width / 4, 0.34), 0.50, (0.55, 0.14, 0.38), "pillow", rounding=0.06)
                for side in (-1, 1)
            ),
        )
    )


def table(size: Vector, material: str, things: tuple[str, ...] = ("blue", "green")) -> Piece:
    """About the origin, with a box and a ball on it. `size` = (width, height, depth)."""
    width, height, depth = size
    top = block((0.0, 0.0), height - 0.04, (width, 0.04, depth), material, rounding=0.01)
    goods = (
        block((0.2 * width, 0.1 * depth), height, (0.28, 0.09, 0.2), things[0], turn_deg=25.0),
        ball((-0.2 * width, -0.1 * depth), height, 0.09, things[1]),
    )
    legs = tuple(
        post((side * (width / 2 - 0.08), end * (depth / 2 - 0.08)), 0.0, 0.035, height - 0.02, material)
        for side in (-1, 1)
        for end in (-1, 1)
    )
    return Piece((top, *goods), legs)


def chair(seat: str) -> Piece:
    """About the origin."""
    legs = tuple(post((x, z), 0.0, 0.02, 0.43, "oak") for x in (-0.18, 0.18) for z in (-0.18, 0.18))
    return Piece(
        (
            block((0.0, 0.0), 0.42, (0.44, 0.05, 0.44), seat, rounding=0.015),
            block((0.0, -0.20), 0.50, (0.42, 0.40, 0.035), "oak", rounding=0.01),
        ),
        legs,
    )


def desk(width: float, material: str) -> Piece:
    """Against a wall, with drawers on one side, a leg on the other, and a screen on it."""
    return Piece(
        (
            block((0.0, 0.36), 0.71, (width, 0.04, 0.72), material, rounding=0.01),
            block((0.3 * width, 0.36), 0.0, (0.36 * width, 0.71, 0.62), "white"),
            block((-width / 2 + 0.05, 0.36), 0.0, (0.05, 0.71, 0.62), material),
            block((-0.1 * width, 0.22), 0.86, (0.56, 0.34, 0.05), "screen", rounding=0.01),
            block((-0.1 * width, 0.22), 0.75, (0.10, 0.14, 0.10), "metal"),
            block((0.34 * width, 0.30), 0.75, (0.22, 0.26, 0.28), "books", turn_deg=15.0),
        )
    )


def kitchen_run(width: float) -> Piece:
    """Lower cabinets with a worktop, a hood, wall cabinets on both sides of it, and pots."""
    half = width / 2
    return Piece(
        (
            block((0.0, 0.28), 0.10, (width, 0.76, 0.60), "white"),
            block((0.0, 0.26), 0.0, (width - 0.04, 0.12, 0.50), "metal"),
            block((0.0, 0.30), 0.86, (width + 0.02, 0.04, 0.66), "walnut", rounding=0.005),
            *(
                block((x, 0.59), 0.30, (0.03, 0.03, 0.03), "metal")
                for x in (-0.7 * half, -0.25 * half, 0.25 * half, 0.7 * half)
            ),
            block((-0.62 * half, 0.15), 1.45, (0.70 * half, 0.70, 0.34), "white"),
            block((0.66 * half, 0.15), 1.45, (0.62 * half, 0.70, 0.34), "yellow"),
            block((0.06 * half, 0.20), 1.55, (0.50, 0.18, 0.44), "metal", rounding=0.02),
            block((0.06 * half, 0.12), 1.73, (0.26, 0.90, 0.26), "metal"),
            block((-0.7 * half, 0.25), 0.90, (0.30, 0.28, 0.20), "red", turn_deg=12.0),
        ),
        (
            post((0.06 * half, 0.30), 0.90, 0.11, 0.14, "steel", 0.01),
            post((0.55 * half, 0.25), 0.90, 0.07, 0.30, "green", 0.02),
        ),
    )


def fridge() -> Piece:
    """Two doors with handles."""
    return Piece(
        (
            block((0.0, 0.30), 0.03, (0.62, 1.85, 0.64), "steel", rounding=0.02),
            block((0.0, 0.63), 0.05, (0.58, 0.60, 0.05), "steel", rounding=0.01),
            block((0.0, 0.63), 0.70, (0.58, 1.14, 0.05), "steel", rounding=0.01),
            block((-0.22, 0.68), 0.40, (0.03, 0.20, 0.05), "metal"),
            block((-0.22, 0.68), 0.85, (0.03, 0.40, 0.05), "metal"),
        )
    )
