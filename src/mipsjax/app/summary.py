"""A run in numbers: the content of metrics.json, each number that needs one with its protocol."""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter
from typing import Any, Literal, NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float64

from mipsjax.app.memory import peak_memory
from mipsjax.data.sequence import Sequence
from mipsjax.data.synth import SynthSequence
from mipsjax.errors import InputError, MipsjaxError, TrackingLostError
from mipsjax.metrics import surface
from mipsjax.metrics.poses import absolute_error, relative_error, translation_error
from mipsjax.slam.info import FrameInfo
from mipsjax.slam.judge import contradiction
from mipsjax.submaps.ids import FrameId
from mipsjax.submaps.links import unjoined
from mipsjax.submaps.state import (
    SlamState,
    Status,
    deviations_of,
    keyframes,
    map_bytes,
    trajectory,
)
from mipsjax.uncertainty.agreement import DEVIATIONS, DRIFT, LIMIT, Agreement

SCHEMA_VERSION = 1
"""Of the output files; rises when a key changes its meaning."""
REFERENCE_VOXEL_M = 0.02
"""Cells of the true mesh of synthetic scenes: vertices lie on the surface, only edges are cut."""
MIN_USABLE = 2
"""Frames that make a sequence."""
OUTGROWN = "the camera left the map, which is as large as --volume.max-submaps allows"
MOST_VIEWS = 60
"""Frames that decide which part of the true mesh was seen; more take long and add little."""

Verdict = Literal["ok", "degraded", "failed"]


class FrameRow(NamedTuple):
    """One frame in status.csv."""

    frame: FrameId
    """Its number in the sequence."""
    timestamp: float
    """Seconds."""
    status: Status
    info: FrameInfo
    deviation_m: float = float("nan")
    """Standard deviation of where the camera is in its submap, as tracked: before what follows the last frame."""
    deviation_deg: float = float("nan")
    """The same of how it is turned."""


class Run(NamedTuple):
    """What a run has found out, whole or cut short."""

    sequence: Sequence
    state: SlamState | None
    """None: no frame was good enough to start with."""
    waited: tuple[FrameRow, ...]
    """Frames before the first usable one."""
    infos: tuple[FrameInfo, ...]
    """What was said about each frame of this recording in the state's records."""
    read_s: tuple[float, ...]
    """Seconds to read each frame."""
    step_s: tuple[float, ...]
    """Seconds to process each frame."""
    end: Literal["done", "interrupted", "bad frames"]
    finish_s: float = 0.0
    """Seconds of the bundle adjustment after the last frame."""
    agreement: Agreement | None = None
    """Of the depth images with each other, by places in the state's records; None where it cannot be told."""

    @property
    def rows(self) -> tuple[FrameRow, ...]:
        """All frames that were read."""
        return self.waited + (() if self.state is None else _rows(self.state, self.infos))

    @property
    def T_truth_cam(self) -> Float64[np.ndarray, "N 4 4"] | None:
        """Ground truth of the processed frames."""
        if self.sequence.T_world_cam is None or self.state is None:
            return None
        # Frames before the first usable one have no record
        first = len(self.waited)
        return self.sequence.T_world_cam[first : first + len(self.infos)]


def _rows(state: SlamState, infos: tuple[FrameInfo, ...]) -> tuple[FrameRow, ...]:
    rows = []
    for record, info in zip(state.records[state.first :], infos, strict=True):
        metres, radians = deviations_of(state, record)
        row = FrameRow(record.frame, record.timestamp, record.status, info)
        rows.append(row._replace(deviation_m=metres, deviation_deg=math.degrees(radians)))
    return tuple(rows)


class Number(NamedTuple):
    """A value of metrics.json that needs its protocol beside it; None where it cannot be told."""

    value: float | int | None
    protocol: str


def verdict(rows: tuple[FrameRow, ...], agreement: Agreement | None = None) -> Verdict:
    """`failed`: lost at the end, or in more than half of the frames, or no frame after the first was usable;
    `degraded`: lost at times, or depth images contradict each other."""
    tracked = [row.status for row in rows if row.status is not Status.SKIPPED]
    lost = tracked.count(Status.LOST)
    if len(tracked) < MIN_USABLE or tracked[-1] is Status.LOST or 2 * lost > len(tracked):
        return "failed"
    contradicted = agreement is not None and agreement.begins is not None
    return "degraded" if lost or contradicted else "ok"


