"""Local bundle adjustment on the host: keyframes in, the networks and their poses after it out."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from mipsjax.config.sections import Config
from mipsjax.core import draws, mapping
from mipsjax.core.camera import Intrinsics, unproject
from mipsjax.core.rigid import distance, rigid, transform
from mipsjax.core.views import Views
from mipsjax.data.sequence import Frame
from mipsjax.submaps.chance import Purpose, generator_for
from mipsjax.submaps.dormant import unpacked
from mipsjax.submaps.ids import RecordId
from mipsjax.submaps.state import Keyframe, Pose, Submap


def mapping_stride(camera: Intrinsics, cfg: Config) -> int:
    """Images are decimated by this for mapping."""
    return max(1, round(camera.width / cfg.map.width_px))


def make_keyframe(
    frame: Frame, record_id: RecordId, T_sub_cam: Pose, cfg: Config, camera: Intrinsics
) -> Keyframe:
    """A frame with colour and depth, at mapping size."""
    assert frame.depth is not None and frame.color is not None
    every = mapping_stride(camera, cfg)
    # Copies: views would keep the images at full size in memory
    return Keyframe(
        record_id, frame.depth[::every, ::every].copy(), frame.color[::every, ::every].copy(), T_sub_cam
    )


def mapping_camera(camera: Intrinsics, cfg: Config) -> Intrinsics:
    """The camera of a keyframe's images."""
    return camera.decimated(mapping_stride(camera, cfg))


def unprojected(
    keyframe: Keyframe, camera: Intrinsics, far: float, every: int, cfg: Config
) -> Float64[np.ndarray, "N 3"]:
    """What a keyframe measured up to `far` metres, at one pixel in `every` along both axes: submap frame, metres.

    `camera` is that of the sequence.
    """
    small = mapping_camera(camera, cfg)
    depth = keyframe.depth[::every, ::every].astype(np.float64)
    v, u = np.nonzero((depth > 0) & (depth <= far))
    p_cam = unproject(v * every, u * every, depth[v, u], small)
    return transform(keyframe.T_sub_cam, p_cam)


def views_of(keyframes: Sequence[Keyframe]) -> Views | None:
    """The depth images of keyframes, where they are; None of no keyframes."""
    if not keyframes:
        return None
    return Views(
        jnp.asarray(np.stack([k.depth for k in keyframes])),
        jnp.asarray(np.stack([k.T_sub_cam for k in keyframes]), jnp.float32),
    )


def nearest(keyframes: Sequence[Keyframe], T_sub_cam: Pose, count: int) -> list[Keyframe]:
    """So many keyframes, the nearest to a pose first, 1 rad as far as 1 m; of fewer, again from the first."""
    ordered = sorted(keyframes, key=lambda keyframe: sum(distance(keyframe.T_sub_cam, T_sub_cam)))
    return [ordered[i % len(ordered)] for i in range(count)]


def random_batch(count: int, cfg: Config, purpose: Purpose, *numbers: int) -> list[int]:
    """The places of as many of `count` keyframes as mapping is compiled for: of fewer some are drawn twice."""
    rng = generator_for(cfg, purpose, *numbers)
    return [int(i) for i in rng.choice(count, cfg.map.frames, replace=count < cfg.map.frames)]


def choose(submap: Submap, others: int, rng: np.random.Generator) -> list[int]:
    """Indices, in a submap's keyframes, of the anchor and of `others` random ones; the anchor again where there are too
    few."""
    count = len(submap.keyframes)
    chosen = rng.choice(np.arange(1, count), min(others, count - 1), replace=False) if count > 1 else []
    picked = [0, *(int(i) for i in chosen)]
    return picked + [0] * (1 + others - len(picked))


def adjust_submap(
    submap: Submap,
    chosen: list[int],
    share: float,
    steps: int,
    key: jax.Array,
    camera: Intrinsics,
    cfg: Config,
    rate: float = 1.0,
) -> tuple[Submap, bool]:
    """`adjust` on some keyframes of a submap itself, all but the anchor at a share of the pose rate."""
    batch, rates = _batch(submap, chosen, share)
    learned, poses, ok = adjust(submap.learned, batch, rates, steps, key, camera, cfg, rate)
    return _with_adjusted(submap, chosen, learned, poses), ok


