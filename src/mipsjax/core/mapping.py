"""Local bundle adjustment: the submap's networks and the poses of a few frames together.

One entry point, `refine`, for the first fit, the active submap and the inactive ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, sampling
from mipsjax.core.camera import Intrinsics
from mipsjax.core.compiled import compiled
from mipsjax.core.draws import Batch, Frames, draw, points_of
from mipsjax.core.encodings import fields
from mipsjax.core.rigid import exp

READS = ("sensor", "field", "sample", "loss", "map")
"""Sections of the configuration that mapping reads."""


class Learned(NamedTuple):
    """What a submap has learned; the same shapes for every submap of one config."""

    field: nf.Field
    optimizer: optax.OptState


class Totals(NamedTuple):
    """Over how many samples and rays of a whole draw each loss is a mean."""

    near: Float[Array, ""]
    free: Float[Array, ""]
    measured: Float[Array, ""]


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


@compiled("camera", "cfg", reads=READS)
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

    On a CPU `vmap` refines one submap after the other, to the same bits as alone. All at once, as elsewhere, their
    activations would not stay in its cache, and sums would be rounded otherwise: where a gradient is about zero, Adam
    makes whole steps of the difference.
    """
    one = partial(descend, camera=camera, cfg=cfg)
    return _in_turn_on_cpu(one)(learned, frames, steps, key, jnp.asarray(rate))


def _in_turn_on_cpu(one: Callable[..., Any]) -> Callable[..., Any]:
    """The same function; on a CPU `vmap` calls it in turn."""
    either = jax.custom_batching.custom_vmap(one)

    @either.def_vmap
    def rule(_: int, batched: Sequence[Any], *arguments: Any) -> tuple[Any, Any]:
        # What `vmap` did not batch, as the number of steps, is common to all
        axes = jax.tree.map(lambda yes: 0 if yes else None, tuple(batched))
        in_turn, at_once = (jax.vmap(f, axes) for f in (jax.custom_batching.sequential_vmap(one), one))
        out = jax.lax.platform_dependent(*arguments, cpu=in_turn, default=at_once)
        return out, jax.tree.map(lambda _: True, out)

    return either


def descend(
    learned: Learned,
    frames: Frames,
    steps: Int[Array, ""],
    key: PRNGKeyArray,
    rate: Float[Array, ""],
    *,
    camera: Intrinsics,
    cfg: Config,
) -> tuple[Learned, Float[Array, "F 4 4"], MapInfo]:
    """`refine` without its rule for `vmap`."""
    pose_optimizer = optax.adam(cfg.map.pose_learning_rate)

    def step(i, carry):
        field, state, twist, pose_state, _ = carry
        k = jax.random.fold_in(key, i)
        loss, (g_field, g_twist) = map_loss(
            field, frames._replace(T_sub_cam=moved(frames, twist)), k, camera, cfg
        )
        change, state = optimizer(cfg).update(g_field, state, field)
        pose_change, pose_state = pose_optimizer.update(g_twist, pose_state)
        field = jax.tree.map(lambda p, c: p + rate * c, field, change)
        return field, state, twist + pose_change, pose_state, loss

    twist = jnp.zeros((frames.depth.shape[0], 6))
    start = (learned.field, learned.optimizer, twist, pose_optimizer.init(twist), jnp.zeros(()))
    field, state, twist, _, loss = jax.lax.fori_loop(0, steps, step, start)
    # All or nothing: a submap that is half updated has networks and Adam's moments of different steps
    ok = _finite((field, twist, loss))
    learned = jax.tree.map(partial(jnp.where, ok), Learned(field, state), learned)
    return learned, jnp.where(ok, moved(frames, twist), frames.T_sub_cam), MapInfo(loss, ok)


@compiled("camera", "cfg", reads=READS)
def refine_stack(
    learned: Learned,
    frames: Frames,
    steps: Int[Array, ""],
    keys: PRNGKeyArray,
    camera: Intrinsics,
    cfg: Config,
    rates: Float[Array, "S"],
) -> tuple[Learned, Float[Array, "S F 4 4"], MapInfo]:
    """`refine` of S submaps in one call: learned, frames, keys and rates have a leading axis of them.

    It is their `vmap`, so on a CPU they have the same bits as alone. That axis is spread over the devices, if S is a
    multiple of their number.
    """

    @jax.vmap
    def several(learned, frames, key, rate):
        return refine(learned, frames, steps, key, camera, cfg, rate)

    devices = jax.devices()
    if len(devices) > 1 and len(keys) % len(devices) == 0:
        mesh = jax.sharding.Mesh(np.array(devices), ("submap",))
        shares = jax.sharding.PartitionSpec("submap")
        several = jax.shard_map(several, mesh=mesh, in_specs=shares, out_specs=shares, check_vma=False)
    return several(learned, frames, keys, rates)


def moved(frames: Frames, twist: Float[Array, "F 6"]) -> Float[Array, "F 4 4"]:
    """Poses after a twist (v, omega) in each camera's own frame; those with movable 0 stay."""
    return perturb(frames.T_sub_cam, twist * frames.movable[:, None])


def perturb(poses: Float[Array, "F 4 4"], twist: Float[Array, "F 6"]) -> Float[Array, "F 4 4"]:
    """Each pose after a small motion in its own frame."""
    return poses @ jax.vmap(exp)(twist)


