"""What the experiments share: run a sequence in this process, measure it, write rows."""

from __future__ import annotations

import ast
import csv
import hashlib
import os
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Frame, Sequence
from mipsjax.metrics.poses import absolute_error, relative_error
from mipsjax.slam import step as slam
from mipsjax.slam.finish import finish
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.state import Pose, SlamState, keyframes, map_bytes, trajectory, world_pose

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("MIPSJAX_DATA", ROOT.parent / "shared" / "data"))  # real sequences
OUT = Path(__file__).resolve().parent / "out"
WARM_UP = 5  # frames after which the clock starts: by then everything is compiled
RATE = 30.0  # frames a second
EARLY = 200  # frames after which memory is noted, to be compared with the end
AROUND = ("app/", "run.py", "evaluate.py", "config/options.py", "config/ranges.py")
"""Of `src/mipsjax`, the program around the library: no result of an experiment follows from it."""


class Run(NamedTuple):
    state: SlamState
    online: SlamState
    """As it was after the last frame, before the adjustment that follows."""
    as_it_came: Float64[np.ndarray, "N 4 4"]
    """The world pose of each frame when it had been processed, before later ones moved it."""
    infos: list[FrameInfo]
    sequence: Sequence
    row: dict[str, Any]


def run(
    path: str,
    cfg: Config,
    *,
    frames: slice = slice(None),
    seed: int = 0,
    watch: Callable[[SlamState], None] = lambda state: None,
    see: Callable[[Sequence], Sequence] = lambda sequence: sequence,
) -> Run:
    """One whole sequence; the row holds the figures every table wants. `watch` sees the state after each frame, `see`
    makes another sequence of the one on disk.

    `fps` counts the adjustment after the last frame, `fps_online` does not; `ate_online_cm` is the error before it.
    """
    cfg = replace(cfg, seed=seed)
    sequence = see(open_sequence(path, frames=frames, input=cfg.input))
    truth = sequence.T_world_cam
    known = truth is not None and np.isfinite(truth[0]).all()
    state, info = slam.start(sequence[0], sequence.intrinsics, cfg, truth[0] if known else None)
    infos, as_it_came = [info], [world_pose(state, state.records[-1])]
    began, early = time.perf_counter(), float("nan")
    for position in range(1, len(sequence)):
        if position == WARM_UP:
            began = time.perf_counter()
        state, info = slam.step(state, sequence[position], cfg)
        infos.append(info)
        as_it_came.append(world_pose(state, state.records[-1]))
        watch(state)
        if position == EARLY:
            early = peak_mb()
    loop_seconds, loop_peak = time.perf_counter() - began, peak_mb()
    online = state
    state = finish(state, cfg)
    seconds = time.perf_counter() - began
    row = {"sequence": Path(path).name, "frames": len(sequence), "stride": frames.step or 1, "seed": seed}
    if truth is not None:
        row["ate_online_cm"] = 100 * absolute_error(trajectory(online), truth).rmse_m
    speed = {
        "fps": (len(sequence) - WARM_UP) / seconds,
        "fps_online": (len(sequence) - WARM_UP) / loop_seconds,
        f"peak_{EARLY}_mb": early,
        "peak_online_mb": loop_peak,
    }
    row |= figures(state, infos, sequence) | speed
    return Run(state, online, np.stack(as_it_came), infos, sequence, row)


class Altered:
    """A sequence of which each frame is what a function makes of the sequence and the frame's place."""

    def __init__(self, sequence: Sequence, frame: Callable[[Sequence, int], Frame]) -> None:
        self._sequence, self._frame = sequence, frame

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def __len__(self) -> int:
        return len(self._sequence)

    def __getitem__(self, place: int) -> Frame:
        return self._frame(self._sequence, place)


