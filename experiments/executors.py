"""Background refinement inline and in a thread; submaps refined one by one and together.

    python experiments/executors.py [--frames 300] [--repeats 4] [--every 4 1]

`synth:room` with boxes of at most 3 m, so that it needs several submaps. First the whole sequence with each executor in
turn, with a refinement every so many frames: frames a second after all is compiled, how many processors worked on
average, and whether submaps and trajectory are the same bytes. Then four submaps refined ten steps at the rate of the
background one by one, by `vmap` of `refine` (`refine_stack`), and all at once, as that is on accelerators; the first
two also on two forced host devices: milliseconds, and the largest difference of any parameter. Writes `executors.csv`,
`stacks.csv` and `stacks-2.csv`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from common import changed, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.core import draws, mapping
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Sequence
from mipsjax.slam import step as slam
from mipsjax.submaps.bundle import mapping_camera
from mipsjax.submaps.schedule import executor
from mipsjax.submaps.state import SlamState, trajectory

SUBMAPS = 4
STEPS = 10
ROUNDS = 5
TWO_DEVICES = "--xla_force_host_platform_device_count=2"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=4)
    parser.add_argument("--every", type=int, nargs="*", default=[4, 1])
    parser.add_argument("--stacks-only", action="store_true")
    options = parser.parse_args()
    enable_cache()
    if not options.stacks_only:
        executors(options.frames, options.repeats, options.every)
    stacks(options.stacks_only)
    if not options.stacks_only:
        again = [sys.executable, str(Path(__file__).resolve()), "--stacks-only"]
        subprocess.run(again, env=os.environ | {"XLA_FLAGS": TWO_DEVICES}, check=True)


def executors(frames: int, repeats: int, every: list[int]) -> None:
    small = changed(Config(), "volume", max_side=3.0)
    sequence = open_sequence("synth:room", frames=slice(0, frames), input=small.input)
    images = [sequence[i] for i in range(len(sequence))]
    rows = []
    for between in every:
        cfg = changed(small, "background", every_frames=between)
        first = run(images, sequence, cfg)[0]  # compiles
        for number in range(2 * repeats):
            kind = ("inline", "thread")[number % 2]
            state, seconds, worked = run(images, sequence, changed(cfg, "background", executor=kind))
            rows.append(
                {
                    "every_frames": between,
                    "executor": kind,
                    "submaps": len(state.submaps),
                    "fps": (len(images) - 1) / seconds,
                    "processors": worked / seconds,
                    "same_bytes": same(state, first),
                }
            )
            show(rows[-1])
            write_rows("executors", rows)


def run(images: list, sequence: Sequence, cfg: Config) -> tuple[SlamState, float, float]:
    """The end, and seconds by the clock and of processor time, all threads."""
    with executor(cfg.background.executor) as beside:
        # One config for all compiled code, whatever the executor
        cfg = changed(cfg, "background", executor="inline")
        state, _ = slam.start(images[0], sequence.intrinsics, cfg)
        began, worked = time.perf_counter(), time.process_time()
        for image in images[1:]:
            state, _ = slam.step(state, image, cfg, beside)
        return state, time.perf_counter() - began, time.process_time() - worked


def same(one: SlamState, other: SlamState) -> bool:
    leaves = (jax.tree.leaves([submap.learned for submap in state.submaps]) for state in (one, other))
    fields = all(np.array_equal(a, b) for a, b in zip(*leaves, strict=True))
    return fields and np.array_equal(trajectory(one), trajectory(other))


def stacks(devices: bool) -> None:
    """Submaps that have learned a frame each, as inactive ones have, refined further."""
    cfg, steps = Config(), jnp.int32(STEPS)
    sequence = open_sequence("synth:room", frames=slice(0, 20 * SUBMAPS, 20), input=cfg.input)
    camera = mapping_camera(sequence.intrinsics, cfg)
    keys = jax.random.split(jax.random.key(0), SUBMAPS)
    parts = []
    for i, key in enumerate(keys):
        frames = five(sequence, i, cfg)
        learned = mapping.refine(mapping.create(key, cfg), frames, jnp.int32(200), key, camera, cfg)[0]
        parts.append((learned, frames))
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
    stack = jax.tree.map(np.asarray, stack)  # on no device yet

    rate = np.float32(cfg.background.rate)
    rates = jnp.full(SUBMAPS, rate)

    def one_by_one() -> mapping.Learned:
        each = [
            mapping.refine(*part, steps, key, camera, cfg, rate)[0]
            for part, key in zip(parts, keys, strict=True)
        ]
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)

    def in_one_call() -> mapping.Learned:
        return mapping.refine_stack(*stack, steps, keys, camera, cfg, rates)[0]

    ways = {"one by one": one_by_one, "vmap": in_one_call}
    if not devices:
        batched = jax.jit(jax.vmap(partial(mapping.descend, camera=camera, cfg=cfg), (0, 0, None, 0, 0)))
        ways["all at once"] = lambda: batched(*stack, steps, keys, rates)[0]
    single, rows = one_by_one(), []
    for name, way in ways.items():
        rows.append(
            {"way": name, "devices": len(jax.devices()), "ms": timed(way)} | difference(way(), single)
        )
        show(rows[-1])
    write_rows("stacks-2" if devices else "stacks", rows)


def five(sequence: Sequence, place: int, cfg: Config) -> draws.Frames:
    """The same frame five times, at mapping size."""
    frame, every = sequence[place], round(sequence.intrinsics.width / cfg.map.width_px)
    assert frame.depth is not None and frame.color is not None
    depth, color = frame.depth[::every, ::every], frame.color[::every, ::every]
    five_of = [np.broadcast_to(a, (5, *a.shape)) for a in (depth, color, np.eye(4, dtype=np.float32))]
    return draws.Frames(*map(jnp.asarray, five_of), jnp.zeros(5))


def timed(way: Callable[[], Any]) -> float:
    """Milliseconds, the least of some rounds after a first one."""
    jax.block_until_ready(way())
    taken = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        jax.block_until_ready(way())
        taken.append(time.perf_counter() - began)
    return 1e3 * min(taken)


def difference(one: mapping.Learned, other: mapping.Learned) -> dict[str, float]:
    pairs = zip(*(jax.tree.leaves(jax.device_get(way.field)) for way in (one, other)), strict=True)
    off = np.concatenate([np.abs(a - b).ravel() for a, b in pairs])
    return {"largest_difference": float(off.max()), "share_over_1e-6": float(np.mean(off > 1e-6))}


if __name__ == "__main__":
    main()
