"""A second recording in the saved map of a first one: localised, and learned from.

    python experiments/continued.py [SEQUENCE] [--begins 0 200 400]

The first recording is every second frame of the sequence, the second the frames between them, from several places on:
no frame is in both. Writes `continued.csv`, a row for each place and for `localise` and `step`: whether the first frame
was found at once, how far off it is in the world, and the errors of all frames after it, none of which is aligned.
`map_bytes_same` says whether a saved map has the same bytes after `localise`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from common import run, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.presets import preset
from mipsjax.config.sections import Config
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Sequence
from mipsjax.slam import step as slam
from mipsjax.slam.finish import finish
from mipsjax.slam.localise import continued, localise
from mipsjax.submaps.saved import load, save
from mipsjax.submaps.state import SlamState, Status, trajectory

FRAMES = 150
"""Of the second recording, from each place on."""


def looked(
    state: SlamState, between: Sequence, begin: int, learn: bool, cfg: Config
) -> tuple[SlamState, dict[str, Any]]:
    """The state after one second recording, and its row. Frames before it is found do not count among the errors."""
    end, infos = min(begin + FRAMES, len(between)), []
    for position in range(begin, end):
        frame = between[position]
        state, info = slam.step(state, frame, cfg) if learn else localise(state, frame, cfg)
        infos.append(info)
    true = between.T_world_cam
    assert true is not None
    online = trajectory(state)
    if learn:
        state = finish(state, cfg)
    metres = np.linalg.norm(trajectory(state)[:, :3, 3] - true[begin:end, :3, 3], axis=1)
    statuses = [record.status for record in state.records[state.first :]]
    return state, {
        "begins_at": begin,
        "how": "step" if learn else "localise",
        "frames": end - begin,
        "found_at_once": infos[0].found == "again",
        "first_off_cm": 100 * float(np.linalg.norm(online[0, :3, 3] - true[begin, :3, 3])),
        "rmse_cm": 100 * float(np.sqrt(np.nanmean(metres**2))),
        "largest_cm": 100 * float(np.nanmax(metres)),
        "lost": sum(status is Status.LOST for status in statuses),
        "submaps_used": len({info.submap for info in infos}),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", nargs="?", default="synth:apartment+noise")
    parser.add_argument("--begins", type=int, nargs="*", default=[0, 200, 400])
    options = parser.parse_args()
    enable_cache()
    cfg, rows = preset("default"), list[dict[str, Any]]()
    first = run(options.sequence, cfg, frames=slice(None, None, 2))
    between = open_sequence(options.sequence, frames=slice(1, None, 2), input=cfg.input)
    with TemporaryDirectory() as folder:
        kept, again = Path(folder) / "map.npz", Path(folder) / "again.npz"
        save(first.state, kept)
        for begin in options.begins:
            for learn in (False, True):
                state = load(kept)
                found = continued(state, between.intrinsics)
                row = {"sequence": first.row["sequence"], "map_ate_cm": first.row["ate_cm"]}
                end, found_out = looked(found, between, begin, learn, cfg)
                row |= found_out
                # Its records grow; of the map itself nothing may change
                save(state._replace(submaps=end.submaps), again)
                row["map_bytes_same"] = kept.read_bytes() == again.read_bytes()
                row["map_mb"] = kept.stat().st_size / 1e6
                show(row)
                rows.append(row)
    print(write_rows("continued", rows))


if __name__ == "__main__":
    main()
