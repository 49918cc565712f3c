"""Fields whose distance is known in closed form: a plane, in one linear layer."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from mipsjax.config.sections import Config, FieldConfig
from mipsjax.core import field as nf

CFG = Config(field=FieldConfig(encoding="frequency", octaves=1, hidden=(), color_hidden=()))
REGRESSED = replace(CFG, field=replace(CFG.field, classification=False))
TAU = CFG.field.truncation
LABELS = np.array([-0.1, -0.05, 0.0, 0.05, 0.1])
CERTAIN, UNCERTAIN = 0.025, 0.13
"""Metres, the spread of the class distribution: entropy 0.7 and 1.6 (of at most 1.61) on the surface."""


def plane(normal, offset: float, spread: float = CERTAIN, rgb=(0.5, 0.5, 0.5), cfg: Config = CFG) -> nf.Field:
    """The field of the plane n . x = offset, free space where n . x is larger.

    Class i has the logit -(s - l_i)^2 / (2 spread^2) up to a part common to all, which is linear in the distance
    s. Its psi has the sign of s and is zero with it; a normal of zero is a distance of -offset everywhere.
    """
    field = nf.init(jax.random.key(0), cfg.field)
    assert field.smooth is not None
    if cfg.field.classification:
        slopes, constants = LABELS / spread**2, -(LABELS**2) / (2 * spread**2)
    else:
        slopes, constants = np.array([1 / TAU]), np.zeros(1)
    weight = np.zeros(field.smooth.weights[0].shape)
    weight[:3] = np.outer(normal, slopes)
    color = np.log(np.asarray(rgb)) - np.log1p(-np.asarray(rgb))
    return field._replace(
        smooth=linear(weight, constants - offset * slopes),
        color=linear(np.zeros((weight.shape[0], 3)), color),
    )


def linear(weight: np.ndarray, bias: np.ndarray) -> nf.Net:
    return nf.Net((jnp.asarray(weight, jnp.float32),), (jnp.asarray(bias, jnp.float32),), None)


def expected(s: np.ndarray, spread: float = CERTAIN) -> tuple[np.ndarray, np.ndarray]:
    """Distance and entropy where the plane is at s, in double precision."""
    p = np.exp(-((s[:, None] - LABELS) ** 2 - (s[:, None] ** 2)) / (2 * spread**2))
    p /= p.sum(1, keepdims=True)
    return p @ LABELS, -np.sum(p * np.log(p), 1)