def failure(end: str, status: str, usable: int) -> type[MipsjaxError] | None:
    """The kind of error that a run whose results are written ends with, which has its exit code; None where they are
    whole.

    Args:
        end: how it ended, as in metrics.json.
        status: its verdict. A degraded run is none that failed.
        usable: its frames that were not skipped.
    """
    if end == "bad frames" or usable < MIN_USABLE:
        return InputError
    return TrackingLostError if status == "failed" else None


def outgrown(run: Run) -> bool:
    """Whether the camera left the map where no other submap might begin."""
    return any(info.full for info in run.infos)


def reasons(run: Run) -> list[str]:
    """Why a run is not `ok`, or might not be; empty where there is nothing to say."""
    statuses = [row.status for row in run.rows]
    lost, contradicted = statuses.count(Status.LOST), ""
    if run.agreement is not None and run.state is not None:
        contradicted = contradiction(run.state, run.agreement)
    found = [f"lost in {lost} of {len(statuses)} frames"] if lost else []
    if outgrown(run):
        found.append(OUTGROWN)
    if len(statuses) - statuses.count(Status.SKIPPED) < MIN_USABLE:
        found.append("fewer than two usable frames")
    return [*found, contradicted] if contradicted else found


def metrics_content(run: Run, mesh: trimesh.Trimesh | None, seconds: dict[str, float]) -> dict[str, Any]:
    """All numbers of metrics.json. `run` has a state."""
    assert run.state is not None
    rows, began = run.rows, perf_counter()
    numbers = {**_speed(run), "looked_through": looked_through(run), **trajectory_errors(run)}
    if mesh is not None and isinstance(run.sequence, SynthSequence):
        numbers |= surface_errors(run.sequence, run, mesh)
    stages = {
        "read": sum(run.read_s),
        "frames": sum(run.step_s),
        "finish": run.finish_s,
        **seconds,
        "evaluate": perf_counter() - began,
    }
    # Before those are added that are parts of `frames`
    total = sum(stages.values())
    stages["track"] = sum(row.info.track_ms for row in rows) / 1e3
    stages["map"] = sum(row.info.map_ms for row in rows) / 1e3
    stages["submaps"] = sum(row.info.order_ms for row in rows) / 1e3
    return {
        "schema_version": SCHEMA_VERSION,
        "status": verdict(rows, run.agreement),
        "reasons": reasons(run),
        "end": run.end,
        "frames": len(rows),
        "seconds": total,
        "seconds_per_stage": stages,
        "peak_memory_bytes": peak_memory(),
        "submaps": len(run.state.submaps),
        "unjoined_submaps": unjoined(run.state),
        "keyframes": keyframes(run.state),
        "loops": sum(loop["weight"] > 0 for loop in loop_rows(run.state)),
        "loops_found": loop_rows(run.state),
        "status_counts": {str(status): [row.status for row in rows].count(status) for status in Status},
        "ro_frames": sum(row.info.searched for row in rows),
        "map_bytes": map_bytes(run.state),
        "bad_frames": [
            {"index": row.frame, "reason": row.info.note}
            for row in rows
            if row.info.note and row.status is not Status.LOST
        ],
        "contradiction": contradicted_part(run),
        **{name: number.value for name, number in numbers.items()},
        "protocol": {name: number.protocol for name, number in numbers.items()},
    }


def looked_through(run: Run) -> Number:
    """The share that decides whether depth images agree, at the part of the path where it is greatest."""
    if run.agreement is None:
        return Number(None, "too few frames see the same for depth images to be compared")
    return Number(
        run.agreement.worst.share,
        "share of tiles of small depth images that another frame looks through, by more than "
        f"{DEVIATIONS:g} deviations of the sensor's noise and {100 * DRIFT:g} % of the path between the two; "
        f"median of neighbouring pairs, greatest of {run.agreement.pairs} pairs; over {LIMIT:g} is degraded",
    )


def contradicted_part(run: Run) -> dict[str, Any] | None:
    """The part of the path where depth images begin to contradict each other; None where they agree."""
    if run.state is None or run.agreement is None or run.agreement.begins is None:
        return None
    part = run.agreement.begins
    ends = [run.state.records[place] for place in (part.first, part.last)]
    return {
        "indices": [record.frame for record in ends],
        "timestamps": [record.timestamp for record in ends],
        "looked_through": part.share,
    }


def loop_rows(state: SlamState) -> list[dict[str, Any]]:
    """Every loop that was found in this recording, in order: between which submaps, how, and what became of it."""
    return [
        {
            "index": state.records[loop.record].frame,
            "timestamp": state.records[loop.record].timestamp,
            "submaps": [loop.first, loop.second],
            "how": str(loop.how),
            "inliers": loop.inliers,
            "weight": loop.weight,
            "correction_cm": 100 * loop.correction_m,
            "correction_deg": math.degrees(loop.correction_rad),
        }
        for loop in state.loops[state.older_loops :]
    ]


