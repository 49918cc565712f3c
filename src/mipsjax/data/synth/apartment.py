"""An apartment of six furnished rooms round a closed walk. Lengths in metres; places are (x, z)."""

from __future__ import annotations

from functools import lru_cache

from mipsjax.data.synth.build import Place, Solid, assemble, block, hollow, post
from mipsjax.data.synth.furniture import (
    Piece,
    bed,
    bench,
    body,
    casing,
    chair,
    column,
    crate,
    cupboard,
    desk,
    fridge,
    kitchen_run,
    lamp,
    picture,
    pillar,
    plant,
    shelves,
    sofa,
    table,
    together,
)
from mipsjax.data.synth.paints import MORE_PAINTS
from mipsjax.data.synth.scene import Scene

_HEIGHT = 2.6

WALK: tuple[Place, ...] = (
    *((2.7, 4.7), (2.3, 3.5), (3.4, 2.6), (4.8, 2.7)),
    *((6.1, 2.8), (7.4, 2.9), (8.9, 3.5), (10.7, 4.0)),
    *((12.0, 3.7), (13.6, 3.8), (14.0, 4.8), (14.0, 6.1)),
    *((13.9, 7.6), (13.5, 9.3), (12.6, 10.1), (11.3, 10.2)),
    *((9.8, 10.0), (8.2, 9.3), (6.7, 8.6), (5.3, 8.5)),
    *((4.0, 8.4), (2.8, 7.7), (2.6, 6.1)),
)
"""Through every room and every doorway, back to the first."""


def _carved() -> list[Solid]:
    """Six rooms, the doorways between them in the order of the walk, windows.

    Doorways reach well into the rooms: distances in a union of boxes are short where the overlap is thin.
    """
    door = ("parquet", "white", "white")
    return [
        hollow((0.0, 0.0), (6.0, 6.0), 0.0, _HEIGHT, ("parquet", "plaster", "ceiling")),
        hollow((6.2, 0.0), (10.6, 6.0), 0.0, _HEIGHT, ("tiles", "sand", "ceiling")),
        hollow((10.8, 0.0), (16.4, 6.0), 0.0, _HEIGHT, ("carpet", "mint", "ceiling")),
        hollow((11.4, 6.2), (16.4, 12.4), 0.0, _HEIGHT, ("parquet", "rose", "ceiling")),
        hollow((5.4, 6.2), (11.2, 12.4), 0.0, _HEIGHT, ("parquet", "plaster", "ceiling")),
        hollow((0.0, 6.2), (5.2, 12.4), 0.0, _HEIGHT, ("linoleum", "sky", "ceiling")),
        hollow((5.2, 2.2), (7.0, 3.4), 0.0, 2.05, door),
        hollow((9.8, 3.4), (11.6, 4.6), 0.0, 2.05, door),
        hollow((13.4, 5.2), (14.6, 7.0), 0.0, 2.05, door),
        hollow((10.4, 9.6), (12.2, 10.8), 0.0, 2.05, door),
        hollow((4.4, 7.9), (6.2, 9.1), 0.0, 2.05, door),
        hollow((2.0, 5.2), (3.2, 7.0), 0.0, 2.05, door),
        hollow((3.6, -0.22), (5.0, 1.0), 0.88, 1.25, ("oak", "glass", "white")),
        hollow((15.4, 3.5), (16.62, 4.7), 0.80, 1.35, ("oak", "glass", "white")),
        hollow((12.0, 11.4), (13.2, 12.62), 0.90, 1.20, ("oak", "glass", "white")),
        hollow((8.9, 11.4), (10.3, 12.62), 0.60, 1.55, ("oak", "glass", "white")),
        hollow((-0.22, 10.2), (1.0, 11.6), 0.95, 1.10, ("oak", "glass", "white")),
    ]


def _casings() -> Piece:
    """Round each doorway, on the side from which the walk comes."""
    sides = (
        ((6.0, 2.8), -90.0),
        ((10.6, 4.0), -90.0),
        ((14.0, 6.0), 180.0),
        ((11.4, 10.2), 90.0),
        ((5.4, 8.5), 90.0),
        ((2.6, 6.2), 0.0),
    )
    return together(casing(1.2, 2.05).at(place, turn) for place, turn in sides)