def adjust_submaps(
    submaps: list[Submap],
    chosen: list[list[int]],
    share: float,
    steps: int,
    keys: list[jax.Array],
    camera: Intrinsics,
    cfg: Config,
    rate: float = 1.0,
) -> list[Submap]:
    """`adjust_submap` of several submaps in one call, spread over the devices."""
    parts = [_batch(submap, indices, share) for submap, indices in zip(submaps, chosen, strict=True)]
    frames = [_frames(batch, rates) for batch, rates in parts]
    stack = jax.tree.map(
        lambda *leaves: jnp.stack(leaves),
        *zip([unpacked(s.learned) for s in submaps], frames, keys, strict=True),
    )
    learned, views, keys_ = stack
    network_rates = jnp.full(len(submaps), rate, jnp.float32)
    learned, poses, _ = mapping.refine_stack(
        learned, views, jnp.int32(steps), keys_, mapping_camera(camera, cfg), cfg, network_rates
    )
    learned = jax.device_get(learned)  # and back to the first device, whatever refined it
    refined = []
    for i, (submap, (batch, rates)) in enumerate(zip(submaps, parts, strict=True)):
        one = jax.tree.map(lambda leaf: jnp.asarray(leaf[i]), learned)  # noqa: B023 (called here)
        refined.append(_with_adjusted(submap, chosen[i], one, _poses(poses[i], batch, rates)))
    return refined


def adjust(
    learned: mapping.Learned,
    batch: list[Keyframe],
    rates: list[float],
    steps: int,
    key: jax.Array,
    camera: Intrinsics,
    cfg: Config,
    rate: float = 1.0,
) -> tuple[mapping.Learned, list[Pose], bool]:
    """`mapping.refine` on a batch: shares of the pose rate for each keyframe (0: fixed), of the networks' rate.

    Returns what was learned, the poses and whether all stayed finite; if not, nothing has changed. What was learned
    may be `packed` before, and is not after.
    """
    learned, poses, info = mapping.refine(
        unpacked(learned),
        _frames(batch, rates),
        jnp.int32(steps),
        key,
        mapping_camera(camera, cfg),
        cfg,
        np.float32(rate),
    )
    return learned, _poses(poses, batch, rates), bool(info.ok)


def _batch(submap: Submap, chosen: list[int], share: float) -> tuple[list[Keyframe], list[float]]:
    # The anchor is number 0. It defines the submap's frame, and never moves
    return [submap.keyframes[i] for i in chosen], [share if i != 0 else 0.0 for i in chosen]


def _frames(batch: list[Keyframe], rates: list[float]) -> draws.Frames:
    return draws.Frames(
        depth=jnp.asarray(np.stack([k.depth for k in batch])),
        color=jnp.asarray(np.stack([k.color for k in batch])),
        T_sub_cam=jnp.asarray(np.stack([k.T_sub_cam for k in batch]), jnp.float32),
        movable=jnp.asarray(np.array(rates, np.float32)),
    )


def _poses(poses: jax.Array, batch: list[Keyframe], rates: list[float]) -> list[Pose]:
    """Poses of a batch in double precision; those at rate 0 as they were, to the bit."""
    return [
        rigid(pose) if rate else k.T_sub_cam
        for pose, rate, k in zip(np.asarray(poses), rates, batch, strict=True)
    ]


def _with_adjusted(submap: Submap, chosen: list[int], learned: mapping.Learned, poses: list[Pose]) -> Submap:
    """The submap after bundle adjustment of some of its keyframes."""
    keyframes = list(submap.keyframes)
    for i, pose in zip(chosen, poses, strict=True):
        keyframes[i] = keyframes[i]._replace(T_sub_cam=pose)
    return submap._replace(learned=learned, keyframes=tuple(keyframes))
