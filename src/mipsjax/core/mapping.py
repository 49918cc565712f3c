"""Local bundle adjustment: the submap's networks and the poses of a few frames together.

One entry point, `refine`, for the first fit, the active submap and the inactive ones.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from mipsjax.config import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, sampling
from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, rays
from mipsjax.core.views import planes_at

STEEPEST = 0.25  # least |n . ray|: normals at grazing angles are too uncertain for more


class Learned(NamedTuple):
    """What a submap has learned; the same shapes for every submap of one config."""

    field: nf.Field
    optimizer: optax.OptState


class Frames(NamedTuple):
    """F posed frames of one size."""

    depth: Float[Array, "F H W"]
    """Metres, 0 for no measurement."""
    color: UInt8[Array, "F H W 3"]
    T_sub_cam: Float[Array, "F 4 4"]
    movable: Float[Array, " F"]
    """Share of the pose learning rate at which the pose is optimised; 0 for the anchor's."""


class Pixels(NamedTuple):
    """P pixels of one frame."""

    ray: Float[Array, "P 3"]
    depth: Float[Array, " P"]
    slope: Float[Array, " P"]
    color: Float[Array, "P 3"]


class MapInfo(NamedTuple):
    """What a call of `refine` did."""

    loss: Float[Array, ""]
    """Of the last step."""
    ok: Bool[Array, ""]
    """False: something was not finite, and everything was left as it was."""


def optimizer(cfg: Config) -> optax.GradientTransformation:
    """Adam on all networks."""
    return optax.adam(cfg.map.learning_rate, b1=cfg.map.momentum, b2=0.99)


def create(key: PRNGKeyArray, cfg: Config) -> Learned:
    """A submap that knows nothing."""
    field = nf.init(key, cfg.field)
    return Learned(field, optimizer(cfg).init(field))  # pyright: ignore[reportArgumentType]  (optax names no tuples, but takes any pytree)


@partial(jax.jit, static_argnames=("camera", "cfg"))
def refine(
    learned: Learned,
    frames: Frames,
    steps: Int[Array, ""],
    key: PRNGKeyArray,
    camera: Intrinsics,
    cfg: Config,
    rate: Float[Array, ""] | float = 1.0,
) -> tuple[Learned, Float[Array, "F 4 4"], MapInfo]:
    """`steps` steps of Adam on map and poses (Section 3.4 of the paper).

    `rate` is a share of the networks' learning rate.
    Returns what was learned, the poses and an info; all as before where anything became infinite or NaN.
    """
    pose_optimizer = optax.adam(cfg.map.pose_learning_rate)
    loss_and_gradient = jax.value_and_grad(map_loss, argnums=(0, 1))

    def step(i, carry):
        field, state, twist, pose_state, _ = carry
        poses = moved(frames, twist)
        k = jax.random.fold_in(key, i)
        loss, (g_field, g_twist) = loss_and_gradient(
            field, jnp.zeros_like(twist), poses, frames, k, camera, cfg
        )
        change, state = optimizer(cfg).update(g_field, state, field)
        pose_change, pose_state = pose_optimizer.update(g_twist, pose_state)
        field = jax.tree.map(lambda p, c: p + rate * c, field, change)
        return field, state, twist + pose_change, pose_state, loss

    twist = jnp.zeros((frames.depth.shape[0], 6))
    start = (learned.field, learned.optimizer, twist, pose_optimizer.init(twist), jnp.zeros(()))
    field, state, twist, _, loss = jax.lax.fori_loop(0, steps, step, start)
    ok = _finite((field, twist, loss))
    learned = jax.tree.map(partial(jnp.where, ok), Learned(field, state), learned)
    return learned, jnp.where(ok, moved(frames, twist), frames.T_sub_cam), MapInfo(loss, ok)


def moved(frames: Frames, twist: Float[Array, "F 6"]) -> Float[Array, "F 4 4"]:
    """Poses after a twist (v, omega) in each camera's own frame; those with movable 0 stay."""
    return perturb(frames.T_sub_cam, twist * frames.movable[:, None])


def perturb(poses: Float[Array, "F 4 4"], twist: Float[Array, "F 6"]) -> Float[Array, "F 4 4"]:
    return poses @ jax.vmap(lambda t: jaxlie.SE3.exp(t).as_matrix())(twist)


