"""The encodings beside each other: sinusoids, hash grid, one network fed with both, and both side by side.

    python experiments/encodings.py [--encodings frequency hash joint both] [--seeds 0] [--strides 1 4 8 16]
                                    [--rooms room room+noise room-fast room-fast+noise+blur] [--name encodings]

Each with everything else as in the default. Writes `NAME.csv`: a row a run, ATE RMSE after rigid alignment.
The basin of each is measured by `basin.py --encodings ...`, the surface by this script's rows on `synth:room`.
"""

from __future__ import annotations

import argparse

from common import changed, run, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from surface import surface_row
from tracking import kitchen

ROOMS = ("room", "room+noise", "room-fast", "room-fast+noise+blur")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--encodings", nargs="*", default=["frequency", "hash", "joint", "both"])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--strides", type=int, nargs="*", default=[1, 4, 8, 16])
    parser.add_argument("--rooms", nargs="*", default=list(ROOMS))
    parser.add_argument("--name", default="encodings", help="of the table")
    options = parser.parse_args()
    enable_cache()
    rows = []
    for encoding in options.encodings:
        cfg = changed(Config(), "field", encoding=encoding)
        for seed in options.seeds:
            for stride in options.strides:
                rows.append({"encoding": encoding} | kitchen(stride, seed, cfg))
                show(rows[-1])
                write_rows(options.name, rows)
            for name in options.rooms:
                done = run(f"synth:{name}", cfg, seed=seed)
                rows.append({"encoding": encoding} | done.row | surface_row(done, cfg))
                show(rows[-1])
                write_rows(options.name, rows)


if __name__ == "__main__":
    main()