def _living_room() -> Piece:
    rug = Piece((block((2.6, 1.8), 0.0, (2.8, 0.012, 1.9), "rug", turn_deg=4.0),))
    return together(
        [
            rug,
            sofa(2.1, "sofa", "pillow").at((1.9, 0.0)),
            table((1.0, 0.42, 0.55), "walnut").at((2.1, 1.55), 6.0),
            lamp(1.65).at((5.55, 0.45)),
            cupboard((1.3, 0.6, 0.42), "walnut", "oak").at((0.0, 2.3), 90.0),
            picture((0.9, 0.55), "screen", bottom=0.75).at((0.0, 2.3), 90.0),
            shelves(1.2, (0.08, 0.5, 0.95, 1.4, 1.95), ("books", "clay", "blue", "books")).at(
                (0.0, 4.1), 90.0
            ),
            sofa(0.95, "leather", "red").at((0.25, 5.75), 135.0),
            plant(1.5).at((0.35, 0.35), 45.0),
            cupboard((1.2, 1.15, 0.45), "oak", "walnut").at((4.5, 6.0), 180.0),
            picture((0.8, 0.6), "abstract", bottom=1.5).at((4.5, 6.0), 180.0),
            body((1.0, 0.62, 0.14), "white").at((6.0, 4.7), -90.0, lift=0.1),
            body((0.8, 0.75, 0.35), "oak", "walnut").at((6.0, 1.3), -90.0),
            crate((0.5, 0.42, 0.5), "leather", 25.0).at((4.0, 4.4)),
            crate((0.45, 0.45, 0.45), "yellow", -30.0).at((1.3, 3.6)),
            crate((0.6, 0.25, 0.6), "green", -10.0).at((4.3, 1.2)),
            picture((0.7, 0.9), "landscape", bottom=1.1).at((6.0, 1.3), -90.0),
            pillar(0.4, 0.3, _HEIGHT).at((5.8, 6.0), 180.0),
        ]
    )


def _kitchen() -> Piece:
    return together(
        [
            kitchen_run(3.1).at((8.6, 0.0)),
            fridge().at((6.2, 1.1), 90.0),
            table((1.3, 0.75, 0.8), "oak", ("red", "yellow")).at((8.5, 5.0), -5.0),
            chair("blue").at((7.5, 4.95), 80.0),
            chair("red").at((9.5, 5.1), -100.0),
            cupboard((1.0, 1.9, 0.40), "sand", "mint").at((6.2, 4.6), 90.0),
            body((0.9, 1.15, 0.55), "walnut", "steel").at((10.6, 2.1), -90.0),
            crate((0.25, 0.3, 0.25), "clay", 10.0).at((10.32, 2.3), lift=1.15),
            pillar(0.3, 0.3, _HEIGHT, "sand").at((10.6, 2.95), -90.0),
            picture((0.6, 0.7), "landscape", bottom=1.5).at((10.6, 1.9), -90.0),
            crate((0.42, 0.34, 0.36), "yellow", 14.0).at((10.2, 0.45)),
            crate((0.30, 0.25, 0.26), "red", -8.0).at((10.22, 0.47), lift=0.34),
            plant(1.1, "blue").at((10.3, 5.75), 215.0),
            body((0.9, 0.55, 0.13), "steel").at((8.5, 6.0), 180.0, lift=0.12),
            picture((0.5, 0.5), "abstract", bottom=1.35).at((8.1, 6.0), 180.0),
        ]
    )


def _study() -> Piece:
    return together(
        [
            desk(1.7, "walnut").at((13.5, 0.0)),
            chair("leather").at((13.2, 1.15), 165.0),
            cupboard((0.9, 1.7, 0.42), "walnut", "white").at((11.5, 0.0)),
            shelves(1.5, (0.08, 0.45, 0.85, 1.25, 1.65, 2.1), ("books", "green", "books", "red", "books")).at(
                (16.4, 2.2), -90.0
            ),
            lamp(1.5).at((15.8, 0.6)),
            sofa(1.7, "green", "yellow").at((12.1, 6.0), 180.0),
            picture((1.1, 0.6), "abstract", bottom=1.35).at((12.1, 6.0), 180.0),
            picture((0.8, 0.7), "landscape").at((10.8, 1.9), 90.0),
            body((1.1, 0.5, 0.14), "white").at((16.4, 4.1), -90.0, lift=0.1),
            plant(1.3).at((16.1, 5.7), 230.0),
            column(0.18, _HEIGHT, "concrete").at((15.2, 6.0), 180.0),
            crate((0.5, 0.4, 0.4), "clay", 20.0).at((15.6, 3.2)),
            table((0.7, 0.5, 0.6), "oak", ("blue", "yellow")).at((12.0, 2.3), 30.0),
        ]
    )


