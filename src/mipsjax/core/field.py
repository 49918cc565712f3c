"""The neural field of one submap: truncated signed distance by classification, and colour.

All points are in the submap's frame, metres. The distance is positive in front of the surface.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from mipsjax.config import FieldConfig

Part = Literal["search", "whole"]

# Multipliers of the spatial hash (Teschner et al. 2003): large primes, the first 1 for locality in memory.
HASH_PRIMES = np.array([1, 2654435761, 805459861], np.uint32)
TABLE_INIT = 1e-4


class Net(NamedTuple):
    """A multilayer perceptron, behind a hash grid where `table` is not None."""

    weights: tuple[Float[Array, "I O"], ...]
    biases: tuple[Float[Array, " O"], ...]
    table: Float[Array, "L T F"] | None


class Field(NamedTuple):
    """Parameters of a submap; the same shapes for every submap of one config."""

    smooth: Net | None
    """Distance from sinusoids."""
    fine: Net | None
    """Distance from a hash grid, or from hash grid and sinusoids together."""
    color: Net
    """Colour from what the finest distance is read from."""


class Tsdf(NamedTuple):
    """Prediction at N points."""

    psi: Float[Array, " N"]
    """Truncated signed distance, metres (Eq. 2)."""
    entropy: Float[Array, " N"]
    """Shannon entropy of the class distribution, nats; 1 everywhere where the distance is regressed."""
    logits: Float[Array, "N C"]
    """Logarithm of the class probabilities; C = 1, psi itself, where the distance is regressed."""


def class_values(cfg: FieldConfig) -> Float[np.ndarray, " C"]:
    """The distances the classes stand for, evenly over [-tau, tau]. Metres."""
    return np.linspace(-cfg.truncation, cfg.truncation, cfg.classes, dtype=np.float32)


def init(key: PRNGKeyArray, cfg: FieldConfig) -> Field:
    """Fresh parameters: He initialisation, hash grid near zero."""
    k_smooth, k_fine, k_color = jax.random.split(key, 3)
    outputs = cfg.classes if cfg.classification else 1
    smooth = fine = None
    if cfg.encoding in ("frequency", "both"):
        smooth = _init_net(k_smooth, (_frequency_width(cfg), *cfg.hidden, outputs))
    width = _encoded_width(cfg)
    if cfg.encoding != "frequency":
        fine = _init_net(k_fine, (width, *cfg.hash_hidden, outputs), cfg)
    return Field(smooth, fine, _init_net(k_color, (width, *cfg.color_hidden, 3)))


def tsdf(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig, part: Part = "whole") -> Tsdf:
    """Distance and its uncertainty (Section 3.1 of the paper).

    `part="search"` is the smooth field where there are two; `whole` the most accurate one.
    """
    smooth = field.fine is None or (part == "search" and field.smooth is not None)
    return smooth_tsdf(field, points, cfg) if smooth else fine_tsdf(field, points, cfg)


def smooth_tsdf(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig) -> Tsdf:
    """Distance from the sinusoidal field."""
    assert field.smooth is not None
    return classify(field.smooth, frequencies(points, cfg), cfg)


def fine_tsdf(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig) -> Tsdf:
    """Distance from the field with the hash grid."""
    assert field.fine is not None
    return classify(field.fine, encode(field, points, cfg), cfg)


def color(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig) -> Float[Array, "N 3"]:
    """RGB in 0..1."""
    return decode_color(field, encode(field, points, cfg))


def encode(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig) -> Float[Array, "N E"]:
    """What the finest distance and the colour are read from, to be computed once for both."""
    if field.fine is None:
        return frequencies(points, cfg)
    assert field.fine.table is not None
    features = hash_features(field.fine.table, points, cfg)
    return jnp.concatenate([features, frequencies(points, cfg)], -1) if cfg.encoding == "joint" else features


def decode_color(field: Field, encoded: Float[Array, "N E"]) -> Float[Array, "N 3"]:
    """RGB in 0..1 from `encode`."""
    return jax.nn.sigmoid(_mlp(field.color, encoded))


def classify(net: Net, encoded: Float[Array, "N E"], cfg: FieldConfig) -> Tsdf:
    """Distance and uncertainty from encoded points (Eq. 2 and the entropy below it)."""
    z = _mlp(net, encoded)
    if not cfg.classification:
        psi = cfg.truncation * jnp.tanh(z[:, 0])
        return Tsdf(psi, jnp.ones_like(psi), psi[:, None])
    z = jax.nn.softmax(z) if cfg.normalised else z
    log_p = jax.nn.log_softmax(cfg.coldness * z)
    p = jnp.exp(log_p)
    return Tsdf(p @ class_values(cfg), -jnp.sum(p * log_p, -1), log_p)


def is_certain(entropy: Float[Array, " N"], share: float, cfg: FieldConfig) -> Bool[Array, " N"]:
    """Entropy below a share of that of an even distribution; everywhere where the distance is regressed."""
    if not cfg.classification:
        return jnp.ones(entropy.shape, bool)
    return entropy < share * np.log(cfg.classes)


def frequencies(points: Float[Array, "N 3"], cfg: FieldConfig) -> Float[Array, "N E"]:
    """The points and sines and cosines of `octaves` frequencies (Mildenhall et al. 2021).

    One expression for all columns, which XLA fuses into one loop: a concatenation of sines and cosines took as
    long as the network behind it.
    """
    turns_per_metre, shift = _phases(cfg)
    x, y, z = (points[:, axis, None] * turns_per_metre[None, axis] for axis in range(3))
    turns = x + y + z + shift[None]
    return jnp.where(np.arange(len(shift))[None] < 3, turns, _cosine(turns))


def _phases(cfg: FieldConfig) -> tuple[Float[np.ndarray, "3 E"], Float[np.ndarray, " E"]]:
    """Turns of every column along each axis, and at the origin; the first three columns are the points."""
    octaves = 2.0 ** np.arange(cfg.octaves) / cfg.longest_wavelength
    slopes = [np.eye(3), *(octave * np.eye(3) for octave in np.repeat(octaves, 2))]
    sine, cosine = [-0.25] * 3, [0.0] * 3
    shift = np.array([0.0] * 3 + (sine + cosine) * cfg.octaves, np.float32)
    return np.concatenate(slopes, 1).astype(np.float32), shift


def _cosine(turns: Float[Array, "N E"]) -> Float[Array, "N E"]:
    """cos(2 pi turns) by an odd polynomial around the nearest zero: library sines are not vectorised on a CPU."""
    quarter = 0.25 - jnp.abs(turns - jnp.round(turns))
    square = quarter * quarter
    total = jnp.full_like(turns, _SINE[-1])
    for coefficient in _SINE[-2::-1]:
        total = total * square + coefficient
    return total * quarter


def _sine_polynomial(terms: int = 5) -> list[float]:
    """Coefficients of x, x^3, ... of sin(2 pi x) on a quarter turn either way; five are exact to 1e-7."""
    x = 0.25 * np.cos(np.linspace(0, np.pi, 1001))  # dense at the ends, so that the error is even
    powers = x[:, None] ** np.arange(1, 2 * terms, 2)
    return np.linalg.lstsq(powers, np.sin(2 * np.pi * x), rcond=None)[0].tolist()


_SINE = _sine_polynomial()


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
    lo = base.astype(jnp.int32).astype(jnp.uint32) * HASH_PRIMES[:, None, None]
    hi = lo + HASH_PRIMES[:, None, None]
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
        half = corners.shape[0] // 2
        corners = corners[:half] + (corners[half:] - corners[:half]) * offset[axis][None]
    return corners[0]


def _cells(cfg: FieldConfig) -> list[float]:
    return np.geomspace(cfg.hash_coarsest, cfg.hash_finest, cfg.hash_levels).tolist()


def _frequency_width(cfg: FieldConfig) -> int:
    return 3 + 6 * cfg.octaves


def _encoded_width(cfg: FieldConfig) -> int:
    """Of `encode`."""
    hashed = cfg.hash_levels * cfg.hash_features
    match cfg.encoding:
        case "frequency":
            return _frequency_width(cfg)
        case "joint":
            return hashed + _frequency_width(cfg)
        case "hash" | "both":
            return hashed


def _init_net(key: PRNGKeyArray, widths: tuple[int, ...], hashed: FieldConfig | None = None) -> Net:
    keys = jax.random.split(key, len(widths))
    pairs = list(pairwise(widths))
    weights = tuple(
        jax.random.normal(k, pair) * np.float32(np.sqrt(2 / pair[0]))
        for k, pair in zip(keys[1:], pairs, strict=True)
    )
    biases = tuple(jnp.zeros(o) for _, o in pairs)
    table = None
    if hashed is not None:
        shape = (hashed.hash_levels, 2**hashed.hash_log2_entries, hashed.hash_features)
        table = jax.random.uniform(keys[0], shape, minval=-TABLE_INIT, maxval=TABLE_INIT)
    return Net(weights, biases, table)


def _mlp(net: Net, x: Float[Array, "N I"]) -> Float[Array, "N O"]:
    for w, b in zip(net.weights[:-1], net.biases[:-1], strict=True):
        x = jax.nn.relu(x @ w + b[None])
    return x @ net.weights[-1] + net.biases[-1][None]
