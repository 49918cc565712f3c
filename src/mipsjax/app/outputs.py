"""Everything a run writes into its folder, each file there whole or not at all.

All but the mesh is written before the mesh is made, and `metrics.json` last of it, and again with the mesh. Which
folder that is, and that nobody else has it, is up to `app/results_folder.py`.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import trimesh

from mipsjax.app.results_folder import CONFIG
from mipsjax.app.summary import SCHEMA_VERSION, FrameRow, Run, loop_rows, metrics_content, verdict
from mipsjax.config.options import to_dict
from mipsjax.config.sections import Config
from mipsjax.data.open import SYNTH_PREFIX
from mipsjax.data.sequence import Sequence
from mipsjax.data.trajectory import write_tum
from mipsjax.files import write_atomically
from mipsjax.mesh.picture import save_picture, up_direction
from mipsjax.mesh.ply import DOUBLE_FROM_M, export_ply
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.state import SlamState, Status, trajectory

Meshing = Literal["none", "unfinished", "done"]
"""Of a mesh: not wanted, not made or not made to its end, there."""
PACKAGES = (
    "mipsjax", "jax", "jaxlib", "jaxlie", "optax", "numpy", "scipy", "opencv-python-headless", "trimesh",
    "scikit-image", "gtsam", "optimistix", "lineax", "equinox",
)  # fmt: skip
"""Whose versions can change a result."""


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
    stamps = np.array([row.timestamp for row in run.rows[len(run.waited) :]])
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
    """Every loop that was found in this recording, kept or not."""
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
        writer.writerow([row.frame, f"{row.timestamp:.6f}", str(row.status), *cells])
    return out.getvalue()


def events_jsonl(run: Run, notes: Iterable[str]) -> str:
    """What a reader of the results should know, one JSON object a line, frames in order."""
    events: list[dict[str, Any]] = [{"event": "note", "text": note} for note in run.sequence.notes]
    last = Status.OK
    for row in run.rows:
        where = {"index": row.frame, "timestamp": row.timestamp}
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


def _around_origin(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh moved to the origin where it lies so far away that a picture of it would have steps."""
    if len(mesh.vertices) == 0 or np.abs(mesh.vertices).max() <= DOUBLE_FROM_M:
        return mesh
    moved = mesh.copy()
    moved.vertices = mesh.vertices - np.rint(mesh.vertices.mean(axis=0))
    return moved


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
    if isinstance(value, str):  # the name of a file may hold anything
        return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in value)
    return value


def _finite(value: Any) -> Any:
    """The same content with None for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
