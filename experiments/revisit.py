"""Poses where the camera enters a known submap again, with and without bundle adjustment before it.

    python experiments/revisit.py [--name apartment+noise] [--frames 450] [--once] [--seed 0] [--variants full ...]

The first frames of a synthetic scene and the same backwards, so that submaps are left and entered again with the
drift of the way between; `--once` for a scene that comes back to its beginning on its own. `full`: the frame with
which a known submap takes over is registered in it, bundle adjustment follows (SR), and the pose graph is solved
(LC); without SR, without LC, without both; `none`: without registration either, the pose in the known submap is what
the world poses of the submaps say. RPE over one frame (translation, cm). Writes `revisit.csv`, a row each variant
with the RPE in the 10 frames from a revisit on and elsewhere, and a plot.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from itertools import pairwise
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np

from common import OUT, changed, follow, show, write_rows
from mipsjax import territory
from mipsjax.compilation import enable_cache
from mipsjax.config import Config
from mipsjax.data.open import open_sequence
from mipsjax.host.metrics import absolute_error
from mipsjax.state import trajectory

AROUND = 10  # frames after a revisit


class Variant(NamedTuple):
    revisit_steps: int
    loop: bool
    registered: bool = True


VARIANTS = {
    "full": Variant(10, True),
    "no-sr": Variant(0, True),
    "no-lc": Variant(10, False),
    "no-sr-no-lc": Variant(0, False),
    "none": Variant(0, False, registered=False),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--name", default="apartment+noise")
    parser.add_argument("--frames", type=int, default=450)
    parser.add_argument("--once", action="store_true", help="not backwards")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variants", nargs="*", default=list(VARIANTS), choices=list(VARIANTS))
    options = parser.parse_args()
    enable_cache()
    count = len(options.variants)
    figure, axes = plt.subplots(count, 1, figsize=(9, 2.2 * count), sharex=True, sharey=True, squeeze=False)
    rows = []
    for title, axis in zip(options.variants, axes[:, 0], strict=True):
        variant = VARIANTS[title]
        cfg = changed(Config(seed=options.seed), "map", revisit_steps=variant.revisit_steps)
        cfg = changed(cfg, "loop", enabled=variant.loop)
        with nullcontext() if variant.registered else unregistered():
            rpe, active, ate = trial(options.name, options.frames, options.once, cfg)
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
                "ate_cm": ate,
            }
        )
        show(rows[-1])
        write_rows("revisit", rows)
        axis.plot(rpe, linewidth=0.8)
        for i in entered:
            axis.axvline(i, color="red", linestyle="--", linewidth=0.8)
        axis.set(ylabel="RPE, cm", title=title)
    axes[-1, 0].set_xlabel("frame; red: a known submap is entered again")
    figure.tight_layout()
    figure.savefig(OUT / "revisit.png", dpi=110)


@contextmanager
def unregistered() -> Iterator[None]:
    """Frames are linked to other submaps at the pose that was guessed, as if they had not been registered there."""
    original = territory.sight

    def sight(state, place, keyframe, guess, cfg, measured=False):
        found = original(state, place, keyframe, guess, cfg, measured)
        return None if found is None else found._replace(T_sub_cam=guess)

    territory.sight = sight
    try:
        yield
    finally:
        territory.sight = original


def trial(name: str, count: int, once: bool, cfg: Config) -> tuple[np.ndarray, list[int], float]:
    """RPE of each frame (cm), the submap of each, and ATE (cm)."""
    sequence = open_sequence(f"synth:{name}", frames=slice(0, count), input=cfg.input)
    count = len(sequence)
    order = [*range(count), *([] if once else range(count - 2, -1, -1))]
    truth = sequence.T_world_cam[order]
    state = follow((sequence[i] for i in order), sequence.intrinsics, cfg, truth[0])
    poses = trajectory(state)
    moves, true_moves = (np.linalg.inv(p[:-1]) @ p[1:] for p in (poses, truth))
    rpe = 100 * np.linalg.norm((np.linalg.inv(true_moves) @ moves)[:, :3, 3], axis=1)
    return rpe, [record.submap for record in state.records], 100 * absolute_error(poses, truth).rmse_m


if __name__ == "__main__":
    main()
