"""What holds the camera in large scenes: errors and slides with and without corners of the image in tracking.

    python experiments/held.py [--seeds 0] [--names bookstore corridor_walk] [--switches full no-corners]

Sequences are folders of the development data, or `synth:NAME`. A slide is the error of the motion over 12 frames, which
no residual shows and which alignment of the whole trajectory hides. Writes `held.csv`.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from common import DATA, Run, changed, run, show, write_rows
from mipsjax.compilation import enable_cache
from mipsjax.config import Config
from mipsjax.presets import preset
from mipsjax.state import distance, inverse, trajectory

SLIDE_FRAMES = 12


def switched(switch: str) -> Config:
    cfg = preset("default")
    return changed(cfg, "track.corners", count=0) if switch == "no-corners" else cfg


def slides(done: Run) -> dict[str, Any]:
    """Largest errors of the motion over `SLIDE_FRAMES` frames, and where the largest shift begins."""
    found, true = trajectory(done.state), done.sequence.T_world_cam
    errors = []
    for begin in range(len(found) - SLIDE_FRAMES):
        end = begin + SLIDE_FRAMES
        moved, truly = (inverse(poses[begin]) @ poses[end] for poses in (found, true))
        errors.append(distance(truly, moved))
    metres, radians = np.array(errors).T
    return {
        "slide_max_cm": 100 * float(metres.max()),
        "slide_from": int(metres.argmax()),
        "turn_max_deg": float(np.degrees(radians.max())),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--names", nargs="*", default=["bookstore", "corridor_walk"])
    parser.add_argument("--switches", nargs="*", default=["full", "no-corners"])
    options = parser.parse_args()
    enable_cache()
    rows = []
    for name in options.names:
        path = name if ":" in name else str(DATA / name)
        for switch in options.switches:
            for seed in options.seeds:
                done = run(path, switched(switch), seed=seed)
                rows.append({"switch": switch} | done.row | slides(done))
                show(rows[-1])
                write_rows("held", rows)


if __name__ == "__main__":
    main()
