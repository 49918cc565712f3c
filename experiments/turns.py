"""What a change costs: two checkouts on one sequence, a few frames of each in turn.

    python experiments/turns.py BEFORE AFTER SEQUENCE [--frames 100] [--block 4] [--pairs 6]

BEFORE and AFTER are folders of checkouts. Each works in a process of its own, which waits while the other one works, so
that a machine whose speed changes from minute to minute is as fast for both. Default preset; the first frames, in which
programs are compiled, are left out, and so is what follows the last frame. Two processes of one program may differ by
some percent all along, so there are several pairs, each of new processes. Writes `turns.csv`, milliseconds a frame for
each block, and prints what both take in the mean and how the frames a second of AFTER relate to those of BEFORE, with
the range of that over the pairs.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

WARM_UP = 12
"""Frames that are not counted."""
READY = "ready"
NAMES = ("before", "after")


def work(sequence: str, frames: int, block: int) -> None:
    """One checkout: waits for a line of input before each block, and answers with milliseconds a frame."""
    import mipsjax  # of the checkout on PYTHONPATH

    cfg = mipsjax.preset("default")
    images = mipsjax.open_sequence(sequence, frames=slice(0, frames))
    given = [images[place] for place in range(len(images))]
    state = state_in(mipsjax.start(given[0], images.intrinsics, cfg))
    for frame in given[1:WARM_UP]:
        state = state_in(mipsjax.step(state, frame, cfg))
    print(READY, len(given), flush=True)
    for begin in range(WARM_UP, len(given), block):
        sys.stdin.readline()
        some, began = given[begin : begin + block], time.perf_counter()
        for frame in some:
            state = state_in(mipsjax.step(state, frame, cfg))
        print(1e3 * (time.perf_counter() - began) / len(some), flush=True)


def state_in(given: Any) -> Any:
    """The state that `start` or `step` gives: alone in older checkouts, with an info beside it in newer ones."""
    return given if hasattr(given, "submaps") else given[0]


def worker(checkout: Path, sequence: str, frames: int, block: int) -> subprocess.Popen[str]:
    """The process of a checkout, of which `work` has not begun to count."""
    command = [sys.executable, __file__, "--worker", sequence, "--frames", str(frames), "--block", str(block)]
    environment = os.environ | {"PYTHONPATH": str(checkout.resolve() / "src")}
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def answer(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise SystemExit(f"a checkout ended early, with exit code {process.wait()}")
    return line


def measured(processes: list[subprocess.Popen[str]], block: int) -> np.ndarray:
    """Milliseconds a frame of each block, blocks x 2. Which one goes first alternates."""
    counts = {int(answer(process).split()[1]) for process in processes}
    assert len(counts) == 1, "both read the same frames"
    rows = []
    for number in range(-(-(counts.pop() - WARM_UP) // block)):
        row = [0.0, 0.0]
        for which in (0, 1) if number % 2 else (1, 0):
            pipe = processes[which].stdin
            assert pipe is not None
            print("go", file=pipe, flush=True)
            row[which] = float(answer(processes[which]))
        rows.append(row)
    return np.array(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path, nargs="?")
    parser.add_argument("after", type=Path, nargs="?")
    parser.add_argument("sequence", nargs="?")
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--block", type=int, default=4)
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work(options.worker, options.frames, options.block)
        return
    if options.sequence is None:
        parser.error("give two checkouts and a sequence")
    from common import write_rows

    pairs = [pair(options) for _ in range(options.pairs)]
    write_rows(
        "turns",
        [
            {"pair": number, **dict(zip(NAMES, row, strict=True))}
            for number, found in enumerate(pairs)
            for row in found.tolist()
        ],
    )
    for name, means in zip(NAMES, np.array([found.mean(0) for found in pairs]).T, strict=True):
        print(f"{name}: {means.mean():.1f} ms a frame in the mean, {means.min():.1f} to {means.max():.1f}")
    ratios = [found[:, 0].mean() / found[:, 1].mean() for found in pairs]
    print(
        f"frames a second: {np.exp(np.mean(np.log(ratios))):.3f} of before in the mean of {len(ratios)} pairs, "
        f"{min(ratios):.3f} to {max(ratios):.3f}"
    )


def pair(options: argparse.Namespace) -> np.ndarray:
    """Milliseconds a frame of each block, of two new processes."""
    processes = [
        worker(checkout, options.sequence, options.frames, options.block)
        for checkout in (options.before, options.after)
    ]
    try:
        return measured(processes, options.block)
    finally:
        for process in processes:
            process.kill()
            process.wait()


if __name__ == "__main__":
    main()