def map_loss(
    field: nf.Field, frames: Frames, key: PRNGKeyArray, camera: Intrinsics, cfg: Config
) -> tuple[Float[Array, ""], tuple[optax.Updates, Float[Array, "F 6"]]]:
    """The mapping loss on one draw of pixels and samples of every frame (Eq. 18), and its gradient.

    The gradient is that for the networks and for a twist (v, omega) of each frame, 0 where poses are not to learn
    (`map.pose_learning_rate` 0), and is summed over chunks of rays: the losses are means over the whole draw, so their
    normalisers are counted before.
    """
    # Drawn once for all chunks: chunks change the order of sums, not what is summed
    chunks = draw(field, frames, key, camera, cfg)
    measured = chunks.pixels.depth > 0
    # A mean over a chunk would weigh the samples of a sparse chunk more
    totals = Totals(*(_count(mask) for mask in (chunks.samples.near, chunks.samples.free, measured)))
    loss_and_gradient = jax.value_and_grad(_share_of_loss, argnums=(0, 1))
    twist = jnp.zeros((frames.depth.shape[0], 6))

    def add(total, chunk):
        return jax.tree.map(jnp.add, total, loss_and_gradient(field, twist, frames, chunk, totals, cfg)), None

    nothing = jax.tree.map(jnp.zeros_like, (totals.near, (field, twist)))
    return jax.lax.scan(add, nothing, chunks)[0]


def _share_of_loss(
    field: nf.Field, twist: Float[Array, "F 6"], frames: Frames, batch: Batch, totals: Totals, cfg: Config
) -> Float[Array, ""]:
    """What a batch adds to the loss of the whole draw."""
    if not cfg.map.pose_learning_rate:
        # Derivatives by poses take time, and nothing asks for them; the loss is the same
        twist = jax.lax.stop_gradient(twist)
    points = points_of(moved(frames, twist), batch.frame, batch.pixels, batch.samples.depth)
    has, total, finest = fields(cfg.field), jnp.zeros(()), None
    if has.smooth is not None:
        finest = nf.smooth_tsdf(field, points, cfg.field)
        total += tsdf_loss(finest, batch.samples, totals, cfg)
        # Where there is a smooth field, it alone moves the poses: derivatives through the hash grid cost more
        # than the rest of the step.
        points = jax.lax.stop_gradient(points)
    encoded = nf.encode(field, points, cfg.field)
    if has.fine is not None:
        finest = nf.decode_tsdf(field, encoded, cfg.field)
        total += tsdf_loss(finest, batch.samples, totals, cfg)
    assert finest is not None
    return total + cfg.loss.rgb * color_loss(field, finest.psi, encoded, batch, totals, cfg)


def tsdf_loss(
    prediction: nf.Tsdf, samples: sampling.Samples, totals: Totals, cfg: Config
) -> Float[Array, ""]:
    """What samples of a draw add to the losses of a distance field (Eqs. 9 to 11)."""
    target = samples.target.reshape(-1)
    near = (cfg.loss.tr, cfg.loss.cross_entropy, samples.near, totals.near)
    free = (cfg.loss.fs, cfg.loss.cross_entropy_free, samples.free, totals.free)
    total = jnp.zeros(())
    for squared, entropy, mask, of in (near, free):
        flat = mask.reshape(-1)
        mean = squared * losses.distance(prediction.psi, target, flat)
        mean += cfg.loss.emd * losses.emd(prediction, target, flat, cfg.field)
        mean += entropy * losses.cross_entropy(prediction, target, flat, cfg.field)
        total += mean * (_count(mask) / of)
    return total


def color_loss(
    field: nf.Field,
    psi: Float[Array, " N"],
    encoded: Float[Array, "N E"],
    batch: Batch,
    totals: Totals,
    cfg: Config,
) -> Float[Array, ""]:
    """Colour rendered on some samples of each ray, spread over the truncation region (Eqs. 4 and 12)."""
    rays, count = batch.samples.depth.shape
    some = _color_samples(count, cfg)
    # Colour must not bend the surface: at an edge of texture it would
    psi = jax.lax.stop_gradient(psi).reshape(rays, count)[:, some]
    weights = losses.render_weights(psi, batch.samples.near[:, some], cfg.field.truncation)
    picked = encoded.reshape(rays, count, -1)[:, some]
    rgb = nf.decode_color(field, picked.reshape(-1, picked.shape[-1])).reshape(*weights.shape, 3)
    measured = batch.pixels.depth > 0
    mean = losses.rgb(losses.render(weights, rgb), batch.pixels.color, measured)
    return mean * (_count(measured) / totals.measured)


def _count(mask: Bool[Array, "*S"]) -> Float[Array, ""]:
    """Of true values, at least 1."""
    return jnp.maximum(jnp.sum(mask.astype(jnp.float32)), 1)


def _color_samples(count: int, cfg: Config) -> np.ndarray:
    """Which of the samples carry colour: those drawn in the truncation region lie behind the uniform ones."""
    if cfg.loss.color_samples >= count:
        return np.arange(count)
    first = cfg.sample.uniform
    return np.unique(
        np.linspace(first, first + cfg.sample.truncation - 1, cfg.loss.color_samples).round().astype(int)
    )


def _finite(tree) -> Bool[Array, ""]:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))
