"""Whether two programs give the same bytes: the trajectory and the mesh of the same sequences by two checkouts.

    python experiments/same.py BEFORE AFTER [--only living ...]

For what moves code and means to change nothing. Each run is a process, those of the two checkouts at once, held to one
core each. Writes `experiments/out/same.csv`, a row a sequence, with the digests of both; exits with 1 where they
differ.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from common import DATA, code, show, write_rows

RUNS: dict[str, list[str]] = {
    "tiny": ["synth:tiny", "--preset", "tiny"],
    "room": ["synth:room", "--frames", ":45"],
    "redkitchen": [str(DATA / "redkitchen"), "--frames", "::8"],
    "living": [str(DATA / "small_house" / "living")],
    "apartment+noise": ["synth:apartment+noise"],
}
WRITTEN = "trajectory.txt", "mesh.ply"
SHOWN = 12
"""Letters of a digest."""


def digests(checkout: Path, arguments: list[str], core: int) -> dict[str, str]:
    """Digests of what one program writes."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "run"
        subprocess.run(
            [sys.executable, "-m", "mipsjax.run", *arguments, "--out", str(folder), "--quiet"],
            env=os.environ | {"PYTHONPATH": str(checkout / "src")},
            preexec_fn=lambda: os.sched_setaffinity(0, {core}),
            check=True,
        )
        return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest()[:SHOWN] for name in WRITTEN}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--only", nargs="*", choices=RUNS, default=list(RUNS))
    chosen = parser.parse_args()
    checkouts = [chosen.before.resolve(), chosen.after.resolve()]
    before, after = (code(source=checkout / "src") for checkout in checkouts)
    rows = []
    with ThreadPoolExecutor(2) as pool:
        for name in chosen.only:
            one, other = pool.map(digests, checkouts, [RUNS[name]] * 2, range(2))
            row = {"sequence": name, "before": before, "after": after}
            for file in WRITTEN:
                row |= {f"{file} before": one[file], f"{file} after": other[file]}
            rows.append(row | {"same": one == other})
            show(rows[-1])
            write_rows("same", rows)
    sys.exit(0 if all(row["same"] for row in rows) else 1)


if __name__ == "__main__":
    main()
