"""Samples along rays and what each is supervised with."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from mipsjax.config.sections import SampleConfig

NEAR = 0.05  # metres; free space is sampled from here, just in front of the lens


class Samples(NamedTuple):
    """S samples on each of P rays."""

    depth: Float[Array, "P S"]
    """z-depth of the sample, metres."""
    target: Float[Array, "P S"]
    """Signed distance it should have, metres, truncated."""
    near: Bool[Array, "P S"]
    """In the truncation region of a measured surface."""
    free: Bool[Array, "P S"]
    """In the free space in front of it."""


def stratified(
    key: PRNGKeyArray, lo: Float[Array, " P"], hi: Float[Array, " P"], count: int
) -> Float[Array, "P S"]:
    """One uniform draw in each of `count` equal parts of [lo, hi]."""
    return spread(jax.random.uniform(key, (lo.shape[0], count)), lo, hi)


def spread(
    jitter: Float[Array, "P S"], lo: Float[Array, " P"], hi: Float[Array, " P"]
) -> Float[Array, "P S"]:
    """A place in each of S equal parts of [lo, hi], at a share 0..1 of its length."""
    count = jitter.shape[1]
    return lo[:, None] + (hi - lo)[:, None] * (jnp.arange(count)[None] + jitter) / count


def first_phase(
    key: PRNGKeyArray, measured: Float[Array, " P"], truncation: float, cfg: SampleConfig
) -> Float[Array, "P S"]:
    """Depths over free space and truncation region, then within the truncation region only."""
    k_uniform, k_near = jax.random.split(key)
    near, far = jnp.maximum(measured - truncation, NEAR), measured + truncation
    uniform = stratified(k_uniform, jnp.full_like(measured, NEAR), far, cfg.uniform)
    return jnp.concatenate([uniform, stratified(k_near, near, far, cfg.truncation)], -1)


def second_phase(
    jitter: Float[Array, "P X"],
    depth: Float[Array, "P S"],
    distance: Callable[[Float[Array, "P S"]], Float[Array, "P S"]],
    cfg: SampleConfig,
) -> Float[Array, "P S+X"]:
    """Adds depths around the first-phase sample whose predicted distance is the smallest.

    `jitter` are uniform draws in 0..1, one for each of the `surface` samples.
    """
    if cfg.surface == 0:
        return depth
    # Nearest to the zero crossing among the samples that there are; more of them go there
    best = jnp.argmin(jnp.abs(distance(depth)), -1)
    center = jnp.take_along_axis(depth, best[:, None], -1)[:, 0]
    lo = jnp.maximum(center - cfg.surface_spread, NEAR)
    extra = spread(jitter, lo, center + cfg.surface_spread)
    return jnp.concatenate([depth, extra], -1)


def label(
    depth: Float[Array, "P S"], measured: Float[Array, " P"], slope: Float[Array, " P"], truncation: float
) -> Samples:
    """Signed distance to the measured surface and the masks of the losses.

    `slope` turns a difference along the ray's z into a distance across the surface; 1 is the paper's
    projective distance. Rays without a measurement (0) are in neither mask, nor are samples behind the
    truncation region, where nothing is known.
    """
    difference = measured[:, None] - depth
    # Without a measurement the difference means nothing: neither mask may hold
    valid = (measured > 0)[:, None]
    target = difference * slope[:, None]
    near = valid & (jnp.abs(difference) <= truncation)
    return Samples(
        depth=depth,
        target=jnp.clip(target, -truncation, truncation),
        near=near,
        free=valid & (difference > truncation),
    )
