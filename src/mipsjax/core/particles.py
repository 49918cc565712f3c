"""Randomized optimisation (RO) of a camera pose by a particle swarm template (Section 3.3 of the paper).

A pose is searched as a change delta = (qx, qy, qz, x, y, z) in the camera's own frame at the swarm's centre:
the imaginary part of a unit quaternion and a translation in metres, T = T_center @ pose(delta).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mipsjax.config.sections import FieldConfig
from mipsjax.config.tracking import SearchConfig
from mipsjax.core import field as nf
from mipsjax.core import losses
from mipsjax.core.compiled import compiled
from mipsjax.core.rigid import transform

# Points per chunk of the fitness: the activations stay in cache, and starting the threads costs little.
CHUNK_POINTS = 32768


class Swarm(NamedTuple):
    """The template, moved and rescaled."""

    T_sub_cam: Float[Array, "4 4"]
    """Centre: the best state so far."""
    cost: Float[Array, ""]
    """Of the centre."""
    radii: Float[Array, "6"]


def template(count: int, seed: int = 0) -> Float[np.ndarray, "count 6"]:
    """Particles uniform in the unit 6-ball, drawn once; particle 0 is the centre."""
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((count, 6))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # The sixth root makes the draw even over the volume, not along the radius
    particles = direction * rng.random((count, 1)) ** (1 / 6)
    particles[0] = 0
    return particles.astype(np.float32)


def delta_pose(delta: Float[Array, "*N 6"]) -> Float[Array, "*N 4 4"]:
    """Rigid motions from imaginary quaternion parts and translations."""
    q = delta[..., :3]
    square = jnp.sum(q * q, -1, keepdims=True)
    # A draw outside of the unit ball is no rotation: it is drawn in, to somewhat less than half a turn
    q = q * jnp.minimum(1.0, 0.99 / jnp.sqrt(jnp.maximum(square, 1e-12)))
    x, y, z = q[..., 0], q[..., 1], q[..., 2]
    w = jnp.sqrt(1 - jnp.sum(q * q, -1))
    rows = [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), delta[..., 3]], -1),
        jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), delta[..., 4]], -1),
        jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), delta[..., 5]], -1),
        jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (*delta.shape[:-1], 4)),
    ]
    return jnp.stack(rows, -2)


def pose_cost(
    field: nf.Field,
    T_sub_cam: Float[Array, "4 4"],
    p_cam: Float[Array, "P 3"],
    mask: Bool[Array, " P"],
    cfg: FieldConfig,
    search: SearchConfig,
) -> Float[Array, ""]:
    """Uncertainty-weighted depth-to-TSDF cost of one pose (Eq. 13), as a weighted mean: square metres."""
    prediction = nf.tsdf(field, transform(T_sub_cam, p_cam), cfg, "search")
    weight = mask.astype(jnp.float32)
    if search.uncertainty:
        weight = weight * losses.certainty(prediction.entropy, search.entropy_floor)
    return jnp.sum(weight * prediction.psi**2) / jnp.maximum(jnp.sum(weight), 1e-6)


@compiled("cfg", "search")
def fitness(
    field: nf.Field,
    poses: Float[Array, "N 4 4"],
    p_cam: Float[Array, "P 3"],
    mask: Bool[Array, " P"],
    cfg: FieldConfig,
    search: SearchConfig,
) -> Float[Array, " N"]:
    """Cost of every particle, by `vmap` over poses.

    On a CPU it goes by chunks whose activations stay in cache; elsewhere all are one batch, for many small ones would
    leave a GPU idle. Which of both is chosen when the program is lowered for a device.
    """
    chunk = max(1, CHUNK_POINTS // p_cam.shape[0])

    def one(T):
        return pose_cost(field, T, p_cam, mask, cfg, search)

    def in_chunks(poses):
        return jax.lax.map(one, poses, batch_size=chunk)

    return jax.lax.platform_dependent(poses, cpu=in_chunks, default=jax.vmap(one))


def step(
    swarm: Swarm,
    particles: Float[Array, "N 6"],
    field: nf.Field,
    p_cam: Float[Array, "P 3"],
    mask: Bool[Array, " P"],
    cfg: FieldConfig,
    search: SearchConfig,
) -> Swarm:
    """One iteration: advantage set, move, rescale (Eqs. 14 to 16)."""
    deltas = particles * swarm.radii[None]
    costs = fitness(field, swarm.T_sub_cam @ delta_pose(deltas), p_cam, mask, cfg, search)
    # A pose at which the field is not finite is never taken
    costs = jnp.nan_to_num(costs, nan=jnp.inf)
    # Particle 0 is the centre itself, on this step's pixels.
    gain = jnp.nan_to_num(jnp.maximum(costs[0] - costs, 0), posinf=0.0)
    total = jnp.sum(gain)
    # Eq. 14: the advantage set by how much better it is than the centre
    mean = jnp.sum(gain[:, None] * deltas, 0) / jnp.maximum(total, 1e-20)
    best = deltas[jnp.argmin(costs)]
    # The mean of good poses need not be one, as in front of two equal objects: the best one is tried, too
    ends = swarm.T_sub_cam @ delta_pose(jnp.stack([mean, best]))
    end_costs = fitness(field, ends, p_cam, mask, cfg, search)
    which = jnp.argmin(end_costs)
    # Where nothing is better than the centre, the swarm shrinks round it
    found = total > 0
    move = jnp.where(found, jnp.where(which == 0, mean, best), 0)
    cost = jnp.where(found, end_costs[which], costs[0])
    direction = jnp.abs(move / swarm.radii)
    direction = direction / jnp.maximum(jnp.linalg.norm(direction), 1e-9)
    # Eq. 15 scales the radii by the cost; here by the residual in units of the truncation, and relative to the
    # last radii, so that metres and quaternion parts are not mixed.
    level = jnp.sqrt(cost) / cfg.truncation
    target = jnp.where(found, swarm.radii * jnp.clip(level * (0.5 + direction), 0.3, 1.0), swarm.radii * 0.6)
    radii = search.momentum * swarm.radii + (1 - search.momentum) * target + search.epsilon
    return Swarm(jnp.where(found, ends[which], swarm.T_sub_cam), cost, radii)
