"""The losses of the paper, as means over masked samples, and the rendering of colour and depth."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mipsjax.config.sections import FieldConfig, SensorConfig
from mipsjax.core.field import Tsdf, class_values

Metres = TypeVar("Metres", np.ndarray, jax.Array)


def masked_mean(values: Float[Array, "*S"], mask: Bool[Array, "*S"] | Float[Array, "*S"]) -> Float[Array, ""]:
    """Mean over the mask; 0 where it is empty."""
    weight = mask.astype(values.dtype)
    return jnp.sum(values * weight) / jnp.maximum(jnp.sum(weight), 1)


def certainty(entropy: Float[Array, " P"], floor: float) -> Float[Array, " P"]:
    """Weight 1 / h^2 of a point (Eq. 13), bounded by a floor on the entropy and scaled to at most 1."""
    return floor**2 / (entropy**2 + floor**2)


def precision(away: Metres, cfg: SensorConfig) -> Metres:
    """Inverse variance of depths measured so many metres away, as shares of that close by. Not in the paper."""
    return 1 / (1 + (cfg.noise_growth * away**2 / cfg.noise_floor) ** 2)


def d2t(psi: Float[Array, " P"], mask: Bool[Array, " P"]) -> Float[Array, ""]:
    """Depth-to-TSDF loss (Eq. 8), as a mean over the measured pixels. Square metres."""
    return masked_mean(psi**2, mask)


def distance(
    psi: Float[Array, "*S"], target: Float[Array, "*S"], mask: Bool[Array, "*S"]
) -> Float[Array, ""]:
    """Truncation-region loss (Eq. 9) with the mask `near`; free-space loss (Eq. 11) with `free`."""
    return masked_mean((psi - target) ** 2, mask)


def emd(
    prediction: Tsdf, target: Float[Array, " S"], mask: Bool[Array, " S"], cfg: FieldConfig
) -> Float[Array, ""]:
    """Earth mover's distance of the class distribution to the nearest class of the target (Eq. 10)."""
    if not cfg.classification:
        return jnp.zeros(())
    step = 2 * cfg.truncation / (cfg.classes - 1)
    # Classes are a step apart: moving all mass to the nearest one costs the sum of steps that it goes
    nearest = jnp.round((target + cfg.truncation) / step)
    away = jnp.abs(jnp.arange(cfg.classes)[None] - nearest[:, None])
    return masked_mean(jnp.sum(jnp.exp(prediction.logits) * away, -1), mask)


def cross_entropy(
    prediction: Tsdf, target: Float[Array, " S"], mask: Bool[Array, " S"], cfg: FieldConfig
) -> Float[Array, ""]:
    """Cross entropy to the two classes around the target, whose mean is the target exactly."""
    if not cfg.classification:
        return jnp.zeros(())
    step = 2 * cfg.truncation / (cfg.classes - 1)
    # Linear between two classes: the mean of the two is the target, where the nearest one alone would round it
    two_hot = jnp.maximum(0, 1 - jnp.abs(target[:, None] - class_values(cfg)[None]) / step)
    return masked_mean(-jnp.sum(two_hot * prediction.logits, -1), mask)


def render_weights(
    psi: Float[Array, "P S"], near: Bool[Array, "P S"], truncation: float
) -> Float[Array, "P S"]:
    """Normalised weights of the samples of each ray, in the truncation region only (Eqs. 3 and 4)."""
    # Largest where psi is 0, and the same on both sides: the weights have a mode at the surface (Eq. 3)
    raw = jax.nn.sigmoid(psi / truncation) * jax.nn.sigmoid(-psi / truncation) * near
    return raw / jnp.maximum(jnp.sum(raw, -1, keepdims=True), 1e-6)


def render(weights: Float[Array, "P S"], values: Float[Array, "P S *C"]) -> Float[Array, "P *C"]:
    """Weighted sum along each ray: colour (Eq. 4) or depth (Eq. 5)."""
    return jnp.einsum("ps,ps...->p...", weights, values)


def rgb(
    rendered: Float[Array, "P 3"], measured: Float[Array, "P 3"], mask: Bool[Array, " P"]
) -> Float[Array, ""]:
    """Mean norm of the colour difference (Eq. 12)."""
    # The square root has no derivative at 0, which a constant image reaches
    return masked_mean(jnp.sqrt(jnp.sum((rendered - measured) ** 2, -1) + 1e-12), mask)
