"""Features of the corners of grids, found by a hash: fine detail where something was learned, and nothing elsewhere."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from mipsjax.config.sections import FieldConfig
from mipsjax.core.encodings.encoding import Encoding

# Multipliers of the spatial hash (Teschner et al. 2003): large primes, the first 1 for locality in memory.
HASH_PRIMES = np.array([1, 2654435761, 805459861], np.uint32)
TABLE_INIT = 1e-4  # near zero, as Mueller et al. 2022: what was never seen adds next to nothing


def hash_width(cfg: FieldConfig) -> int:
    """Features of all levels."""
    return cfg.hash_levels * cfg.hash_features


def hash_init(key: PRNGKeyArray, cfg: FieldConfig) -> Float[Array, "L T F"]:
    """A table for every level, near zero."""
    shape = (cfg.hash_levels, 2**cfg.hash_log2_entries, cfg.hash_features)
    return jax.random.uniform(key, shape, minval=-TABLE_INIT, maxval=TABLE_INIT)


def hash_features(
    table: Float[Array, "L T F"], points: Float[Array, "N 3"], cfg: FieldConfig
) -> Float[Array, "N E"]:
    """Trilinearly interpolated features of every level (Mueller et al. 2022); no scene bounds are needed.

    Written as one flat array per corner and feature: XLA then fuses the eight gathers of a level with the
    interpolation, which is an order of magnitude faster on a CPU than gathering rows and summing.
    """
    levels, entries, features = table.shape
    cells = points.T[:, None] / np.array(_cells(cfg), np.float32)[None, :, None]
    base = jnp.floor(cells)
    offset = cells - base
    # Through signed integers: cells left of the origin are negative, and wrap round as unsigned ones
    lo = base.astype(jnp.int32).astype(jnp.uint32) * HASH_PRIMES[:, None, None]
    # The next cell's hash along an axis is one prime more
    hi = lo + HASH_PRIMES[:, None, None]
    # The number of entries is a power of 2, so that the mask is the remainder
    mask, start = np.uint32(entries - 1), np.arange(levels, dtype=np.int32)[:, None] * entries
    index = jnp.stack(
        [
            ((x ^ y ^ z) & mask).astype(jnp.int32) + start
            for x in (lo[0], hi[0])
            for y in (lo[1], hi[1])
            for z in (lo[2], hi[2])
        ]
    )
    corners = _picked(table.reshape(levels * entries, features), index)
    return jnp.concatenate([_trilinear(feature, offset) for feature in corners]).T


@jax.custom_vjp
def _picked(flat: Float[Array, "E F"], index: Int[Array, "8 L N"]) -> list[Float[Array, "8 L N"]]:
    """Entries of a table, an array for every feature.

    The derivative by the table is one scatter of whole entries: the same bits as from one for every feature, in a
    fraction of the time on a CPU. It can be taken in reverse mode alone (`jax.grad`, not `jax.jvp`).
    """
    return [flat[:, f][index] for f in range(flat.shape[1])]


def _picked_forward(flat, index):
    return _picked(flat, index), (flat, index)


def _picked_backward(residuals, by_feature):
    flat, index = residuals  # of the first, the shape alone
    rows = jnp.stack(by_feature, -1).reshape(-1, flat.shape[1])
    return jnp.zeros_like(flat).at[index.reshape(-1)].add(rows, mode="promise_in_bounds"), None


_picked.defvjp(_picked_forward, _picked_backward)


def _trilinear(corners: Float[Array, "8 L N"], offset: Float[Array, "3 L N"]) -> Float[Array, "L N"]:
    """Corners in the order 000, 001, 010, ... of (x, y, z)."""
    for axis in range(3):
        # Halves the list of corners along one axis after the other: 8, 4, 2, 1
        half = corners.shape[0] // 2
        corners = corners[:half] + (corners[half:] - corners[:half]) * offset[axis][None]
    return corners[0]


def _cells(cfg: FieldConfig) -> list[float]:
    return np.geomspace(cfg.hash_coarsest, cfg.hash_finest, cfg.hash_levels).tolist()


HASH_GRID = Encoding(hash_width, hash_init, hash_features)