def map_loss(
    field: nf.Field,
    twist: Float[Array, "F 6"],
    poses: Float[Array, "F 4 4"],
    frames: Frames,
    key: PRNGKeyArray,
    camera: Intrinsics,
    cfg: Config,
) -> Float[Array, ""]:
    """The mapping loss on one draw of pixels and samples of every frame (Eq. 18)."""
    count = frames.depth.shape[0]
    k_pixels, k_rays, k_surface = jax.random.split(key, 3)
    pixels = jax.vmap(draw_pixels, (0, 0, 0, None, None))(
        jax.random.split(k_pixels, count), frames.depth, frames.color, camera, cfg
    )
    flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), pixels)
    poses = perturb(poses, twist * frames.movable[:, None])
    per_frame = flat.depth.shape[0] // count
    rotation, origin = jnp.repeat(poses[:, :3, :3], per_frame, 0), jnp.repeat(poses[:, :3, 3], per_frame, 0)
    ray_sub = jnp.einsum("pij,pj->pi", rotation, flat.ray)

    def at(depth):
        return (origin[:, None] + depth[..., None] * ray_sub[:, None]).reshape(-1, 3)

    tau = cfg.field.truncation
    depth = sampling.first_phase(k_rays, flat.depth, tau, cfg.sample)
    depth = sampling.second_phase(
        k_surface, depth, lambda d: nf.tsdf(field, at(d), cfg.field).psi.reshape(d.shape), cfg.sample
    )
    samples = sampling.label(depth, flat.depth, flat.slope, tau)
    points = at(depth)
    total = jnp.zeros(())
    if field.smooth is not None:
        total += tsdf_loss(nf.smooth_tsdf(field, points, cfg.field), samples, cfg)
        # Where there is a smooth field, it alone moves the poses: derivatives through the hash grid cost more
        # than the rest of the step.
        points = jax.lax.stop_gradient(points)
    encoded = nf.encode(field, points, cfg.field)
    net = field.smooth if field.fine is None else field.fine
    assert net is not None
    prediction = nf.classify(net, encoded, cfg.field)
    if field.fine is not None:
        total += tsdf_loss(prediction, samples, cfg)
    return total + cfg.loss.rgb * color_loss(field, prediction.psi, encoded, samples, flat, cfg)


def tsdf_loss(prediction: nf.Tsdf, samples: sampling.Samples, cfg: Config) -> Float[Array, ""]:
    target = samples.target.reshape(-1)
    total = jnp.zeros(())
    near = (cfg.loss.tr, cfg.loss.cross_entropy, samples.near)
    free = (cfg.loss.fs, cfg.loss.cross_entropy_free, samples.free)
    for squared, entropy, mask in (near, free):
        flat = mask.reshape(-1)
        total += squared * losses.distance(prediction.psi, target, flat)
        total += cfg.loss.emd * losses.emd(prediction, target, flat, cfg.field)
        total += entropy * losses.cross_entropy(prediction, target, flat, cfg.field)
    return total


def color_loss(
    field: nf.Field,
    psi: Float[Array, " N"],
    encoded: Float[Array, "N E"],
    samples: sampling.Samples,
    pixels: Pixels,
    cfg: Config,
) -> Float[Array, ""]:
    """Colour rendered on some samples of each ray, spread over the truncation region (Eqs. 4 and 12)."""
    rays, count = samples.depth.shape
    some = _color_samples(count, cfg)
    psi = jax.lax.stop_gradient(psi).reshape(rays, count)[:, some]
    weights = losses.render_weights(psi, samples.near[:, some], cfg.field.truncation)
    picked = encoded.reshape(rays, count, -1)[:, some]
    rgb = nf.decode_color(field, picked.reshape(-1, picked.shape[-1])).reshape(*weights.shape, 3)
    return losses.rgb(losses.render(weights, rgb), pixels.color, pixels.depth > 0)


def _color_samples(count: int, cfg: Config) -> np.ndarray:
    """Which of the samples carry colour: those drawn in the truncation region lie behind the uniform ones."""
    if cfg.loss.color_samples >= count:
        return np.arange(count)
    first = cfg.sample.uniform
    return np.unique(
        np.linspace(first, first + cfg.sample.truncation - 1, cfg.loss.color_samples).round().astype(int)
    )


def draw_pixels(
    key: PRNGKeyArray,
    depth: Float[Array, "H W"],
    color: UInt8[Array, "H W 3"],
    camera: Intrinsics,
    cfg: Config,
) -> Pixels:
    """A stripe grid of pixels, shifted by a random part of a cell."""
    height, width = depth.shape
    v, u = pixel_grid(
        *grid_shape(cfg.map.pixels, height, width), jax.random.uniform(key, (2,)), height, width
    )
    ray = rays(v, u, camera)
    slope = surface_slope(depth, v, u, camera) if cfg.sample.perpendicular else jnp.ones(u.shape)
    return Pixels(ray, depth[v, u], slope, color[v, u].astype(jnp.float32) / 255)


def surface_slope(
    depth: Float[Array, "H W"], v: Int[Array, " P"], u: Int[Array, " P"], camera: Intrinsics
) -> Float[Array, " P"]:
    """|n . ray| of the surface at each pixel; 1 where the depth image has no normal."""
    planes = planes_at(depth, v, u, camera)
    slope = jnp.abs(jnp.sum(planes.normal * rays(v, u, camera), -1))
    return jnp.where(planes.smooth, jnp.clip(slope, STEEPEST, 1.0), 1.0)


def _finite(tree) -> Bool[Array, ""]:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))
