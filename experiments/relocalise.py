"""A covered lens, a cut to a room that was never seen, and a way back from there: is the camera found where it is?

    python experiments/relocalise.py [--seeds 0 1 2] [--name apartment+noise] [--cases covered cut walk]

`covered`: 300 frames of a synthetic scene, 5 s without depth or light, then frames 150 to 299 again, as if the camera
had been carried back. `cut`: 300 frames, 100 frames of another room, then frames 200 to 299 again. `walk`: 300 frames,
then frames 1000 to 1369, from another room back to the first, in a submap that hangs on nothing until a loop joins it.
Errors are distances to the true position after rigid alignment of the first 300 frames alone. Wrong is a frame that was
trusted, in a submap that in the end shared frames connect with the first, more than 10 cm off. Writes `relocalise.csv`
and a plot of each run.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from common import OUT, follow, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.core.rigid import align_rigid, transform
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Frame, Sequence
from mipsjax.submaps.links import joined
from mipsjax.submaps.state import Status, trajectory

FIRST = 300
COVERED = 150
OTHER = slice(700, 800)
BACK = slice(1000, 1370)
WRONG = 0.1  # metres


def covered(sequence: Sequence) -> Iterator[tuple[Frame, int]]:
    """Frames, and the place of each in the sequence; -1 where nothing is seen."""
    yield from ((sequence[i], i) for i in range(FIRST))
    blind = sequence[FIRST]
    assert blind.depth is not None and blind.color is not None
    black = blind._replace(depth=np.zeros_like(blind.depth), color=np.zeros_like(blind.color))
    yield from ((black, -1) for _ in range(COVERED))
    yield from ((sequence[i], i) for i in range(FIRST - COVERED, FIRST))


def cut(sequence: Sequence) -> Iterator[tuple[Frame, int]]:
    for part in (slice(0, FIRST), OTHER, slice(200, FIRST)):
        yield from ((sequence[i], i) for i in range(part.start, part.stop))


def walk(sequence: Sequence) -> Iterator[tuple[Frame, int]]:
    for part in (slice(0, FIRST), BACK):
        yield from ((sequence[i], i) for i in range(part.start, part.stop))


CASES = {"covered": covered, "cut": cut, "walk": walk}
AWAY = {"covered": COVERED, "cut": OTHER.stop - OTHER.start, "walk": 0}
"""Frames after the first 300 in which nothing of these is seen; in the walk the map decides when that ends."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--name", default="apartment+noise")
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    options = parser.parse_args()
    enable_cache()
    rows = []
    for case in options.cases:
        for seed in options.seeds:
            rows.append({"case": case, "seed": seed} | trial(options.name, case, seed))
            show(rows[-1])
            write_rows("relocalise", rows)


def trial(name: str, case: str, seed: int) -> dict[str, Any]:
    cfg = Config(seed=seed)
    sequence = open_sequence(f"synth:{name}", input=cfg.input)
    frames, places = zip(*CASES[case](sequence), strict=True)
    state = follow(frames, sequence.intrinsics, cfg, sequence.T_world_cam[0])
    truth = sequence.T_world_cam[list(places), :3, 3]
    poses = trajectory(state)[:, :3, 3]
    error = np.linalg.norm(transform(align_rigid(poses[:FIRST], truth[:FIRST]), poses) - truth, axis=1)
    seen = np.array(places) >= 0
    error[~seen] = np.nan
    home = joined(state, 0)
    trusted = np.array([r.status in (Status.OK, Status.WEAK) for r in state.records]) & seen
    at_home = trusted & np.array([r.submap in home for r in state.records])
    back = FIRST + AWAY[case]
    again = np.flatnonzero(at_home[back:])
    plot(error, trusted, at_home, f"relocalise-{case}-{seed}")
    return {
        "frames": len(places),
        "frames_until_found": int(again[0]) if len(again) else -1,
        "wrong": int((at_home & (error > WRONG)).sum()),
        "trusted_away": int(trusted[FIRST:back].sum()),
        "at_home_away": int(at_home[FIRST:back].sum()),
        "lost_after_found": int((~trusted[back + again[0] :]).sum()) if len(again) else -1,
        "rmse_before_cm": 100 * float(np.sqrt(np.mean(error[:FIRST] ** 2))),
        "rmse_after_cm": 100 * float(np.sqrt(np.mean(error[back:][at_home[back:]] ** 2))),
        "worst_after_cm": 100 * float(np.max(error[back:][at_home[back:]], initial=0.0)),
        "submaps": len(state.submaps),
        "loops": sum(loop.weight > 0 for loop in state.loops),
        "rejected": sum(loop.weight == 0 for loop in state.loops),
    }


def plot(error: np.ndarray, trusted: np.ndarray, at_home: np.ndarray, path: str) -> None:
    figure, axes = plt.subplots(figsize=(8, 3))
    number = np.arange(len(error))
    for mask, color, label in (
        (at_home, "C0", "trusted"),
        (trusted & ~at_home, "C1", "in a submap on its own"),
        (~trusted, "0.7", "lost"),
    ):
        axes.semilogy(number[mask], 100 * error[mask], ".", color=color, label=label, markersize=3)
    axes.set(xlabel="frame", ylabel="error, cm", title=path)
    axes.legend()
    figure.tight_layout()
    figure.savefig(OUT / f"{path}.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
