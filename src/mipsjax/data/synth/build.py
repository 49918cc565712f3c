"""Scenes put together from furniture-sized solids.

Lengths in metres; a place is (x, z) on the floor and heights are above the floor.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jaxtyping import Array, Float

from mipsjax.data.synth.scene import Lights, Scene, Shapes
from mipsjax.data.synth.texture import Materials

RGB = tuple[float, float, float]
"""Linear colour."""
Vector = tuple[float, float, float]
"""Metres along x, up or down, and along z."""
Place = tuple[float, float]
"""Metres along x and z on the floor."""


class Paint(NamedTuple):
    """One material; see `Materials`."""

    dark: RGB
    bright: RGB
    frequency: Vector
    weights: tuple[float, float, float, float, float]


class Solid(NamedTuple):
    """One shape; see `Shapes`."""

    center: Vector
    half: Vector
    rounding: float
    turn_deg: float
    material: tuple[str, str, str]


def block(
    place: Place,
    bottom: float,
    size: Vector,
    material: str,
    *,
    rounding: float = 0.0,
    turn_deg: float = 0.0,
    top: str | None = None,
) -> Solid:
    """A box on a place, `size` = (along x, height, along z) before the turn."""
    center = (place[0], -(bottom + size[1] / 2), place[1])
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Solid(center, half, rounding, turn_deg, (top or material, material, material))


def post(
    place: Place,
    bottom: float,
    radius: float,
    height: float,
    material: str,
    rounding: float = 0.0,
) -> Solid:
    """An upright cylinder."""
    center = (place[0], -(bottom + height / 2), place[1])
    return Solid(center, (radius, height / 2, radius), rounding, 0.0, (material, material, material))


def ball(place: Place, bottom: float, radius: float, material: str) -> Solid:
    """A sphere."""
    return block(place, bottom, (2 * radius, 2 * radius, 2 * radius), material, rounding=radius)


def hollow(
    low: Place,
    high: Place,
    bottom: float,
    height: float,
    faces: tuple[str, str, str],
) -> Solid:
    """Free space between two places, with the materials of its floor, walls and ceiling."""
    middle = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    size = (high[0] - low[0], height, high[1] - low[1])
    return block(middle, bottom, size, faces[1])._replace(material=faces)


def assemble(
    paints: Mapping[str, Paint],
    carved: Sequence[Solid],
    boxes: Sequence[Solid],
    cylinders: Sequence[Solid],
    lights: Sequence[tuple[Vector, RGB]],
    glows: Mapping[str, float] | None = None,
) -> Scene:
    """The scene of these solids, with materials named as in `paints`.

    `lights` are pairs of position (x, height, z) and colour, `glows` the light that shines through those
    materials which are glass. At least one solid must be carved.
    """
    low = np.min([np.subtract(solid.center, solid.half) for solid in carved], axis=0)
    high = np.max([np.add(solid.center, solid.half) for solid in carved], axis=0)
    position = np.array([(x, -height, z) for (x, height, z), _ in lights]).reshape(-1, 3)  # y is down
    color = np.array([rgb for _, rgb in lights]).reshape(-1, 3)
    # Real arrays even when the first use of a cached scene is inside a traced function
    with jax.ensure_compile_time_eval():
        return Scene(
            carved=_shapes(paints, carved),
            boxes=_shapes(paints, boxes),
            cylinders=_shapes(paints, cylinders),
            materials=Materials(*(_floats(column) for column in zip(*paints.values(), strict=True))),
            lights=Lights(_floats(position), _floats(color)),
            bounds=_floats([low, high]),
            glow=_floats([glows.get(name, 0.0) for name in paints]) if glows else None,
        )


def _floats(values: npt.ArrayLike) -> Float[Array, "..."]:
    return jnp.asarray(np.asarray(values), jnp.float32)


def _shapes(paints: Mapping[str, Paint], solids: Iterable[Solid]) -> Shapes:
    rows, number = list(solids), {name: row for row, name in enumerate(paints)}
    turn = np.radians([solid.turn_deg for solid in rows])
    return Shapes(
        center=_floats(np.array([solid.center for solid in rows]).reshape(-1, 3)),
        half=_floats(np.array([solid.half for solid in rows]).reshape(-1, 3)),
        rounding=_floats([solid.rounding for solid in rows]),
        turn=_floats(np.stack([np.cos(turn), np.sin(turn)], axis=-1)),
        material=jnp.asarray(
            np.array([[number[name] for name in solid.material] for solid in rows], np.int32).reshape(-1, 3)
        ),
    )
