"""Pairs of surface points of two submaps, by the gradient of the other's distance (Section 3.5 of the paper).

Everything is computed for a fixed number of points, `cfg.correspond.points`, with a mask, and the submaps'
parameters are arguments like any other: one compilation serves all submaps.

The paper takes the gradient for a unit vector. That of the classified distance is not: close to the distance of
a class the soft argmax is flat, between two it is steep; on the surface a norm of 0.6 is common, 3 cm away 1.3.
Every step is therefore Newton's, which divides by the squared norm and is the paper's where that is 1.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core.compiled import compiled
from mipsjax.core.evidence import SATURATED
from mipsjax.core.rigid import transform, transform_back, turned


class Surface(NamedTuple):
    """N points on the zero level set of a submap, in its frame."""

    points: Float[Array, "N 3"]
    """Metres; the origin where masked."""
    normals: Float[Array, "N 3"]
    """Unit vectors into free space; zero where masked."""
    mask: Bool[Array, " N"]


class Matches(NamedTuple):
    """For each surface point of submap j the point of submap k's surface that is nearest along its gradient."""

    q_k: Float[Array, "N 3"]
    """In k's frame, metres; the origin where masked."""
    mask: Bool[Array, " N"]
    distance: Float[Array, " N"]
    """Between the two points, metres; 0 where masked."""


class Local(NamedTuple):
    """The field at N points."""

    psi: Float[Array, " N"]
    gradient: Float[Array, "N 3"]
    entropy: Float[Array, " N"]


def fixed_size(
    points: Float[np.ndarray, "M 3"], cfg: Config
) -> tuple[Float32[np.ndarray, "N 3"], Bool[np.ndarray, " N"]]:
    """Any number of points as N = `cfg.correspond.points` and a mask: evenly thinned out, or padded."""
    count = cfg.correspond.points
    # Even over the list, and so over keyframes and their images, from which it was joined
    kept = np.linspace(0, len(points) - 1, min(count, len(points))).round().astype(int)
    start, mask = np.zeros((count, 3), np.float32), np.arange(count) < len(points)
    start[: len(kept)] = points[kept]
    return start, mask


@compiled("cfg", reads=("field", "correspond"))
def surface_points(
    field: nf.Field, start: Float[Array, "N 3"], mask: Bool[Array, " N"], cfg: Config
) -> Surface:
    """Points moved onto the zero level set of a submap.

    `start` are measured points of its keyframes in its frame, metres. Masked are those that do not end on a
    certain surface within the truncation of where they began.
    """
    there = _descend(field, _finite_or_zero(start), cfg.correspond.newton_steps, cfg)
    here = _local(field, there, cfg)
    near = jnp.sum((there - start) ** 2, -1) < cfg.field.truncation**2
    good = mask & near & _on_surface(here, cfg)
    return Surface(_where(good, there), _where(good, _unit(here.gradient)), good)


@compiled("cfg", reads=("field", "correspond"))
def match(field_k: nf.Field, T_k_j: Float[Array, "4 4"], surface_j: Surface, cfg: Config) -> Matches:
    """Correspondences of submap j's surface points on submap k's surface (Eq. 19, by Newton steps).

    A point has one where it lies in k's truncation region (where k's gradient means something), k is certain
    there and at the end, the end is on k's surface within the truncation, and the normals agree.
    """
    start = _finite_or_zero(transform(T_k_j, surface_j.points))
    before = _local(field_k, start, cfg)
    reached = (jnp.abs(before.psi) < SATURATED * cfg.field.truncation) & nf.is_certain(
        before.entropy, cfg.correspond.max_entropy, cfg.field
    )
    q_k = _descend(field_k, start, cfg.correspond.match_steps, cfg)
    after = _local(field_k, q_k, cfg)
    normal_j = turned(T_k_j[:3, :3], surface_j.normals)
    # The two sides of a thin wall are within the truncation of each other: only the normals tell them apart
    agree = jnp.sum(normal_j * _unit(after.gradient), -1) > np.cos(cfg.correspond.max_angle)
    distance = jnp.sqrt(jnp.sum((q_k - start) ** 2, -1))
    near = distance < cfg.field.truncation
    # `start` stands for the point only where the pose was finite, which the normals show
    good = surface_j.mask & reached & _on_surface(after, cfg) & agree & near
    return Matches(_where(good, q_k), good, jnp.where(good, distance, 0.0))


def residuals(surface_j: Surface, matches: Matches, T_k_j: Float[Array, "4 4"]) -> Float[Array, " N"]:
    """Point-to-plane errors e_i = (p_j - T_j_k q_k) . n_j of Eq. 20, metres; 0 where there is no match."""
    q_j = transform_back(T_k_j, matches.q_k)
    error = jnp.sum((surface_j.points - q_j) * surface_j.normals, -1)
    return jnp.where(matches.mask, error, 0.0)


def _local(field: nf.Field, points: Float[Array, "N 3"], cfg: Config) -> Local:
    def distance(p):
        prediction = nf.tsdf(field, p, cfg.field)
        return prediction.psi, prediction.entropy

    # One reverse pass gives the gradient at all points: each psi depends on its own point alone
    psi, pull, entropy = jax.vjp(distance, points, has_aux=True)
    return Local(psi, pull(jnp.ones_like(psi))[0], entropy)


def _descend(field: nf.Field, points: Float[Array, "N 3"], steps: int, cfg: Config) -> Float[Array, "N 3"]:
    """Newton steps towards psi = 0; where the gradient is smaller than is plausible they are damped."""

    def step(p, _):
        psi, gradient, _ = _local(field, p, cfg)
        # A flat gradient would throw the point far away
        squared = jnp.maximum(jnp.sum(gradient**2, -1), cfg.correspond.min_gradient**2)
        return p - (psi / squared)[:, None] * gradient, None

    return jax.lax.scan(step, points, None, length=steps)[0]


def _on_surface(here: Local, cfg: Config) -> Bool[Array, " N"]:
    limits = cfg.correspond
    squared = jnp.sum(here.gradient**2, -1)
    plausible = (squared > limits.min_gradient**2) & (squared < limits.max_gradient**2)
    certain = nf.is_certain(here.entropy, limits.max_entropy, cfg.field)
    return (jnp.abs(here.psi) < limits.max_distance) & plausible & certain


def _unit(vectors: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Zero stays zero."""
    squared = jnp.sum(vectors**2, -1, keepdims=True)
    return jnp.where(squared > 0, vectors * jax.lax.rsqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)


def _finite_or_zero(points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    return jnp.where(jnp.all(jnp.isfinite(points), -1, keepdims=True), points, 0.0)


def _where(mask: Bool[Array, " N"], rows: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    return jnp.where(mask[:, None], rows, 0.0)