def follow(
    frames: Iterable[Frame],
    camera: Intrinsics,
    cfg: Config,
    T_world_cam: Pose,
    state: SlamState | None = None,
) -> SlamState:
    """The state after frames of any order, numbered and stamped anew; `T_world_cam` is the true pose of the first.

    They go on from `state`, if there is one.
    """
    for number, frame in enumerate(frames, 0 if state is None else len(state.records)):
        frame = frame._replace(number=number, timestamp=number / RATE)
        if state is None:
            state, _ = slam.start(frame, camera, cfg, T_world_cam)
            continue
        state, _ = slam.step(state, frame, cfg)
    assert state is not None
    return state


def figures(state: SlamState, infos: list[FrameInfo], sequence: Sequence) -> dict[str, Any]:
    """ATE RMSE after rigid alignment over all frames, RPE over one frame, statuses, times, memory."""
    statuses = Counter(str(record.status) for record in state.records)
    timed = infos[WARM_UP:]
    row: dict[str, Any] = {}
    if sequence.T_world_cam is not None:
        poses = trajectory(state)
        ate, rpe = absolute_error(poses, sequence.T_world_cam), relative_error(poses, sequence.T_world_cam)
        row |= {"ate_cm": 100 * ate.rmse_m, "ate_max_cm": 100 * ate.max_m, "rpe_cm": 100 * rpe.trans_rmse_m}
    return row | {
        "ok": statuses["ok"],
        "weak": statuses["weak"],
        "lost": statuses["lost"] + statuses["skipped"],
        "keyframes": keyframes(state),
        "submaps": len(state.submaps),
        "loops": sum(loop.weight > 0 for loop in state.loops),
        "ro_frames": sum(info.searched for info in timed),
        "track_ms": float(np.mean([info.track_ms for info in timed])),
        "map_ms": float(np.mean([info.map_ms for info in timed])),
        "map_bytes": map_bytes(state),
        "peak_mb": peak_mb(),
    }


def peak_mb() -> float:
    """Largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def changed(cfg: Config, section: str, **fields: Any) -> Config:
    """`cfg` with fields of one (dotted) section replaced."""
    head, _, rest = section.partition(".")
    inner = getattr(cfg, head)
    return replace(cfg, **{head: changed(inner, rest, **fields) if rest else replace(inner, **fields)})


def write_rows(name: str, rows: Iterable[Mapping[str, Any]], folder: Path = OUT) -> Path:
    """A CSV in a folder, floats to 4 digits; the columns are those of all rows together."""
    rows = [{k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows]
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(
            file, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n"
        )
        writer.writeheader()
        writer.writerows(rows)
    return path


def read_rows(name: str, folder: Path = OUT) -> list[dict[str, str]]:
    """The rows of a CSV; none where there is no such file."""
    path = folder / f"{name}.csv"
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def print_table(name: str) -> None:
    """The rows of a CSV as a table of Markdown."""
    print(table(read_rows(name)))


def table(rows: list[dict[str, str]]) -> str:
    """Rows as a table of Markdown. All have the columns of the first one."""
    if not rows:
        return ""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(row.values()) for row in rows)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def code(part: str = "mipsjax", source: Path = ROOT / "src") -> str:
    """What tells programs apart: a digest of `src/`, or of a part of it, without its comments and docstrings, and
    without `AROUND`.

    Of one version of Python: each writes down the syntax in its own way.
    """
    digest = hashlib.sha256()
    for path in sorted((source / part).rglob("*.py")):
        if path.relative_to(source / "mipsjax").as_posix().startswith(AROUND):
            continue
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                node.body = [line for line in node.body if not _is_text(line)] or [ast.Pass()]
        digest.update(f"{path.relative_to(source)} {ast.dump(tree)}".encode())
    return digest.hexdigest()[:8]


def _is_text(line: ast.stmt) -> bool:
    return (
        isinstance(line, ast.Expr)
        and isinstance(line.value, ast.Constant)
        and isinstance(line.value.value, str)
    )


def show(row: Mapping[str, Any]) -> None:
    """One line a run, at once, so that a long experiment can be watched."""
    print(
        "  ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True
    )
