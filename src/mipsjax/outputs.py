"""Everything a run writes: one folder, claimed before the first frame, each file there whole or not at all.

`metrics.json` is written last; a folder that has one holds a finished run and is never written into again.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import platform
import socket
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np
import trimesh

from mipsjax.config import Config
from mipsjax.data.sequence import Sequence
from mipsjax.data.trajectory import write_tum
from mipsjax.errors import OutputError
from mipsjax.files import write_atomically
from mipsjax.host.meshing import export_ply
from mipsjax.host.picture import save_picture, up_direction
from mipsjax.options import to_dict
from mipsjax.policy import Status
from mipsjax.state import FrameInfo, SlamState, trajectory
from mipsjax.summary import SCHEMA_VERSION, FrameRow, Run, loop_rows, metrics_content, verdict

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

RUNS = Path("runs")
"""Where runs without --out go."""
LOCK = ".lock"
FINISHED = ("metrics.json", "trajectory.txt", "mesh.ply")
"""A folder with one of these holds results."""
PACKAGES = (
    "mipsjax", "jax", "jaxlib", "jaxlie", "optax", "numpy", "scipy", "opencv-python-headless", "trimesh",
    "scikit-image", "gtsam",
)  # fmt: skip
"""Whose versions can change a result."""


def choose_folder(name: str, out: Path | None, source: Path | None) -> Path:
    """The folder for a run's results: `out`, or `runs/<name>`, or the first free `runs/<name>-2` and so on.

    `source` is the input's folder or file, None for a built-in sequence.

    Raises:
        OutputError: `out` holds results already, or lies in the input.
    """
    if out is None:
        base = RUNS / (name.replace(os.sep, "-") or "sequence")
        numbered = (base.with_name(f"{base.name}-{number}") for number in range(2, 1_000_000))
        out = (
            base
            if not _has_results(base)
            else next(folder for folder in numbered if not _has_results(folder))
        )
    elif _has_results(out):
        raise OutputError(f"{out}: has the results of a finished run; choose another --out or move them away")
    if source is not None and out.resolve().is_relative_to(source.resolve()):
        raise OutputError(
            f"{out}: lies in the input {source}, which is never written to; choose another --out"
        )
    return out


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Makes a folder and holds its lock, which the system frees however the process ends.

    Raises:
        OutputError: the folder cannot be made or written, or another run has it.
    """
    made = not os.path.exists(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = _lock(folder / LOCK)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: cannot be written ({reason}); choose another --out") from error
    try:
        yield
    finally:
        (folder / LOCK).unlink(missing_ok=True)
        os.close(lock)
        if made:
            _remove_if_empty(folder)


def write_results(
    folder: Path,
    run: Run,
    mesh: trimesh.Trimesh | None,
    seconds: dict[str, float],
    notes: Iterable[str],
) -> dict[str, Any]:
    """Writes all but config.json and returns the content of metrics.json. `run` has a state.

    Args:
        folder: a claimed folder.
        run: the frames and the map.
        mesh: world frame; None if none was wanted.
        seconds: duration of each stage of the program beside the frames, such as `open` and `mesh`.
        notes: warnings that came up, for events.jsonl.

    Raises:
        OutputError: the disk is full or the folder not writable.
    """
    assert run.state is not None
    poses = trajectory(run.state)
    stamps = np.array([record.timestamp for record in run.state.records])
    write_tum(folder / "trajectory.txt", stamps, poses)
    if run.T_truth_cam is not None:
        write_tum(folder / "trajectory_gt.txt", stamps, run.T_truth_cam)
    if mesh is not None:
        export_ply(folder / "mesh.ply", mesh)
        save_picture(folder / "mesh.png", mesh, up_direction(poses))
    write_atomically(folder / "status.csv", status_csv(run.rows).encode())
    write_atomically(folder / "events.jsonl", events_jsonl(run, notes).encode())
    write_json(folder / "loops.json", loops_content(run.state))
    content = metrics_content(run, mesh, seconds)
    write_json(folder / "metrics.json", content)
    return content


def write_config(folder: Path, cfg: Config, options: dict[str, Any], sequence: Sequence) -> None:
    """Writes config.json: everything resolved. Raises OutputError."""
    content = {
        "schema_version": SCHEMA_VERSION,
        "options": options,
        "sequence": {
            "name": sequence.name,
            "layout": sequence.layout,
            "frames": len(sequence),
            "intrinsics": sequence.intrinsics._asdict(),
        },
        "config": to_dict(cfg),
        "seed": cfg.seed,
        "versions": {name: _version(name) for name in PACKAGES},
        "python": platform.python_version(),
        "platform": platform.platform(),
        "device": str(jax.devices()[0]),
    }
    write_json(folder / "config.json", content)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes JSON in which NaN and infinity are null. Raises OutputError."""
    write_atomically(path, (json.dumps(_finite(content), indent=2, allow_nan=False) + "\n").encode())


def loops_content(state: SlamState) -> dict[str, Any]:
    """Every loop that was found, kept or not."""
    return {"schema_version": SCHEMA_VERSION, "loops": loop_rows(state)}


def status_csv(rows: tuple[FrameRow, ...]) -> str:
    """One line a frame; a number that is not known is left empty."""
    *names, note = FrameInfo._fields
    names += ["deviation_m", "deviation_deg", note]
    names[:2] = ["residual_before_m", "residual_after_m"]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["index", "timestamp", "status", *names])
    for row in rows:
        *numbers, note = row.info
        cells = (_cell(value) for value in (*numbers, row.deviation_m, row.deviation_deg, note))
        writer.writerow([row.number, f"{row.timestamp:.6f}", row.status, *cells])
    return out.getvalue()


def events_jsonl(run: Run, notes: Iterable[str]) -> str:
    """What a reader of the results should know, one JSON object a line, frames in order."""
    events: list[dict[str, Any]] = [{"event": "note", "text": note} for note in run.sequence.notes]
    last = Status.OK
    for row in run.rows:
        where = {"index": row.number, "timestamp": row.timestamp}
        if row.status is Status.LOST:
            events.append({"event": "lost", **where, "reason": row.info.note})
        elif row.status is Status.SKIPPED:
            events.append({"event": "bad_frame", **where, "reason": row.info.note})
        elif row.info.note:
            events.append({"event": "note", **where, "text": row.info.note})
        if row.info.found:
            events.append({"event": f"found {row.info.found}", **where, "submap": row.info.submap})
        if last is Status.LOST and row.status in (Status.OK, Status.WEAK):
            events.append({"event": "recovered", **where})
        last = last if row.status is Status.SKIPPED else row.status
    events += [{"event": "warning", "text": note} for note in notes]
    events.append({"event": "end", "how": run.end, "status": verdict(run.rows, run.agreement)})
    return "".join(json.dumps(_finite(event), allow_nan=False) + "\n" for event in events)


def _lock(path: Path) -> int:
    """An open, locked file that says who holds it. Raises OutputError if another run does."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            if fcntl is not None:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(handle, 100).decode(errors="replace").strip()
            os.close(handle)
            raise OutputError(
                f"{path.parent}: in use by another run ({holder}); choose another --out"
            ) from error
        except OSError:  # a file system without locks: two runs at once cannot be told there
            pass
        # The last holder may have removed the file after it was opened here
        if path.exists() and os.path.samestat(os.fstat(handle), path.stat()):
            os.ftruncate(handle, 0)
            os.write(handle, f"process {os.getpid()} on {socket.gethostname()}\n".encode())
            return handle
        os.close(handle)


def _has_results(folder: Path) -> bool:
    return any(os.path.exists(folder / name) for name in FINISHED)


def _remove_if_empty(folder: Path) -> None:
    """A run that ended before any result leaves no empty folder behind."""
    try:
        folder.rmdir()
    except OSError:
        return


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cell(value: Any) -> Any:
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else ""
    return value


def _finite(value: Any) -> Any:
    """The same content with None for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
