"""The hash grid's features and the sinusoids side by side, for one network."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from mipsjax.config.sections import FieldConfig
from mipsjax.core.encodings.encoding import Encoding
from mipsjax.core.encodings.hashgrid import HASH_GRID, hash_features
from mipsjax.core.encodings.sinusoids import SINUSOIDS, frequencies


def _width(cfg: FieldConfig) -> int:
    return HASH_GRID.width(cfg) + SINUSOIDS.width(cfg)


def _apply(
    table: Float[Array, "L T F"], points: Float[Array, "N 3"], cfg: FieldConfig
) -> Float[Array, "N E"]:
    return jnp.concatenate([hash_features(table, points, cfg), frequencies(points, cfg)], -1)


JOINT = Encoding(_width, HASH_GRID.init, _apply)
