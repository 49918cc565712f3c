"""Scenes of many submaps: accuracy with and without loop closure, loops found, memory of each submap.

    python experiments/large.py [--names corridor-loop+noise apartment+noise no-loop+noise living] [--seeds 0 1 2]
                                [--stride 1] [--without-loop]

`living` is `small_house/living` of the development data. ATE RMSE after rigid alignment, over all frames. Writes
`large.csv`, a row a run, and for each run a picture of the trajectory from above and the mesh.
"""

from __future__ import annotations

import argparse

import matplotlib.pyplot as plt
import numpy as np

from common import DATA, OUT, Run, changed, run, show, use_compilation_cache, write_rows
from mipsjax.config import Config
from mipsjax.host.metrics import align_rigid
from mipsjax.host.picture import save_picture
from mipsjax.reconstruct import reconstruct
from mipsjax.state import trajectory

NAMES = ("corridor-loop+noise", "apartment+noise", "no-loop+noise", "living")


def source(name: str) -> str:
    return str(DATA / "small_house" / "living") if name == "living" else f"synth:{name}"


def plan(done: Run, path: str) -> None:
    """The camera's way and the true one from above, metres; submaps by colour, anchors as dots."""
    poses, truth = trajectory(done.state)[:, :3, 3], done.sequence.T_world_cam
    assert truth is not None
    T = align_rigid(poses, truth[:, :3, 3])
    at = poses @ T[:3, :3].T + T[:3, 3]
    place = np.array([record.submap for record in done.state.records])
    figure, axes = plt.subplots(figsize=(7, 7))
    axes.plot(truth[:, 0, 3], truth[:, 2, 3], color="black", linewidth=0.8, label="true")
    axes.scatter(at[:, 0], at[:, 2], c=place, cmap="tab20", s=4)
    for submap in done.state.submaps:
        anchor = T @ submap.T_world_sub[:, 3]
        axes.plot(anchor[0], anchor[2], "o", color="red", markersize=4)
    axes.set(xlabel="x, m", ylabel="z, m", aspect="equal", title=path)
    axes.legend()
    figure.savefig(OUT / f"{path}.png", dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--names", nargs="*", default=list(NAMES))
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--without-loop", action="store_true", help="also without loop closure")
    options = parser.parse_args()
    use_compilation_cache()
    OUT.mkdir(exist_ok=True)
    rows = []
    for name in options.names:
        for seed in options.seeds:
            for loop in (True, False) if options.without_loop else (True,):
                cfg = changed(Config(), "loop", enabled=loop)
                done = run(source(name), cfg, frames=slice(0, None, options.stride), seed=seed)
                rows.append({"loop": loop} | done.row)
                show(rows[-1])
                for closed in done.state.loops:
                    print("   ", closed, flush=True)
                write_rows("large", rows)
                title = f"{name}-{seed}-{'loop' if loop else 'open'}"
                plan(done, f"plan-{title}")
                save_picture(OUT / f"mesh-{title}.png", reconstruct(done.state, cfg))


if __name__ == "__main__":
    main()
