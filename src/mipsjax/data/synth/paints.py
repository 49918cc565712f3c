"""Materials of the larger scenes: those of the living room and more."""

from __future__ import annotations

from mipsjax.data.synth.build import Paint
from mipsjax.data.synth.rooms import PAINTS

_NOISE, _CHECKS, _STRIPES = (1.0, 0.0, 0.0, 0.0, 0.0), (0.3, 0.7, 0.0, 0.0, 0.0), (0.6, 0.0, 0.4, 0.0, 0.0)

# A table of its own, so that the living room keeps its compiled code and its bits
MORE_PAINTS: dict[str, Paint] = {
    **PAINTS,
    "tiles": Paint((0.30, 0.36, 0.40), (0.80, 0.82, 0.80), (1.7, 0.0, 1.7), _CHECKS),
    "carpet": Paint((0.07, 0.10, 0.17), (0.27, 0.32, 0.42), (6.0, 6.0, 6.0), _NOISE),
    "linoleum": Paint((0.25, 0.29, 0.22), (0.52, 0.56, 0.44), (3.0, 3.0, 3.0), _NOISE),
    "concrete": Paint((0.30, 0.30, 0.31), (0.58, 0.57, 0.55), (2.5, 2.5, 2.5), _NOISE),
    "mint": Paint((0.34, 0.50, 0.42), (0.60, 0.76, 0.66), (4.0, 4.0, 4.0), _NOISE),
    "rose": Paint((0.56, 0.36, 0.34), (0.84, 0.66, 0.62), (4.0, 4.0, 4.0), _NOISE),
    "sand": Paint((0.56, 0.47, 0.30), (0.84, 0.76, 0.56), (4.0, 4.0, 4.0), _NOISE),
    "sky": Paint((0.34, 0.44, 0.56), (0.62, 0.72, 0.84), (3.5, 3.5, 3.5), _STRIPES),
    "yellow": Paint((0.60, 0.38, 0.04), (0.90, 0.72, 0.16), (8.0, 8.0, 8.0), _NOISE),
    "steel": Paint((0.42, 0.44, 0.47), (0.72, 0.74, 0.76), (3.0, 9.0, 3.0), _NOISE),
}

_PLAIN, _BOARDS = (0.0, 0.0, 0.0, 0.0, 0.0), (0.45, 0.0, 0.0, 0.45, 0.0)


def _plain(red: float, green: float, blue: float) -> Paint:
    """One colour without any texture."""
    return Paint((red, green, blue), (red, green, blue), (1.0, 1.0, 1.0), _PLAIN)


PLAIN_WALLS = ("chalk", "cream", "dove", "sage", "blush", "petrol")
WALLS = ("plaster", "sky", "roughcast", "lime", "wallpaper", "checked", "clouded")
FLOORS = ("parquet", "boards", "tiles", "slabs", "carpet", "felt", "linoleum")

HOME_PAINTS: dict[str, Paint] = {
    **MORE_PAINTS,
    "chalk": _plain(0.78, 0.77, 0.74),
    "cream": _plain(0.76, 0.68, 0.52),
    "dove": _plain(0.50, 0.52, 0.55),
    "sage": _plain(0.42, 0.52, 0.38),
    "blush": _plain(0.70, 0.48, 0.42),
    "petrol": _plain(0.16, 0.34, 0.38),
    "wallpaper": Paint((0.44, 0.46, 0.60), (0.72, 0.72, 0.78), (3.0, 3.0, 3.0), (0.5, 0.5, 0.0, 0.0, 0.0)),
    "checked": Paint((0.60, 0.52, 0.38), (0.80, 0.74, 0.60), (1.5, 1.5, 1.5), (0.5, 0.5, 0.0, 0.0, 0.0)),
    "roughcast": Paint((0.60, 0.57, 0.52), (0.78, 0.76, 0.72), (6.0, 6.0, 6.0), _NOISE),
    "lime": Paint((0.52, 0.60, 0.44), (0.64, 0.70, 0.54), (3.0, 3.0, 3.0), _NOISE),
    "clouded": Paint((0.62, 0.46, 0.38), (0.76, 0.60, 0.50), (2.0, 2.0, 2.0), _NOISE),
    "boards": Paint((0.40, 0.28, 0.16), (0.68, 0.52, 0.34), (4.0, 1.0, 0.8), _BOARDS),
    "slabs": Paint((0.22, 0.20, 0.19), (0.44, 0.42, 0.40), (1.0, 0.0, 1.0), _CHECKS),
    "felt": Paint((0.34, 0.22, 0.18), (0.56, 0.42, 0.36), (5.0, 5.0, 5.0), _NOISE),
    # Sky over bushes, some metres behind the glass
    "outside": Paint((0.06, 0.18, 0.05), (0.66, 0.82, 0.98), (0.3, 0.4, 0.3), _NOISE),
}

GLOWS: dict[str, float] = {"outside": 1.5}
"""Paints of glass through which the outside shines; see `Scene.glow`."""
