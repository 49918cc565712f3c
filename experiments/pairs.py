"""Keyframes against each other after the last frame: how well pairs are measured, and what the graph makes of them.

    python experiments/pairs.py [--seed 0] [--only NAME]
    python experiments/pairs.py --table

Of each sequence the state after the last frame, loops closed once more. A pair's error is that of the pose of the later
keyframe in the earlier one's camera, against the true poses; the median over all pairs. `ate_before_cm` and
`ate_after_cm` are of the keyframes, before and after the graph. Parts of the method are switched off one by one. Where
colour is `late`, each frame has that of the frame before it. Writes `pairs.csv`, of one sequence (`--only`) its rows
anew; `--table` prints its rows for docs/trials.md.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from common import DATA, Altered, changed, print_table, read_rows, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.presets import preset
from mipsjax.config.sections import Config
from mipsjax.core import views
from mipsjax.core.rigid import distance, inverse, rigid
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Frame, Sequence
from mipsjax.metrics.poses import absolute_error
from mipsjax.slam import step as slam
from mipsjax.slam import straighten
from mipsjax.submaps.background import with_refined
from mipsjax.submaps.closure import closed_again
from mipsjax.submaps.schedule import INLINE
from mipsjax.submaps.state import SlamState
from mipsjax.uncertainty.trust import ALLOWED, of_pair, trusted

LATE = ", colour late"
SEQUENCES = {
    "corridor_walk": 1,
    "small_house/living": 1,
    f"small_house/living{LATE}": 1,
    "synth:home-106+noise": 1,
    "redkitchen": 8,
}
"""With every how many frames."""
FORMS = ("as it is", "no brightness", "2304 points", "planes up to 5 mm", "all trust")


def late(sequence: Sequence, place: int) -> Frame:
    """With the colour of the frame before it."""
    return sequence[place]._replace(color=sequence[max(place - 1, 0)].color)


def travelled(name: str, stride: int, cfg: Config) -> tuple[SlamState, np.ndarray]:
    """The state before keyframes are moved, and the true poses of all frames."""
    path = name if ":" in name else str(DATA / name.removesuffix(LATE))
    sequence = open_sequence(path, frames=slice(None, None, stride), input=cfg.input)
    true = sequence.T_world_cam
    assert true is not None
    sequence = Altered(sequence, late) if name.endswith(LATE) else sequence
    state, _ = slam.start(sequence[0], sequence.intrinsics, cfg, true[0])
    for place in range(1, len(sequence)):
        state, _ = slam.step(state, sequence[place], cfg)
    return closed_again(with_refined(state, INLINE, cfg), cfg), true


def row(state: SlamState, true: np.ndarray, form: str, cfg: Config) -> dict[str, Any]:
    """All pairs measured in one form of the method."""
    even = views.NOISE
    if form == "2304 points":
        cfg = changed(cfg, "pairs", pixels=2304)
    if form == "no brightness":
        cfg = changed(cfg, "track.brightness", weight=0.0)
    if form == "planes up to 5 mm":
        views.NOISE = 0.0
        jax.clear_caches()
    nodes = straighten._keyframes(state)
    poses = np.stack([node.T_world_cam for node in nodes])
    true = true[[node.keyframe.id for node in nodes]]
    pairs = [straighten._followed(nodes, *places, state, cfg) for places in straighten._near(poses, cfg)]
    measured = straighten._measured(nodes, pairs, 1.0, state, cfg)
    said = [found for i in range(len(pairs)) if (found := of_pair(measured, i)) is not None]
    trust = 1.0 if form == "all trust" else trusted(said, ALLOWED)
    if trust < 1:
        measured = straighten._measured(nodes, pairs, trust, state, cfg)
    factors = list(straighten._pair_factors(pairs, measured, cfg))
    factors += straighten._as_tracked(poses, {factor.second for factor in factors}, cfg)
    factors += straighten._link_factors(state, [node.keyframe.id for node in nodes], cfg)
    solved = straighten._solved(poses, factors)
    if form == "planes up to 5 mm":
        views.NOISE = even
        jax.clear_caches()
    off = [
        distance(inverse(true[pair.first]) @ true[pair.second], rigid(T))
        for pair, T in zip(pairs, measured.T_first_second, strict=True)
    ]
    metres, radians = np.median(off, axis=0)
    return {
        "form": form,
        "keyframes": len(nodes),
        "pairs": len(pairs),
        "matched": float(np.median(measured.matched)),
        "error_cm": 100 * float(metres),
        "error_deg": float(np.degrees(radians)),
        "contradiction": float(np.median([pair.contradiction(1.0) for pair in said])),
        "trust": trust,
        "ate_before_cm": 100 * absolute_error(poses, true).rmse_m,
        "ate_after_cm": 100 * absolute_error(poses if solved is None else solved, true).rmse_m,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=SEQUENCES)
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    if options.table:
        print_table("pairs")
        return
    enable_cache()
    cfg = replace(preset("default"), seed=options.seed)
    rows = {(known["sequence"], known["form"]): known for known in read_rows("pairs")} if options.only else {}
    for name in [options.only] if options.only else SEQUENCES:
        state, true = travelled(name, SEQUENCES[name], cfg)
        for form in FORMS:
            rows[name, form] = {"sequence": name, "every": SEQUENCES[name]} | row(state, true, form, cfg)
            show(rows[name, form])
            write_rows("pairs", rows.values())


if __name__ == "__main__":
    main()
