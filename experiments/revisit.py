"""Poses where the camera enters a known submap again, with and without what keeps them from jumping.

    python experiments/revisit.py [--name apartment+noise] [--frames 450] [--seed 0] [--variants full no-sr ...]
    python experiments/revisit.py --name corridor-loop+noise --frames 1590 --once --fork 1400 \\
        --variants full no-sr glued

The first frames of a synthetic scene and the same backwards, so that submaps are left and entered again with the
drift of the way between; `--once` for a scene that comes back to its beginning on its own. `full`: the frame with
which a known submap takes over is registered in it, bundle adjustment follows (SR), and the pose graph is solved
(LC); without SR, without LC, without both; `glued`: with a loop the camera goes over to the known submap at once, and
all submaps stay where drift had put them; `none`: without SR, LC and registration, the pose in the known submap is
what is expected before the frame is looked for there. With `--fork` all variants go on from one run of the first
frames, as `full`.

RPE over one frame (translation, cm). Writes `revisit.csv`, a row each variant with the RPE in the 10 frames from a
revisit on and elsewhere (after the fork), and a plot.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from itertools import pairwise
from types import ModuleType
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float64

from common import OUT, changed, follow, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.data.open import open_sequence
from mipsjax.metrics.poses import absolute_error
from mipsjax.slam import step as slam
from mipsjax.submaps import closure, proposals
from mipsjax.submaps.state import SlamState, trajectory

AROUND = 10  # frames after a revisit


@contextmanager
def unregistered() -> Iterator[None]:
    """Frames are linked to other submaps at the pose that was guessed, as if they had not been registered there."""
    original = proposals.sight

    def sight(state, place, keyframe, expected, cfg, measured=False):
        found = original(state, place, keyframe, proposals.Expected(expected.T_sub_cam), cfg, measured)
        return None if found is None else found._replace(T_sub_cam=expected.T_sub_cam)

    with replaced(proposals, "sight", sight):
        yield


@contextmanager
def glued() -> Iterator[None]:
    """With a loop the camera goes over to the submap that it has met, and all submaps stay where they are."""
    original, governed = closure.solve, slam.govern

    def solve(state, cfg):
        return state, original(state, cfg)[1]

    def govern(state, found, cfg):
        loop = state.loops[-1] if state.loops else None
        newest = state.submap.keyframes[-1].id
        met = loop is not None and loop.weight > 0 and loop.record == newest
        return loop.second if met else governed(state, found, cfg)

    with replaced(closure, "solve", solve), replaced(slam, "govern", govern):
        yield


@contextmanager
def replaced(module: ModuleType, name: str, function: Callable[..., Any]) -> Iterator[None]:
    original = getattr(module, name)
    setattr(module, name, function)
    try:
        yield
    finally:
        setattr(module, name, original)


class Variant(NamedTuple):
    revisit_steps: int
    loop: bool
    without: Callable[[], AbstractContextManager[None]] = nullcontext


VARIANTS = {
    "full": Variant(10, True),
    "no-sr": Variant(0, True),
    "no-lc": Variant(10, False),
    "no-sr-no-lc": Variant(0, False),
    "glued": Variant(10, True, glued),
    "none": Variant(0, False, unregistered),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--name", default="apartment+noise")
    parser.add_argument("--frames", type=int, default=450)
    parser.add_argument("--once", action="store_true", help="not backwards")
    parser.add_argument("--fork", type=int, default=0, help="frames that all variants share")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    options = parser.parse_args()
    enable_cache()
    full = Config(seed=options.seed)
    sequence = open_sequence(f"synth:{options.name}", frames=slice(0, options.frames), input=full.input)
    count, fork = len(sequence), options.fork
    order = [*range(count), *([] if options.once else range(count - 2, -1, -1))]
    truth = sequence.T_world_cam[order]

    def follow_on(part: list[int], cfg: Config, state: SlamState | None) -> SlamState:
        return follow((sequence[i] for i in part), sequence.intrinsics, cfg, truth[0], state)

    shared = follow_on(order[:fork], full, None) if fork else None
    panels = len(options.variants)
    figure, axes = plt.subplots(panels, 1, figsize=(9, 2.2 * panels), sharex=True, sharey=True, squeeze=False)
    rows = []
    for title, axis in zip(options.variants, axes[:, 0], strict=True):
        variant = VARIANTS[title]
        cfg = changed(full, "map", revisit_steps=variant.revisit_steps)
        cfg = changed(cfg, "loop", enabled=variant.loop)
        with variant.without():
            state = follow_on(order[fork:], cfg, shared)
        poses = trajectory(state)
        rpe = moved_wrongly(poses, truth)[fork:]
        active = [record.submap for record in state.records[fork:]]
        entered = [i for i, (a, b) in enumerate(pairwise(active)) if b < a]
        near = np.zeros(len(rpe), bool)
        for i in entered:
            near[i : i + AROUND] = True
        rows.append(
            {
                "variant": title,
                "seed": options.seed,
                "revisits": len(entered),
                "rpe_at_cm": float(np.sqrt(np.mean(rpe[near] ** 2))) if entered else float("nan"),
                "rpe_at_max_cm": float(rpe[near].max()) if entered else float("nan"),
                "rpe_elsewhere_cm": float(np.sqrt(np.mean(rpe[~near] ** 2))),
                "rpe_elsewhere_max_cm": float(rpe[~near].max()),
                "ate_cm": 100 * absolute_error(poses, truth).rmse_m,
            }
        )
        show(rows[-1])
        write_rows("revisit", rows)
        axis.plot(np.arange(len(rpe)) + fork, rpe, linewidth=0.8)
        for i in entered:
            axis.axvline(fork + i, color="red", linestyle="--", linewidth=0.8)
        axis.set(ylabel="RPE, cm", yscale="log", title=title)
    axes[-1, 0].set_xlabel("frame; red: a known submap is entered again")
    figure.tight_layout()
    figure.savefig(OUT / "revisit.png", dpi=110)


def moved_wrongly(poses: Float64[np.ndarray, "N 4 4"], truth: Float64[np.ndarray, "N 4 4"]) -> np.ndarray:
    """RPE from each frame to the next, centimetres."""
    moves, true_moves = (np.linalg.inv(p[:-1]) @ p[1:] for p in (poses, truth))
    return 100 * np.linalg.norm((np.linalg.inv(true_moves) @ moves)[:, :3, 3], axis=1)


if __name__ == "__main__":
    main()
