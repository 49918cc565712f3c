"""Everything a run writes: one folder, claimed before the first frame, each file there whole or not at all.

All but the mesh is written before the mesh is made, and `metrics.json` last of it, and again with the mesh. A folder
that has one holds the results of a run and is never written into again by another, unless that was cut short and goes
on.
"""

from __future__ import annotations

import csv
import errno
import io
import json
import math
import os
import platform
import re
import socket
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import trimesh

from mipsjax.app.checkpoint import FOLDER, written
from mipsjax.app.summary import SCHEMA_VERSION, FrameRow, Run, loop_rows, metrics_content, verdict
from mipsjax.config.options import to_dict
from mipsjax.config.sections import Config
from mipsjax.data.open import SYNTH_PREFIX
from mipsjax.data.sequence import Sequence
from mipsjax.data.trajectory import write_tum
from mipsjax.errors import OutputError
from mipsjax.files import write_atomically
from mipsjax.mesh.meshing import DOUBLE_FROM_M, export_ply
from mipsjax.mesh.picture import save_picture, up_direction
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.state import SlamState, Status, trajectory

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

Meshing = Literal["none", "unfinished", "done"]
"""Of a mesh: not wanted, not made or not made to its end, there."""
RUNS = Path("runs")
"""Where runs without --out go."""
LOCK = ".lock"
CONFIG = "config.json"
FILES = (
    CONFIG, "trajectory.txt", "trajectory_gt.txt", "status.csv", "events.jsonl", "loops.json", "metrics.json",
    "mesh.ply", "mesh.png",
)  # fmt: skip
"""All that a run writes."""
OF_OURS = {"schema_version", "options", "sequence", "config", "versions"}
"""Keys by which a config.json is known to be one of a run."""
LARGEST_CONFIG_BYTES = 1 << 20
HOLDER = b"process "
"""What a lock of a run begins with."""
HOLDER_BYTES = 100
"""Of a lock that are read."""
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
        OutputError: `out` holds results or checkpoints already or files of somebody else, or lies in the input.
    """
    if out is None:
        base = RUNS / (name.replace(os.sep, "-") or "sequence")
        numbered = (base.with_name(f"{base.name}-{number}") for number in range(2, 1_000_000))
        out = base if _is_free(base) else next(folder for folder in numbered if _is_free(folder))
    elif written(out) and is_ours(out):
        raise OutputError(
            f"{out}: has a run that was cut short; go on with --resume {out} or choose another --out"
        )
    elif _is_taken(out):
        raise OutputError(f"{out}: has the results of a finished run; choose another --out or move them away")
    elif found := foreign(out):
        raise OutputError(f"{out}: has {found} that no run of ours wrote; choose another --out")
    if source is not None and _resolved(out).is_relative_to(source.resolve()):
        raise OutputError(
            f"{out}: lies in the input {source}, which is never written to; choose another --out"
        )
    return out


def _resolved(out: Path) -> Path:
    """Without links. Raises OutputError where these lead round in a circle."""
    try:
        # From Python 3.13 on `resolve` gives a path of such a circle, too
        if _is_circle(out):
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        return out.resolve()
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{out}: its links lead nowhere ({error}); choose another --out") from error


def _is_circle(path: Path) -> bool:
    """Whether links lead from a path round in a circle."""
    try:
        path.stat()
    except OSError as error:
        return error.errno == errno.ELOOP
    return False


def is_ours(folder: Path) -> bool:
    """Whether a run has begun in a folder: it has a config.json as `write_config` writes it."""
    path = folder / CONFIG
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > LARGEST_CONFIG_BYTES:
            return False
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.keys() >= OF_OURS


def foreign(folder: Path) -> str:
    """The first name in a folder that a run would write to and must not, being somebody else's; empty if there is
    none. In a folder of ours all regular files of these names are ours."""
    ours = is_ours(folder)
    for name in FILES:
        path = folder / name
        if os.path.lexists(path) and not (ours and path.is_file() and not path.is_symlink()):
            return name
    kept = folder / FOLDER
    if os.path.lexists(kept) and not (ours and kept.is_dir() and not kept.is_symlink()):
        return FOLDER
    return "" if _may_be_a_lock(folder / LOCK) else LOCK


def sibling(folder: Path) -> Path:
    """A new folder beside another, with a number behind its name. Raises OutputError."""
    for number in range(2, 1_000_000):
        path = folder.with_name(f"{folder.name}-{number}")
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            continue
        except OSError as error:
            raise OutputError(f"{path}: cannot be made ({error.strerror or error})") from error
    raise OutputError(f"{folder}: too many folders of this name")


@contextmanager
def claimed(folder: Path) -> Iterator[Callable[[], bool]]:
    """Makes a folder and holds its lock, which the system frees however the process ends.

    Gives a function that says whether the folder of this name is still the one that was claimed: it may be deleted,
    and made again by another run, at any time.

    Raises:
        OutputError: the folder cannot be made or written, or another run has it.
    """
    made = not os.path.exists(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = _lock(folder / LOCK)
        _remove_parts(folder)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: cannot be written ({reason}); choose another --out") from error
    try:
        yield lambda: _same_file(lock, folder / LOCK)
    finally:
        # While it is still held: once it is free, a file of this name may be another run's
        if _same_file(lock, folder / LOCK):
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
    meshing: Meshing = "none",
) -> dict[str, Any]:
    """Writes all but config.json and returns the content of metrics.json. `run` has a state.

    To be called before the mesh is made, so that nothing that happens to the mesh loses the rest, and again with it.

    Args:
        folder: a claimed folder.
        run: the frames and the map.
        mesh: world frame; None if none was wanted, or as long as there is none.
        seconds: duration of each stage of the program beside the frames, such as `open` and `mesh`.
        notes: warnings that came up, for events.jsonl.
        meshing: whether there is a mesh, for metrics.json.

    Raises:
        OutputError: the disk is full or the folder not writable.
    """
    assert run.state is not None
    poses = trajectory(run.state)
    stamps = np.array([record.timestamp for record in run.state.records])
    write_tum(folder / "trajectory.txt", stamps, poses)
    if run.T_truth_cam is not None:
        write_tum(folder / "trajectory_gt.txt", stamps, run.T_truth_cam)
    write_atomically(folder / "status.csv", status_csv(run.rows).encode(errors="backslashreplace"))
    write_atomically(folder / "events.jsonl", events_jsonl(run, notes).encode())
    write_json(folder / "loops.json", loops_content(run.state))
    if mesh is None:
        # That of the part of a run that was interrupted here, and went on
        (folder / "mesh.ply").unlink(missing_ok=True)
        (folder / "mesh.png").unlink(missing_ok=True)
    else:
        export_ply(folder / "mesh.ply", mesh)
        save_picture(folder / "mesh.png", _around_origin(mesh), up_direction(poses))
    content = metrics_content(run, mesh, seconds) | {"mesh": meshing}
    write_json(folder / "metrics.json", content)
    return content


def write_config(folder: Path, cfg: Config, options: dict[str, Any], sequence: Sequence) -> None:
    """Writes config.json: everything resolved. Raises OutputError."""
    content = {
        "schema_version": SCHEMA_VERSION,
        "options": options,
        "sequence": {
            "source": _source(options["sequence"]),
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
    write_json(folder / CONFIG, content)


def _source(given: str) -> str:
    """What was opened, whatever folder one is in."""
    return given if given.startswith(SYNTH_PREFIX) else os.path.abspath(given)


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
        writer.writerow([row.number, f"{row.timestamp:.6f}", str(row.status), *cells])
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
        # Whether the camera is lost is not known of a skipped frame
        last = last if row.status is Status.SKIPPED else row.status
    events += [{"event": "warning", "text": note} for note in notes]
    events.append({"event": "end", "how": run.end, "status": verdict(run.rows, run.agreement)})
    return "".join(json.dumps(_finite(event), allow_nan=False) + "\n" for event in events)


def _lock(path: Path) -> int:
    """An open, locked file that says who holds it. Raises OutputError if another run does."""
    while True:
        if not _may_be_a_lock(path):
            raise OutputError(f"{path}: is no lock of a run; choose another --out or move it away")
        # A link is not followed, not even one made a moment ago
        handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            if fcntl is not None:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(handle, HOLDER_BYTES).decode(errors="replace").strip()
            os.close(handle)
            raise OutputError(
                f"{path.parent}: in use by another run ({holder}); choose another --out"
            ) from error
        except OSError:  # a file system without locks: two runs at once cannot be told there
            pass
        # The last holder may have removed the file after it was opened here
        if _same_file(handle, path):
            os.ftruncate(handle, 0)
            os.write(handle, HOLDER + f"{os.getpid()} on {socket.gethostname()}\n".encode())
            return handle
        os.close(handle)


def _around_origin(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh moved to the origin where it lies so far away that a picture of it would have steps."""
    if len(mesh.vertices) == 0 or np.abs(mesh.vertices).max() <= DOUBLE_FROM_M:
        return mesh
    moved = mesh.copy()
    moved.vertices = mesh.vertices - np.rint(mesh.vertices.mean(axis=0))
    return moved


def _may_be_a_lock(path: Path) -> bool:
    """Whether there is nothing of this name, or a file that a run has locked once."""
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return False
        with path.open("rb") as file:
            start = file.read(HOLDER_BYTES)
    except OSError:  # there is none, or opening it will say why
        return True
    return not start or start.startswith(HOLDER)


def _same_file(handle: int, path: Path) -> bool:
    """Whether an open file is still the one of this name."""
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except OSError:
        return False


def _remove_parts(folder: Path) -> None:
    """Halves of our files, which a process that was killed left. Nobody else writes here now."""
    names = "|".join(re.escape(name) for name in FILES)
    pattern = re.compile(rf"\.({names})\.[a-z0-9_]{{8}}\.part")
    for path in folder.iterdir():
        if pattern.fullmatch(path.name) and stat.S_ISREG(path.lstat().st_mode):
            path.unlink(missing_ok=True)


def _is_free(folder: Path) -> bool:
    """Whether it has nothing that a run would overwrite."""
    return not (_is_taken(folder) or foreign(folder))


def _is_taken(folder: Path) -> bool:
    """Whether it has what another run would overwrite."""
    return _has_results(folder) or bool(written(folder))


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
