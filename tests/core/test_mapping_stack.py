"""Several submaps refined in one call: the same as one by one, also on several devices."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.app.compilation import enable_cache
from mipsjax.config.presets import PRESETS
from mipsjax.core import draws, mapping
from mipsjax.core.camera import Intrinsics

pytestmark = pytest.mark.slow

CFG = PRESETS["tiny"]
CAMERA = Intrinsics(40.0, 40.0, 31.5, 23.5, 64, 48)
STEPS = jnp.int32(10)
SUBMAPS = 4
RATES = jnp.linspace(0.25, 1.0, SUBMAPS)
Refined = tuple[mapping.Learned, jax.Array, mapping.MapInfo]


def walls(seed: int) -> draws.Frames:
    """Five frames of a slanted wall, another for each seed."""
    rng = np.random.default_rng(seed)
    depth = np.linspace(1.5, 2.0 + rng.random(), CAMERA.width, dtype=np.float32)
    color = rng.integers(0, 255, (5, CAMERA.height, CAMERA.width, 3), np.uint8)
    poses = np.broadcast_to(np.eye(4, dtype=np.float32), (5, 4, 4))
    depths = np.broadcast_to(depth, (5, CAMERA.height, CAMERA.width))
    return draws.Frames(*map(jnp.asarray, (depths, color, poses, np.zeros(5, np.float32))))


def stacked():
    keys = jax.random.split(jax.random.key(0), SUBMAPS)
    maps = [mapping.create(key, CFG) for key in keys]
    frames = [walls(seed) for seed in range(SUBMAPS)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *zip(maps, frames, strict=True)), keys


def in_one_call(stack, keys) -> Refined:
    return mapping.refine_stack(*stack, STEPS, keys, CAMERA, CFG, RATES)


def one_by_one(stack, keys) -> Refined:
    parts = [jax.tree.map(lambda leaf: leaf[i], stack) for i in range(SUBMAPS)]  # noqa: B023 (called here)
    each = [
        mapping.refine(*part, STEPS, key, CAMERA, CFG, rate)
        for part, key, rate in zip(parts, keys, RATES, strict=True)
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def farthest(a: Any, b: Any) -> float:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(
        float(np.abs(np.subtract(x, y, dtype=np.float64)).max()) for x, y in jax.device_get(list(pairs))
    )


def test_a_stack_is_refined_as_one_by_one():
    stack, keys = stacked()
    together = in_one_call(stack, keys)
    assert farthest(together[0].field, stack[0].field) > 1e-3, "nothing was learned"
    assert farthest(together, one_by_one(stack, keys)) == 0


def test_so_is_anything_under_vmap_on_a_cpu():
    """Also with what all have in common, and at the rate that is left out."""
    (learned, frames), keys = stacked()
    frames = jax.tree.map(lambda leaf: leaf[0], frames)
    both = jax.vmap(lambda mine, key: mapping.refine(mine, frames, STEPS, key, CAMERA, CFG))
    first = mapping.refine(jax.tree.map(lambda leaf: leaf[0], learned), frames, STEPS, keys[0], CAMERA, CFG)
    assert farthest(jax.tree.map(lambda leaf: leaf[0], both(learned, keys)), first) == 0


def test_on_an_accelerator_the_networks_of_all_are_one_product():
    stack, keys = stacked()
    traced = mapping.refine_stack.trace(*stack, STEPS, keys, CAMERA, CFG, RATES)

    def over_all(platform: str) -> int:
        program = traced.lower(lowering_platforms=(platform,)).as_text()
        return len(re.findall(rf"dot_general.*-> tensor<{SUBMAPS}x", program))

    assert over_all("cpu") == 0 and over_all("cuda") > 10


def test_all_at_once_it_is_the_same_but_for_rounding():
    """Which Adam enlarges where a gradient is about zero, and a step of ReLU where it changes side."""
    stack, keys = stacked()
    descend = partial(mapping.descend, camera=CAMERA, cfg=CFG)
    batched = jax.jit(jax.vmap(descend, (0, 0, None, 0, 0)))(*stack, jnp.int32(1), keys, RATES)[0].field
    single = mapping.refine_stack(*stack, jnp.int32(1), keys, CAMERA, CFG, RATES)[0].field
    assert farthest(batched, stack[0].field) > 1e-3, "nothing was learned"
    off = [
        np.abs(a - b).ravel()
        for a, b in zip(*map(jax.tree.leaves, jax.device_get((batched, single))), strict=True)
    ]
    flat = np.concatenate(off)
    assert np.mean(flat > 1e-6) < 1e-3 and flat.max() < 1e-4


if __name__ == "__main__":
    enable_cache()  # the same as that of the tests
    STACK, KEYS = stacked()
    TOGETHER = in_one_call(STACK, KEYS)
    assert len(TOGETHER[0].field.color.weights[0].sharding.device_set) == 2, "not on two devices"
    print(farthest(TOGETHER, one_by_one(STACK, KEYS)))


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
