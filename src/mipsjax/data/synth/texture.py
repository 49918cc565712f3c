"""Procedural surface colour: solid textures, a function of the point in space and of a material."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, UInt32

# Slope of the soft edges of checks and stripes: hard ones would flicker in an image without antialiasing
_EDGE = 6.0
# Bends wood grain by this many cycles at most
_GRAIN_BEND = 2.5
# Cycles of hue over the range of the noise in a painting
_HUE_CYCLES = 1.3
# Mean and amplitude of each colour channel in a painting: muted, as pigments are
_HUE_MEAN, _HUE_SWING = 0.30, 0.28
# Octaves of noise; the third has a quarter of the material's pattern size
_OCTAVES = 3
# Spreads noise, which clusters around a half, over 0..1
_NOISE_CONTRAST = 1.9


class Materials(NamedTuple):
    """M materials: two colours mixed by a weighted sum of noise, checks, stripes and wood grain."""

    dark: Float[Array, "*m 3"]
    """Linear RGB where the pattern is 0."""
    bright: Float[Array, "*m 3"]
    """Linear RGB where the pattern is 1."""
    frequency: Float[Array, "*m 3"]
    """Cycles a metre of the pattern along the world's axes."""
    weights: Float[Array, "*m 5"]
    """Share of noise, checks, stripes (along x), wood grain (along x) and painting, which colours by hue."""


def albedo(materials: Materials, index: Int[Array, "N"], points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Linear RGB reflectance in 0..1 of points (metres, world frame) on given materials."""
    dark, bright, frequency, weights = (table[index] for table in materials)
    # A quarter cycle off, so that no pattern changes sign on the planes floors and walls lie in
    at = points * frequency + 0.25
    # Behind barriers, or the compiler computes it again for each colour
    noise = jax.lax.optimization_barrier(fractal_noise(at))
    wave = jnp.sin(2.0 * jnp.pi * at)
    checks = _soft_step(jnp.prod(jnp.where(frequency > 0.0, wave, 1.0), axis=-1))
    stripes = _soft_step(wave[:, 0])
    grain = 0.5 + 0.5 * jnp.sin(2.0 * jnp.pi * (at[:, 0] + _GRAIN_BEND * noise))
    patterns = jnp.stack([noise, checks, stripes, grain], axis=-1)
    mix = jax.lax.optimization_barrier(jnp.sum(patterns * weights[:, :4], axis=-1, keepdims=True))
    plain = dark + (bright - dark) * jnp.clip(mix, 0.0, 1.0)
    return jnp.clip(plain + weights[:, 4:] * (_hues(noise) - plain), 0.0, 1.0)


def _hues(value: Float[Array, "N"]) -> Float[Array, "N 3"]:
    phases = jnp.array([[0.0, 0.33, 0.67]])
    return _HUE_MEAN + _HUE_SWING * jnp.cos(2.0 * jnp.pi * (_HUE_CYCLES * value[:, None] + phases))


def _soft_step(wave: Float[Array, "N"]) -> Float[Array, "N"]:
    return 0.5 + 0.5 * jnp.clip(_EDGE * wave, -1.0, 1.0)


def fractal_noise(at: Float[Array, "N 3"]) -> Float[Array, "N"]:
    """Value noise of unit lattice summed over octaves, in 0..1."""
    total, weight = jnp.zeros(at.shape[0]), 1.0
    for octave in range(_OCTAVES):
        total += weight * value_noise(at * 2.0**octave + 17.0 * octave)
        weight *= 0.5
    mean = total / (2.0 - 2.0 * weight)
    return jnp.clip(0.5 + _NOISE_CONTRAST * (mean - 0.5), 0.0, 1.0)


def value_noise(at: Float[Array, "N 3"]) -> Float[Array, "N"]:
    """Random values at integer lattice points, smoothly interpolated, in 0..1."""
    cell = jnp.floor(at)
    part = at - cell
    fx, fy, fz = jnp.moveaxis(part * part * (3.0 - 2.0 * part), -1, 0)
    # By way of a signed type: what a negative float is without a sign is undefined
    x, y, z = jnp.moveaxis(cell.astype(jnp.int32).astype(jnp.uint32), -1, 0)
    total = jnp.zeros(at.shape[0])
    for dx, dy, dz in [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]:
        corner = (fx if dx else 1.0 - fx) * (fy if dy else 1.0 - fy) * (fz if dz else 1.0 - fz)
        total += corner * _lattice_value(x + dx, y + dy, z + dz)
    return total


def _lattice_value(x: UInt32[Array, "N"], y: UInt32[Array, "N"], z: UInt32[Array, "N"]) -> Float[Array, "N"]:
    """A value in 0..1 for a lattice point: products with odd constants, high bits mixed into low ones."""
    h = x * jnp.uint32(0x9E3779B1) ^ y * jnp.uint32(0x85EBCA77) ^ z * jnp.uint32(0xC2B2AE3D)
    h = (h ^ (h >> 15)) * jnp.uint32(0x2C1B3C6D)
    h = (h ^ (h >> 12)) * jnp.uint32(0x297A2D39)
    return (h >> 8).astype(jnp.float32) * (1.0 / 2**24)
