"""Several submaps refined at once: the same as one by one, also on several devices."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from mipsjax.compilation import enable_cache
from mipsjax.core import mapping
from mipsjax.core.camera import Intrinsics
from mipsjax.presets import PRESETS

CFG = PRESETS["tiny"]
CAMERA = Intrinsics(40.0, 40.0, 31.5, 23.5, 64, 48)
STEPS = jnp.int32(10)
SUBMAPS = 4
RATES = jnp.linspace(0.25, 1.0, SUBMAPS)


def walls(seed: int) -> mapping.Frames:
    """Five frames of a slanted wall, another for each seed."""
    rng = np.random.default_rng(seed)
    depth = np.linspace(1.5, 2.0 + rng.random(), CAMERA.width, dtype=np.float32)
    color = rng.integers(0, 255, (5, CAMERA.height, CAMERA.width, 3), np.uint8)
    poses = np.broadcast_to(np.eye(4, dtype=np.float32), (5, 4, 4))
    depths = np.broadcast_to(depth, (5, CAMERA.height, CAMERA.width))
    return mapping.Frames(*map(jnp.asarray, (depths, color, poses, np.zeros(5, np.float32))))


def stacked():
    keys = jax.random.split(jax.random.key(0), SUBMAPS)
    maps = [mapping.create(key, CFG) for key in keys]
    frames = [walls(seed) for seed in range(SUBMAPS)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *zip(maps, frames, strict=True)), keys


def together(stack, keys) -> mapping.Learned:
    return mapping.refine_stack(*stack, STEPS, keys, CAMERA, CFG, RATES)[0]


def one_by_one(stack, keys) -> mapping.Learned:
    parts = [jax.tree.map(lambda leaf: leaf[i], stack) for i in range(SUBMAPS)]  # noqa: B023 (called here)
    each = [
        mapping.refine(*part, STEPS, key, CAMERA, CFG, rate)[0]
        for part, key, rate in zip(parts, keys, RATES, strict=True)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def farthest(a: mapping.Learned, b: mapping.Learned) -> float:
    pairs = zip(jax.tree.leaves(a.field), jax.tree.leaves(b.field), strict=True)
    return max(float(jnp.abs(x - y).max()) for x, y in jax.device_get(list(pairs)))


def test_a_stack_is_refined_as_one_by_one():
    stack, keys = stacked()
    at_once = together(stack, keys)
    assert farthest(at_once, stack[0]) > 1e-3, "nothing was learned"
    assert farthest(at_once, one_by_one(stack, keys)) == 0


def test_batched_as_on_an_accelerator_it_is_the_same_but_for_rounding():
    """Which Adam enlarges where a gradient is about zero, and a step of ReLU where it changes side."""
    stack, keys = stacked()
    one = partial(mapping.descend, camera=CAMERA, cfg=CFG)
    batched = jax.jit(jax.vmap(one, (0, 0, None, 0, 0)))(*stack, jnp.int32(1), keys, RATES)[0]
    single = mapping.refine_stack(*stack, jnp.int32(1), keys, CAMERA, CFG, RATES)[0]
    off = [
        np.abs(a - b).ravel()
        for a, b in zip(*map(jax.tree.leaves, jax.device_get((batched.field, single.field))), strict=True)
    ]
    flat = np.concatenate(off)
    assert np.mean(flat > 1e-6) < 1e-3 and flat.max() < 1e-4


if __name__ == "__main__":
    enable_cache()  # the same as that of the tests
    STACK, KEYS = stacked()
    AT_ONCE = together(STACK, KEYS)
    assert len(AT_ONCE.field.color.weights[0].sharding.device_set) == 2, "not on two devices"
    print(farthest(AT_ONCE, one_by_one(STACK, KEYS)))


def test_two_devices_give_the_same():
    """In a process of its own: the number of devices is fixed when JAX starts."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    env = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, Path(__file__)], env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    # None here; with more cores each device may divide its sums otherwise
    assert float(done.stdout) < 1e-6
