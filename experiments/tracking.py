"""Tracking accuracy and speed: the real kitchen at four camera speeds, and the fast synthetic room.

    python experiments/tracking.py [--seeds 0 1 2] [--strides 1 4 8 16] [--without-ro] [--synth] [--name tracking]

Writes `NAME.csv`: a row a run, ATE RMSE after rigid alignment, statuses, frames a second without the first
frames (compilation), peak memory of the process so far.
"""

from __future__ import annotations

import argparse
from typing import Any

from common import DATA, changed, run, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.presets import preset
from mipsjax.config.sections import Config

SYNTH = ("room-fast", "room-fast+noise+blur")


def kitchen(stride: int, seed: int, cfg: Config, stop: int = 1000) -> dict[str, Any]:
    return run(str(DATA / "redkitchen"), cfg, frames=slice(0, stop, stride), seed=seed).row


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--strides", type=int, nargs="*", default=[1, 4, 8, 16])
    parser.add_argument("--without-ro", action="store_true", help="also the fastest stride without RO")
    parser.add_argument("--synth", action="store_true", help="also the fast synthetic room")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--stop", type=int, default=1000, help="frames of the kitchen")
    parser.add_argument("--name", default="tracking", help="of the table")
    options = parser.parse_args()
    enable_cache()
    cfg = preset(options.preset)
    rows = []

    def add(name: str, row: dict[str, Any]) -> None:
        rows.append({"method": name} | row)
        show(rows[-1])
        write_rows(options.name, rows)

    for seed in options.seeds:
        for stride in sorted(options.strides, reverse=True):
            add(options.preset, kitchen(stride, seed, cfg, options.stop))
        if options.without_ro:
            add("no RO", kitchen(max(options.strides), seed, changed(cfg, "track.ro", when="never")))
        for name in SYNTH if options.synth else ():
            add(options.preset, run(f"synth:{name}", cfg, seed=seed).row)


if __name__ == "__main__":
    main()
