"""Corridors along a line of straight legs, furnished along their walls. Lengths in metres, places (x, z).

Furniture is drawn: what stands where, and how large. A sequence needs fixtures every metre or so on both
sides, because a bare corridor looks the same from everywhere along it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from mipsjax.data.synth.build import Place, Solid, assemble, hollow
from mipsjax.data.synth.furniture import (
    Piece,
    bench,
    body,
    column,
    crate,
    cupboard,
    picture,
    pillar,
    plant,
    shelves,
    together,
)
from mipsjax.data.synth.paints import MORE_PAINTS
from mipsjax.data.synth.scene import Scene

_WIDTH, _HEIGHT = 2.4, 2.6
# Metres along a wall from the middle of one fixture to that of the next: the least, and the range above it
_SPACING, _SPACING_RANGE = 1.4, 0.6
# Metres at the ends of a leg kept free of fixtures on the side walls, for the corner
_CORNER = 0.5 * _WIDTH + 0.5
# A lamp of the ceiling every so many metres
_LIGHT_EVERY = 4.5
_COLORS = ("red", "blue", "green", "yellow", "oak", "walnut", "clay", "steel", "white", "mint")
_KINDS = ("cupboard", "door", "pillar", "picture", "bench", "plant", "radiator", "column", "crates", "shelf")

RING: tuple[Place, ...] = ((0.0, 0.0), (0.0, 12.0), (20.5, 12.0), (20.5, 0.0))
"""Corners of the middle line of `corridor_loop`, 65 m round."""
STAIR: tuple[Place, ...] = ((0.0, 0.0), (0.0, 11.0), (11.0, 11.0), (11.0, 22.0), (24.0, 22.0))
"""Corners of the middle line of `winding_corridor`, 46 m, which goes on in two directions by turns."""


class Leg(NamedTuple):
    """A straight piece of corridor."""

    start: Place
    heading: Place
    """Unit vector along one of the axes."""
    length: float

    def point(self, along: float, right: float) -> Place:
        """Metres along the middle line, and to the right of it."""
        (x, z), (dx, dz) = self.start, self.heading
        return x + along * dx + right * dz, z + along * dz - right * dx

    def turn_deg(self, side: float) -> float:
        """For `Piece.at`: facing the middle line from the right (1), the left (-1) or the end (0)."""
        dx, dz = self.heading
        facing = (-dx, -dz) if side == 0 else (-side * dz, side * dx)
        return float(np.degrees(np.arctan2(*facing)))


class Fixture(NamedTuple):
    """Something along a wall, before it is made."""

    kind: str
    along: float
    side: float
    """1 on the right, -1 on the left."""
    sizes: tuple[float, float]
    """In 0..1: from the smallest to the largest of its kind."""
    color: str


def legs(corners: Sequence[Place], closed: bool) -> list[Leg]:
    """The legs between corners, of which neighbours differ in one coordinate."""
    pairs = zip(corners, (*corners[1:], *corners[: int(closed)]), strict=False)
    found = []
    for (x0, z0), (x1, z1) in pairs:
        length = float(np.hypot(x1 - x0, z1 - z0))
        found.append(Leg((x0, z0), ((x1 - x0) / length, (z1 - z0) / length), length))
    return found


def _drawn(leg: Leg, rng: np.random.Generator) -> list[Fixture]:
    """Fixtures along both walls; no kind comes again on its wall before all others have come."""
    found = []
    for side in (1.0, -1.0):
        along, kinds = _CORNER + _SPACING_RANGE * rng.random(), list[str]()
        while along < leg.length - _CORNER:
            kinds = kinds or [_KINDS[row] for row in np.argsort(rng.random(len(_KINDS)))]
            color = _COLORS[int(rng.random() * len(_COLORS))]
            found.append(Fixture(kinds.pop(), along, side, (rng.random(), rng.random()), color))
            along += _SPACING + _SPACING_RANGE * rng.random()
    return found


def _varied(fixtures: Iterable[Fixture], rng: np.random.Generator) -> list[Fixture]:
    """The same kinds in the same order, up to 0.12 m aside and of other sizes."""
    return [
        fixture._replace(
            along=fixture.along + 0.24 * (rng.random() - 0.5),
            sizes=(0.6 * fixture.sizes[0] + 0.4 * rng.random(), 0.6 * fixture.sizes[1] + 0.4 * rng.random()),
        )
        for fixture in fixtures
    ]


def _within(leg: Leg, fixtures: Iterable[Fixture]) -> list[Fixture]:
    """Those that the leg is long enough for."""
    return [fixture for fixture in fixtures if fixture.along < leg.length - _CORNER]


def _piece(fixture: Fixture) -> Piece:
    """What stands out of the wall there."""
    (a, b), color = fixture.sizes, fixture.color
    art = "abstract" if a > b else "landscape"
    match fixture.kind:
        case "cupboard":
            return cupboard((0.7 + 0.5 * a, 0.9 + 1.1 * b, 0.30 + 0.1 * a), "white", color)
        case "pillar":
            return pillar(0.25 + 0.35 * a, 0.14 + 0.2 * b, _HEIGHT, "concrete")
        case "picture":
            return picture((0.5 + 0.5 * a, 0.4 + 0.5 * b), art, bottom=1.1 + 0.3 * a, thick=0.05 + 0.05 * b)
        case "bench":
            above = picture((0.4 + 0.4 * b, 0.4 + 0.3 * a), art, bottom=1.25)
            return together([bench(0.9 + 0.5 * a, color), above])
        case "plant":
            return plant(0.9 + 0.7 * a, color)
        case "radiator":
            low = body((0.7 + 0.5 * a, 0.45 + 0.25 * b, 0.14), "white").at((0.0, 0.0), lift=0.12)
            return together([low, body((0.8 + 0.5 * a, 0.04, 0.22), color).at((0.0, 0.0), lift=0.95)])
        case "column":
            return column(0.14 + 0.12 * a, _HEIGHT, color)
        case "crates":
            wide, high = 0.35 + 0.2 * a, 0.3 + 0.25 * b
            small = crate((0.7 * wide, 0.8 * high, 0.26), "clay", -12.0 + 24.0 * b)
            low = crate((wide, high, 0.34), color, 20.0 * (a - 0.5))
            return together([low.at((0.0, 0.22)), small.at((0.02, 0.2), lift=high)])
        case "shelf":
            levels = (0.08, 0.45 + 0.1 * a, 0.95, 1.3 + 0.4 * b)
            return shelves(0.6 + 0.4 * a, levels, ("books", color, "clay"), depth=0.30)
        case _:
            # A door is set back: nothing of it stands out, and `_recess` carves its niche
            return Piece()


def _recess(leg: Leg, fixture: Fixture) -> Solid:
    """The niche of a door."""
    (a, b), right = fixture.sizes, fixture.side * _WIDTH / 2
    half, depth = 0.42 + 0.15 * a, 0.16 + 0.25 * b
    # Well into the corridor: where boxes overlap little, distances in them are short
    inner = leg.point(fixture.along - half, right - 0.4 * fixture.side)
    outer = leg.point(fixture.along + half, right + depth * fixture.side)
    low, high = np.minimum(inner, outer), np.maximum(inner, outer)
    faces = ("linoleum", "door" if a > b else fixture.color, "white")
    return hollow((low[0], low[1]), (high[0], high[1]), 0.0, 2.0 + 0.15 * a, faces)


def _hall(leg: Leg, faces: tuple[str, str, str]) -> Solid:
    """The free space of a leg, with the squares of the corners at both ends."""
    ends = [
        leg.point(-_WIDTH / 2, -_WIDTH / 2),
        leg.point(leg.length + _WIDTH / 2, _WIDTH / 2),
    ]
    low, high = np.min(ends, axis=0), np.max(ends, axis=0)
    return hollow((low[0], low[1]), (high[0], high[1]), 0.0, _HEIGHT, faces)


def _furnished(
    halls: Sequence[tuple[Leg, Sequence[Fixture], str]], ends: Sequence[tuple[Piece, ...]]
) -> Scene:
    """Legs with their fixtures and the paint of their walls; `ends` stand at the end of each leg."""
    carved = [_hall(leg, ("linoleum", paint, "ceiling")) for leg, _, paint in halls]
    pieces, lights = list[Piece](), []
    for (leg, fixtures, _), group in zip(halls, ends, strict=True):
        carved += [_recess(leg, fixture) for fixture in fixtures if fixture.kind == "door"]
        for fixture in fixtures:
            wall = leg.point(fixture.along, fixture.side * _WIDTH / 2)
            pieces.append(_piece(fixture).at(wall, leg.turn_deg(fixture.side)))
        for piece, right in zip(group, (-0.65, 0.5), strict=True):
            wall = leg.point(leg.length + _WIDTH / 2, right)
            pieces.append(piece.at(wall, leg.turn_deg(0)))
        for along in np.arange(0.0, leg.length, _LIGHT_EVERY):
            x, z = leg.point(float(along) + 0.5 * _LIGHT_EVERY, 0.0)
            lights.append(((x, 2.3, z), (1.25, 1.2, 1.1)))
    all_of_them = together(pieces)
    return assemble(MORE_PAINTS, carved, all_of_them.boxes, all_of_them.cylinders, lights)


@lru_cache(maxsize=1)
def corridor_loop() -> Scene:
    """A rectangle of corridors 2.4 m wide and 65 m round, all different along the way."""
    rng = np.random.default_rng(7)
    halls = [
        (leg, _drawn(leg, rng), paint)
        for leg, paint in zip(legs(RING, closed=True), ("plaster", "mint", "sand", "sky"), strict=True)
    ]
    ends = [
        (plant(1.4), picture((0.8, 0.6), "landscape")),
        (cupboard((0.7, 1.9, 0.35), "white", "blue"), column(0.16, _HEIGHT, "clay")),
        (shelves(0.8, (0.08, 0.6, 1.1, 1.5), ("books", "green", "red")), picture((0.6, 0.8), "abstract")),
        (pillar(0.4, 0.3, _HEIGHT, "concrete"), plant(1.1, "blue")),
    ]
    return _furnished(halls, ends)


@lru_cache(maxsize=1)
def winding_corridor() -> Scene:
    """Four legs, of 11 m and more, never met again, which look alike: nearly the same fixtures in each."""
    rng = np.random.default_rng(11)
    stretches = legs(STAIR, closed=False)
    pattern = _drawn(max(stretches, key=lambda leg: leg.length), rng)
    halls = [(leg, _within(leg, _varied(pattern, rng)), "plaster") for leg in stretches]
    ends = [
        (plant(1.1 + 0.1 * row), picture((0.7 + 0.08 * row, 0.6), "landscape"))
        for row in range(len(stretches))
    ]
    return _furnished(halls, ends)
