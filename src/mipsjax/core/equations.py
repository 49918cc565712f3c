"""Normal equations: what measurements say of the pose of one frame, and the steps that follow from it.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mipsjax.config.sections import Config
from mipsjax.core import losses
from mipsjax.core.rigid import log, perturbed

DAMPING = 1e-3  # first Levenberg-Marquardt factor
DAMPING_DOWN, DAMPING_UP = 0.3, 4.0
SETTLED = 3e-4  # metres, or rad: what a step is shorter than after which no more are tried
FLOOR = 1e-3  # added to the diagonal of the 6 x 6 system: keeps an unobserved direction where it is


class Points(NamedTuple):
    """P measured points of one frame."""

    p_cam: Float[Array, "P 3"]
    color: Float[Array, "P 3"]
    mask: Bool[Array, " P"]
    """False where there is no measurement."""


def robust_cost(psi: Float[Array, " P"], scale: float) -> Float[Array, " P"]:
    """Cauchy cost, square metres; its weight is 1 / (1 + (psi / scale)^2)."""
    return scale**2 * jnp.log1p((psi / scale) ** 2)


def precisions(points: Points, cfg: Config) -> Float[Array, " P"]:
    """Inverse variances of the points' depths, 1 in the mean of the measured ones and 0 elsewhere."""
    inverse = losses.precision(points.p_cam[:, 2], cfg.sensor) * points.mask
    mean = losses.masked_mean(inverse, points.mask)
    return inverse / jnp.where(mean > 0, mean, 1)


def mean_precision(points: Points, cfg: Config) -> Float[Array, ""]:
    """Of the measured points' depths, 1 close by: what `precisions` are relative to."""
    return losses.masked_mean(losses.precision(points.p_cam[:, 2], cfg.sensor), points.mask)


class System(NamedTuple):
    """Cost, and the normal equations of one second-order step."""

    cost: Float[Array, ""]
    hessian: Float[Array, "6 6"]
    slope: Float[Array, "6"]


class Rows(NamedTuple):
    """P residuals that are to vanish; what follows from them is summed over P."""

    residual: Float[Array, "*K P"]
    """Metres."""
    jacobian: Float[Array, "*K P 6"]
    """By a twist (v, omega) in the camera's frame."""
    weight: Float[Array, "*K P"]
    cost: Float[Array, "*K P"]

    def system(self) -> System:
        """Of all rows together."""
        rows = self.jacobian.reshape(-1, 6)
        # J^T W, of which both products are made
        weighted = rows.T * self.weight.reshape(-1)[None]
        return System(jnp.sum(self.cost), weighted @ rows, weighted @ self.residual.reshape(-1))


class Prior(NamedTuple):
    """A pose that a frame has if nothing else says where it is."""

    T_sub_cam: Float[Array, "4 4"]
    weight: Float[Array, "6 6"]
    """Inverse covariance, relative to that of a point's distance: of a twist (v, omega) in the camera's frame."""


def prior_system(T: Float[Array, "4 4"], prior: Prior) -> System:
    """Normal equations of how far a pose is from the prior one, for a twist in the camera's frame."""
    off = log(jnp.linalg.inv(prior.T_sub_cam) @ T)
    # The derivative of the logarithm is the identity up to half of `off`, which is small where this counts
    slope = prior.weight @ off
    return System(off @ slope, prior.weight, slope)


class _Descent(NamedTuple):
    """Levenberg-Marquardt on its way."""

    T: Float[Array, "4 4"]
    here: System
    """At that pose."""
    damping: Float[Array, ""]
    settled: Bool[Array, ""]


def descend(
    system: Callable[[Float[Array, "4 4"]], System], T: Float[Array, "4 4"], steps: int
) -> Float[Array, "4 4"]:
    """Levenberg-Marquardt on the normal equations that `system` gives of a pose, for a twist in the camera's frame:
    at most so many steps, none after one that is shorter than `SETTLED`. Under `vmap` all are computed."""

    def step(now: _Descent) -> _Descent:
        hessian = now.here.hessian
        # Marquardt's scaling by the diagonal, so that metres and radians are damped alike; plus the floor
        damped = hessian + now.damping * jnp.diag(jnp.diag(hessian)) + FLOOR * jnp.eye(6)
        twist = -jnp.linalg.solve(damped, now.here.slope)
        T_new = perturbed(now.T, twist)
        there = system(T_new)
        # A step that makes a cost of NaN is not better, and is left out
        better = there.cost < now.here.cost
        T, here = jax.tree.map(partial(jnp.where, better), (T_new, there), (now.T, now.here))
        damping = now.damping * jnp.where(better, DAMPING_DOWN, DAMPING_UP)
        return _Descent(T, here, damping, jnp.linalg.norm(twist) < SETTLED)

    def unless_settled(now: _Descent, _: None) -> tuple[_Descent, None]:
        return jax.lax.cond(now.settled, lambda ended: ended, step, now), None

    start = _Descent(T, system(T), jnp.float32(DAMPING), jnp.bool_(False))
    return jax.lax.scan(unless_settled, start, None, length=steps)[0].T
