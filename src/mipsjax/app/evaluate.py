"""`python -m mipsjax.evaluate`: errors of a trajectory, and of a mesh, of this or of any other system.

Needs no display. Every number is printed with the protocol it follows.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import trimesh
import tyro
from jaxtyping import Float64

from mipsjax.app.commandline import ended, read_options, say
from mipsjax.config.ranges import LARGEST_SEED
from mipsjax.data.association import associate, sort_stamps
from mipsjax.data.calibration import FRAME_RATES
from mipsjax.data.textfile import content_lines
from mipsjax.data.trajectory import Trajectory, read_matrix_rows, read_tum
from mipsjax.errors import ConfigError, InputError
from mipsjax.files import write_atomically
from mipsjax.mesh.ply import restore_uncertainty
from mipsjax.metrics import surface
from mipsjax.metrics.poses import AbsoluteError, absolute_error, relative_error, translation_error

MOST_POINTS = 10**8
"""Of a mesh: gigabytes."""
MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off")
"""Archives, which may unpack to anything, are left out."""
LARGEST_MESH_BYTES = 1 << 32
"""A hundred million triangles."""
MATRIX_COLUMNS = 16
"""Numbers in a row of a file of 4 x 4 matrices; a TUM row has 8."""


@dataclass(frozen=True)
class Options:
    """Compare an estimated trajectory with the true one, and a mesh with a reference."""

    trajectory: Annotated[Path, tyro.conf.Positional]
    """The estimate: TUM rows (timestamp tx ty tz qx qy qz qw) or rows of 16 numbers, camera-to-world."""
    ground_truth: Annotated[Path, tyro.conf.Positional]
    """The truth, in one of the same two formats."""
    mesh: Path | None = None
    """Reconstructed mesh (PLY, OBJ, STL, OFF), in the world frame of the estimated trajectory."""
    reference: Path | None = None
    """True mesh, in the world frame of the ground truth."""
    delta: int = 1
    """Interval of the relative pose error, in frames."""
    max_dt: float = 0.02
    """Seconds; poses farther apart in time are not compared."""
    fps: float | None = None
    """Frames a second of a file without timestamps. Needed when the other file has timestamps and another
    length."""
    align_mesh: Literal["trajectory", "none"] = "trajectory"
    """Moves the mesh by the rigid motion that aligns the trajectory, or leaves it where it is."""
    threshold_m: float = surface.THRESHOLD_M
    """Inlier distance of completion ratio and F-score, in metres."""
    points: int = surface.POINTS
    """Points drawn from each mesh."""
    seed: int = 0
    """Seed of these draws."""
    json: Path | None = None
    """Writes the numbers to this file as well."""


class Row(NamedTuple):
    """One number of the table."""

    name: str
    """Key in the JSON file; ends with the unit."""
    value: float | int | None
    """None where it cannot be told."""
    protocol: str
    """Or why it cannot be told."""


class Matched(NamedTuple):
    """Estimated and true poses of the same moments, camera-to-world, NaN where unknown."""

    T_world_cam: Float64[np.ndarray, "N 4 4"]
    T_truth_cam: Float64[np.ndarray, "N 4 4"]
    how: str
    """The protocol of the matching."""
    unmatched: int
    """Estimated poses that found no partner; NaN in the truth."""


def evaluate(options: Options) -> list[Row]:
    """All numbers that the given files allow.

    Raises:
        ConfigError: options that contradict each other.
        InputError: a file is missing or unusable, or the trajectories do not overlap.
    """
    if (options.mesh is None) != (options.reference is None):
        raise ConfigError("a mesh is measured against a reference: give both --mesh and --reference, or none")
    if options.fps is not None and not FRAME_RATES[0] <= options.fps <= FRAME_RATES[1]:
        raise ConfigError(f"--fps must be positive, at most {FRAME_RATES[1]:g}, not {options.fps:g}")
    if options.points > MOST_POINTS or options.delta > MOST_POINTS:
        raise ConfigError(f"--points and --delta must be at most {MOST_POINTS}")
    if not 0 <= options.seed <= LARGEST_SEED:
        raise ConfigError(f"--seed must be at least 0 and at most {LARGEST_SEED}, not {options.seed}")
    # `not >` and not `<=`: a threshold that is NaN is refused as well
    if options.delta < 1 or options.points < 1 or not options.threshold_m > 0 or not options.max_dt >= 0:
        raise ConfigError("--delta, --points and --threshold-m must be positive, --max-dt not negative")
    pair = matched(options.trajectory, options.ground_truth, options.max_dt, options.fps)
    absolute = absolute_error(pair.T_world_cam, pair.T_truth_cam)
    rows = trajectory_rows(pair, absolute, options.delta)
    if options.mesh is not None and options.reference is not None:
        moved = options.align_mesh == "trajectory"
        mesh, reference = read_mesh(options.mesh), read_mesh(options.reference)
        # A mesh is in the world of its own trajectory, so that what aligns the one aligns the other
        mesh.apply_transform(absolute.T_truth_estimate if moved else np.eye(4))
        error = surface.compare_meshes(
            mesh, reference, None, options.threshold_m, options.points, options.seed
        )
        rows += surface_rows(error.all_of_it, "aligned by the trajectory" if moved else "not aligned")
    return rows


def trajectory_rows(pair: Matched, absolute: AbsoluteError, delta_frames: int) -> list[Row]:
    """The numbers of a matched pair of trajectories; RPE is None if no true poses are `delta_frames` apart."""
    ate = "camera centres, rigid alignment of all compared poses, no scale"
    rows = [
        Row("poses_compared", absolute.poses, pair.how),
        Row("poses_unmatched", pair.unmatched, "estimated poses without a true one near in time; left out"),
        # Unmatched poses have a truth of NaN too, and are counted once
        Row("poses_without_truth", absolute.missing_truth - pair.unmatched, "true pose not finite; left out"),
        Row("poses_without_estimate", absolute.missing_estimate, "estimate not finite; left out"),
        Row("ate_rmse_m", absolute.rmse_m, ate),
        Row("ate_mean_m", absolute.mean_m, ate),
        Row("ate_median_m", absolute.median_m, ate),
        Row("ate_max_m", absolute.max_m, ate),
    ]
    try:
        relative = relative_error(pair.T_world_cam, pair.T_truth_cam, delta_frames)
        rpe = f"all pairs {delta_frames} frame(s) apart, no alignment, {relative.pairs} pairs, RMSE"
        rows += [
            Row("rpe_trans_m", relative.trans_rmse_m, rpe),
            Row("rpe_rot_deg", relative.rot_rmse_deg, rpe),
        ]
    except InputError as error:
        reason = f"{error}, or choose a --delta at which there are true poses"
        rows += [Row(name, None, reason) for name in ("rpe_trans_m", "rpe_rot_deg")]
    te = translation_error(pair.T_world_cam, pair.T_truth_cam)
    return [*rows, Row("te_mean_m", te.mean_m, "both seen from their first frame, no alignment, mean")]


def surface_rows(error: surface.SurfaceError, how: str) -> list[Row]:
    """The numbers of a mesh."""
    sampled = f"{error.points} points by area, {how}, no culling"
    within = f"within {100 * error.threshold_m:g} cm; {sampled}"
    return [
        Row("accuracy_m", error.accuracy_m, f"mean distance mesh to reference; {sampled}"),
        Row("accuracy_rms_m", error.accuracy_rms_m, f"RMS distance mesh to reference; {sampled}"),
        Row("completeness_m", error.completeness_m, f"mean distance reference to mesh; {sampled}"),
        Row("completion_ratio", error.completion_ratio, f"part of the reference {within}"),
        Row("precision", error.precision, f"part of the mesh {within}"),
        Row("f_score", error.f_score, f"harmonic mean of the two above; {within}"),
    ]


def matched(trajectory: Path, ground_truth: Path, max_dt: float, fps: float | None = None) -> Matched:
    """Poses of both files for the same moments, and how they were matched.

    By time, nearest first and one to one, at most `max_dt` seconds apart. Files of matrices have no times:
    their rows are `1 / fps` seconds apart from 0 if `fps` is given, and otherwise row i belongs to row i.

    Raises:
        InputError: a file is unusable, the lengths differ where rows are to be matched, or no times meet.
    """
    estimate, truth = read_trajectory(trajectory, fps), read_trajectory(ground_truth, fps)
    if estimate.timestamps is None or truth.timestamps is None:
        if len(estimate.poses) != len(truth.poses):
            raise InputError(
                f"{trajectory} has {len(estimate.poses)} poses and {ground_truth} {len(truth.poses)}, and "
                "one has no timestamps: give --fps, so that they can be matched by time"
            )
        return Matched(estimate.poses, truth.poses, "row by row, since a file has no timestamps", 0)
    first, second = associate(estimate.timestamps, truth.timestamps, max_dt)
    near = np.full_like(estimate.poses, np.nan)
    # One row an estimated pose, matched or not: RPE takes rows for neighbours
    near[first] = truth.poses[second]
    how = f"nearest in time, at most {max_dt:g} s apart"
    return Matched(estimate.poses, near, how, len(estimate.poses) - len(first))


class Poses(NamedTuple):
    """A trajectory whose times may be unknown."""

    timestamps: Float64[np.ndarray, "N"] | None
    """Seconds, strictly increasing."""
    poses: Float64[np.ndarray, "N 4 4"]
    """Camera-to-world, NaN where unknown."""


def read_trajectory(path: Path, fps: float | None = None) -> Poses:
    """Reads TUM rows or rows of 16 numbers, whichever the file has.

    Raises:
        InputError: the file is missing, empty or neither of the two.
    """
    if _columns(path) == MATRIX_COLUMNS:
        poses, _ = read_matrix_rows(path)
        return Poses(None if fps is None else np.arange(len(poses)) / fps, poses)
    found: Trajectory = read_tum(path)
    order, _ = sort_stamps(found.timestamps, path.name)
    return Poses(found.timestamps[order], found.T_world_cam[order])


def read_mesh(path: Path) -> trimesh.Trimesh:
    """Reads one triangle mesh, with its `uncertainty` where it is a PLY of a run.

    Raises:
        InputError: the file is missing or holds no mesh.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; a mesh was expected")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{path}: a mesh is a file of one of the kinds {', '.join(MESH_SUFFIXES)}")
    if path.stat().st_size > LARGEST_MESH_BYTES:
        raise InputError(f"{path}: more than {LARGEST_MESH_BYTES >> 30} GB; decimate it")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # the readers of the many formats raise anything at all
        raise InputError(f"{path}: not a readable mesh ({type(error).__name__}: {error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path}: holds no triangles")
    restore_uncertainty(mesh)
    return mesh


