"""Sines and cosines of the coordinates: smooth, and known everywhere from little."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from mipsjax.config.sections import FieldConfig
from mipsjax.core.encodings.encoding import Encoding


def _width(cfg: FieldConfig) -> int:
    # The point itself, and a sine and a cosine of each coordinate for every octave
    return 3 + 6 * cfg.octaves


def _init(key: PRNGKeyArray, cfg: FieldConfig) -> None:
    """There is nothing to learn."""


def _apply(parameters: None, points: Float[Array, "N 3"], cfg: FieldConfig) -> Float[Array, "N E"]:
    return frequencies(points, cfg)


SINUSOIDS = Encoding(_width, _init, _apply)


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
    # Each octave twice, for its sine and its cosine; the point itself comes before
    slopes = [np.eye(3), *(octave * np.eye(3) for octave in np.repeat(octaves, 2))]
    # sin(x) = cos(x - 1/4 turn): one polynomial serves both
    sine, cosine = [-0.25] * 3, [0.0] * 3
    shift = np.array([0.0] * 3 + (sine + cosine) * cfg.octaves, np.float32)
    return np.concatenate(slopes, 1).astype(np.float32), shift


def _cosine(turns: Float[Array, "N E"]) -> Float[Array, "N E"]:
    """cos(2 pi turns) by an odd polynomial around the nearest zero: library sines are not vectorised on a CPU."""
    # Signed turns to the nearest zero of the cosine: sin(2 pi quarter) = cos(2 pi turns)
    quarter = 0.25 - jnp.abs(turns - jnp.round(turns))
    square = quarter * quarter
    # Horner's scheme in the square, for the polynomial is odd
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
