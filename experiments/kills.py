"""A run that is killed again and again, and resumed each time, against the same run left alone.

    python experiments/kills.py [SEQUENCE] [--kills 20] [--seed 0] [--options ...]

The first run is not killed, and says how long it takes. Then runs are ended by SIGKILL after random times, `--kills`
times in all, and each is resumed from its last checkpoint, or begun anew where there is none yet, until it comes to its
end; the next one then begins. Writes `experiments/out/kills.csv`: a row a kill, after how many seconds it came and how
large the newest checkpoint was, and a row for each run that came to its end, whether trajectory, mesh and loops are the
same to the byte. Exits with 1 where one is not.
"""

from __future__ import annotations

import argparse
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from common import show, write_rows

COMPARED = "trajectory.txt", "mesh.ply", "loops.json"
GRACE_S = 600
"""A resumed run has this many seconds more than the whole run took before it counts as stuck."""


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "mipsjax.run", *arguments, "--quiet"]


def whole_run(sequence: str, options: list[str], folder: Path) -> float:
    """Seconds of a run that nobody kills."""
    began = time.perf_counter()
    subprocess.run(command(sequence, "--out", str(folder), *options), check=True)
    return time.perf_counter() - began


def killed(arguments: list[str], after_s: float) -> bool:
    """Starts a run and kills it; whether it was still running then."""
    process = subprocess.Popen(command(*arguments))
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.wait()
        return True
    if process.returncode:
        raise SystemExit(f"the run ended with exit code {process.returncode}")
    return False


def newest_checkpoint(folder: Path) -> tuple[str, int]:
    """Name and bytes of the newest checkpoint; an empty name where there is none yet."""
    files = sorted((folder / "checkpoint").glob("*.npz"), key=lambda file: file.stat().st_mtime)
    return (files[-1].name, files[-1].stat().st_size) if files else ("", 0)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", nargs="?", default="synth:apartment")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--options", nargs=argparse.REMAINDER, default=["--preset", "tiny", "--frames", "::4"]
    )
    chosen = parser.parse_args()
    rng = np.random.default_rng(chosen.seed)
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        whole, broken = Path(temporary) / "whole", Path(temporary) / "broken"
        seconds = whole_run(chosen.sequence, chosen.options, whole)
        fresh = [chosen.sequence, "--out", str(broken), *chosen.options]
        arguments, kills = fresh, 0
        while kills < chosen.kills or arguments is not fresh:
            # Every moment is as likely, from the start of the process to the writing of the mesh
            after_s = float(rng.uniform(0, seconds)) if kills < chosen.kills else seconds + GRACE_S
            if killed(arguments, after_s):
                kills += 1
                name, size = newest_checkpoint(broken)
                rows.append({"kill": kills, "after_s": after_s, "checkpoint": name, "bytes": size})
                # Killed before it had a checkpoint, it is begun anew, as `--resume` says
                arguments = ["--resume", str(broken)] if name else fresh
            else:
                same = all((whole / name).read_bytes() == (broken / name).read_bytes() for name in COMPARED)
                rows.append({"kill": "", "after_s": after_s, "same": same})
                shutil.rmtree(broken)
                arguments = fresh
            show(rows[-1])
    same = all(row["same"] for row in rows if "same" in row)
    write_rows("kills", rows)
    sys.exit(0 if same else 1)


if __name__ == "__main__":
    main()