def format_table(rows: list[Row]) -> str:
    """The numbers, aligned, each with its protocol."""
    values = [_shown(row.value) for row in rows]
    widths = max(len(row.name) for row in rows), max(len(value) for value in values)
    return "\n".join(
        f"{row.name:<{widths[0]}}  {value:>{widths[1]}}  {row.protocol}"
        for row, value in zip(rows, values, strict=True)
    )


def write_json(path: Path, rows: list[Row]) -> None:
    """Writes numbers and protocols.

    Raises:
        OutputError: the file cannot be written.
    """
    content: dict[str, object] = {row.name: row.value for row in rows}
    content["protocol"] = {row.name: row.protocol for row in rows}
    write_atomically(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def main(arguments: list[str] | None = None) -> int:
    """The program; returns its exit code. Errors are one line on stderr."""
    return ended(lambda: _main(sys.argv[1:] if arguments is None else arguments))


def _main(arguments: list[str]) -> int:
    names = ["--" + item.name for item in fields(Options)]
    missing = "two trajectories are needed: the estimate, and the truth"
    options = read_options(Options, "python -m mipsjax.evaluate", arguments, names, missing)
    _check_output(options)
    rows = evaluate(options)
    if options.json is not None:
        write_json(options.json, rows)
    say(format_table(rows))
    return 0


def _check_output(options: Options) -> None:
    """Raises ConfigError where the numbers would be written over what they are made from."""
    if options.json is None or not options.json.exists():
        return
    inputs = (options.trajectory, options.ground_truth, options.mesh, options.reference)
    if any(path is not None and path.exists() and path.samefile(options.json) for path in inputs):
        raise ConfigError(f"--json {options.json}: is an input of this comparison; choose another file")


def _shown(value: float | int | None) -> str:
    if value is None:
        return "-"
    return f"{value:d}" if isinstance(value, int) else f"{value:.6f}"


def _columns(path: Path) -> int:
    """Numbers in the first row of a text file of numbers.

    Raises:
        InputError: the file is missing or empty.
    """
    lines = content_lines(path)
    if not lines:
        raise InputError(f"{path}: empty; poses were expected")
    return len(lines[0][1].replace(",", " ").split())