def trajectory_errors(run: Run) -> dict[str, Number]:
    """ATE, RPE and TE, each None where too few poses are known; empty without ground truth."""
    truth = run.T_truth_cam
    if truth is None or run.state is None:
        return {}
    poses = trajectory(run.state)

    def absolute() -> dict[str, Number]:
        found = absolute_error(poses, truth)
        left_out = f"{found.poses} poses, {found.missing_truth} without truth left out, lost frames count"
        how = f"camera centres, rigid alignment, no scale; {left_out}"
        return {"ate_rmse_m": Number(found.rmse_m, how), "ate_mean_m": Number(found.mean_m, how)}

    def relative() -> dict[str, Number]:
        found = relative_error(poses, truth)
        how = f"all pairs of neighbouring frames, no alignment, {found.pairs} pairs, RMSE"
        return {
            "rpe_trans_m": Number(found.trans_rmse_m, how),
            "rpe_rot_deg": Number(found.rot_rmse_deg, how),
        }

    def translation() -> dict[str, Number]:
        how = "both seen from their first frame, no alignment, mean"
        return {"te_mean_m": Number(translation_error(poses, truth).mean_m, how)}

    return (
        _or_reason(absolute, "ate_rmse_m", "ate_mean_m")
        | _or_reason(relative, "rpe_trans_m", "rpe_rot_deg")
        | _or_reason(translation, "te_mean_m")
    )


def _or_reason(measure: Callable[[], dict[str, Number]], *names: str) -> dict[str, Number]:
    """The numbers of a measure, or why they cannot be told."""
    try:
        return measure()
    except InputError as error:
        return {name: Number(None, str(error)) for name in names}


def surface_errors(sequence: SynthSequence, run: Run, mesh: trimesh.Trimesh) -> dict[str, Number]:
    """Errors of the mesh against the exact scene, as far as it was seen; None where there is no surface."""
    from mipsjax.data.synth.mesh import reference_mesh

    assert sequence.T_world_cam is not None
    names = ("accuracy_m", "completeness_m", "completion_ratio", "f_score")
    if len(mesh.faces) == 0:
        return {name: Number(None, "the mesh is empty") for name in names}
    if run.state is not None and run.state.first:
        return {name: Number(None, "the mesh has what earlier recordings saw, too") for name in names}
    first, count = len(run.waited), len(run.rows)
    chosen = np.unique(np.linspace(first, count - 1, min(MOST_VIEWS, count - first)).astype(int))
    depths = (sequence[int(position)].depth for position in chosen)
    views = surface.Views(
        sequence.T_world_cam[chosen], sequence.intrinsics, (depth for depth in depths if depth is not None)
    )
    try:
        found = surface.compare_meshes(
            mesh, reference_mesh(sequence.scene, REFERENCE_VOXEL_M), views
        ).all_of_it
    except InputError as error:
        return {name: Number(None, str(error)) for name in names}
    sampled = (
        f"{found.points} points by area, not aligned, reference culled to what {len(chosen)} frames saw "
        f"({surface.DEPTH_TOLERANCE_M * 100:g} cm tolerance), mesh not culled"
    )
    within = f"within {100 * found.threshold_m:g} cm; {sampled}"
    how = (
        f"mean distance mesh to reference; {sampled}",
        f"mean distance reference to mesh; {sampled}",
        f"part of the reference {within}",
        f"harmonic mean of precision and completion ratio {within}",
    )
    return {name: Number(getattr(found, name), text) for name, text in zip(names, how, strict=True)}


def _speed(run: Run) -> dict[str, Number]:
    """Frames a second, with and without the two calls that compile."""
    timed = list(zip(run.step_s, run.rows, strict=True))
    # Those before the camera is found in a map compile nothing of tracking
    begins = next((i for i, (_, row) in enumerate(timed) if row.status.trusted), 0)
    tracked = [s for s, row in timed[begins:] if row.status is not Status.SKIPPED]
    steady = tracked[2:]
    total = sum(run.step_s) + sum(run.read_s)
    return {
        "fps": Number(
            len(steady) / sum(steady) if steady else None,
            "usable frames a second without reading images; the first two, which compile, left out",
        ),
        "fps_overall": Number(
            len(run.step_s) / total if total > 0 else None,
            "all frames, with reading images and with compilation",
        ),
    }