def _bedroom() -> Piece:
    rug = Piece((block((13.4, 8.6), 0.0, (1.5, 0.012, 2.2), "rug", turn_deg=-6.0),))
    return together(
        [
            rug,
            bed(1.55, "sofa").at((16.4, 8.9), -90.0),
            body((0.42, 0.5, 0.4), "walnut").at((16.4, 7.75), -90.0),
            body((0.46, 0.55, 0.4), "walnut").at((16.4, 10.1), -90.0),
            lamp(1.45).at((16.0, 11.9)),
            cupboard((1.9, 2.1, 0.58), "white", "oak").at((14.4, 12.4), 180.0),
            picture((1.2, 0.6), "landscape", bottom=1.45).at((16.4, 8.9), -90.0),
            cupboard((1.1, 0.85, 0.44), "oak", "white").at((11.4, 7.5), 90.0),
            picture((0.7, 0.9), "abstract").at((11.4, 7.5), 90.0),
            body((1.2, 0.6, 0.14), "white").at((15.6, 6.2), 0.0, lift=0.1),
            chair("rose").at((11.9, 11.8), 130.0),
            plant(1.0, "yellow").at((12.3, 6.5), 20.0),
            crate((0.6, 0.45, 0.4), "leather", -12.0).at((14.0, 9.9)),
        ]
    )


def _dining_room() -> Piece:
    chairs = (((7.3, 10.55), -5.0), ((8.5, 10.5), 8.0), ((7.5, 12.0), 175.0), ((6.5, 11.25), 95.0))
    return together(
        [
            table((2.0, 0.75, 0.95), "walnut", ("clay", "red")).at((8.0, 11.25), 2.0),
            *(chair("green").at(place, turn) for place, turn in chairs),
            cupboard((1.9, 0.9, 0.45), "walnut", "walnut").at((8.5, 6.2)),
            picture((1.3, 0.8), "abstract", bottom=1.3).at((8.5, 6.2)),
            bench(1.2, "oak").at((10.3, 6.2)),
            sofa(0.95, "leather", "blue").at((9.5, 7.3), 40.0),
            crate((0.5, 0.42, 0.5), "rose", 15.0).at((10.3, 8.7)),
            column(0.2, _HEIGHT, "plaster").at((6.6, 6.2)),
            shelves(1.1, (0.08, 0.6, 1.1, 1.6), ("clay", "books", "yellow")).at((5.4, 10.6), 90.0),
            cupboard((1.0, 2.0, 0.45), "oak", "oak").at((11.2, 7.9), -90.0),
            plant(1.6, "steel").at((10.9, 12.1), 225.0),
            bench(0.9, "walnut").at((5.4, 7.1), 90.0),
            picture((0.6, 0.6), "landscape").at((5.4, 7.2), 90.0),
            crate((0.35, 0.6, 0.35), "blue", 30.0).at((5.8, 12.0)),
        ]
    )


def _childrens_room() -> Piece:
    rug = Piece((), (post((2.9, 9.6), 0.0, 0.9, 0.015, "yellow"),))
    toys = (("red", (3.6, 10.2), 15.0), ("blue", (3.9, 10.05), 50.0), ("yellow", (3.75, 10.5), -20.0))
    return together(
        [
            rug,
            bed(0.95, "red").at((1.0, 12.4), 180.0),
            desk(1.3, "oak").at((0.0, 8.9), 90.0),
            chair("yellow").at((1.05, 8.85), -80.0),
            shelves(1.3, (0.08, 0.4, 0.75, 1.1), ("green", "red", "books")).at((5.2, 10.9), -90.0),
            cupboard((1.2, 1.8, 0.5), "white", "sky").at((3.3, 12.4), 180.0),
            body((0.9, 0.5, 0.14), "white").at((0.0, 7.3), 90.0, lift=0.1),
            picture((0.8, 0.6), "abstract", bottom=1.3).at((0.0, 7.3), 90.0),
            picture((0.9, 0.5), "landscape", bottom=1.4).at((4.2, 6.2)),
            body((0.9, 0.45, 0.42), "clay").at((4.3, 6.2)),
            plant(0.9, "green").at((0.5, 6.4), 30.0),
            *(crate((0.28, 0.28, 0.28), paint, turn).at(place) for paint, place, turn in toys),
            lamp(1.4).at((4.9, 12.1)),
        ]
    )


@lru_cache(maxsize=1)
def apartment() -> Scene:
    """Six rooms of an apartment of 16.4 x 12.4 x 2.6 m, joined by doorways into a ring."""
    rooms = together(
        [_living_room(), _kitchen(), _study(), _bedroom(), _dining_room(), _childrens_room(), _casings()]
    )
    middles = ((3.0, 3.0), (8.4, 2.6), (13.6, 2.8), (13.8, 9.2), (8.3, 9.6), (2.7, 9.0))
    shades = [post(place, _HEIGHT - 0.2, 0.22, 0.20, "shade", 0.03) for place in middles]
    lights = [((x, 2.2, z), (1.5, 1.42, 1.28)) for x, z in middles]
    return assemble(MORE_PAINTS, _carved(), rooms.boxes, (*rooms.cylinders, *shades), lights)
