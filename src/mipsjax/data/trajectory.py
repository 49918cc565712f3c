"""Trajectories: TUM files, files of matrices, rotations made exact.

Poses are camera-to-world, `T_world_cam`, float64, metres. Quaternions are wxyz in memory and xyzw in TUM
files. A pose that is unknown is a matrix of NaN.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from mipsjax.data.textfile import content_lines, read_number_block, read_number_rows, read_true_rows
from mipsjax.errors import InputError
from mipsjax.files import write_atomically

MAX_STRETCH = 0.1
"""How far the singular values of a rotation may be from 1. Published poses are off by up to 1e-3; a scaled
or sheared matrix is another convention, and silently mending it would hide that."""

_LARGEST_ENTRY = 2.0
"""A matrix with a larger entry is no near-rotation; it is not given to the SVD, which could overflow."""

FARTHEST_M = 1e8
"""A true position beyond is a mistake: surveyed coordinates, and those of the whole Earth, are below 1e7 m."""

_BOTTOM_ROW = (0.0, 0.0, 0.0, 1.0)
_BOTTOM_ROW_TOLERANCE = 1e-3
_SMALLEST_QUATERNION = 1e-6
_TUM_COLUMNS = 8
_MATRIX_COLUMNS, _KITTI_COLUMNS = 16, 12
_TUM_HEADER = "# timestamp tx ty tz qx qy qz qw"


class Trajectory(NamedTuple):
    """Poses with their times, in the order of the file."""

    timestamps: Float64[np.ndarray, "N"]
    """Seconds."""
    T_world_cam: Float64[np.ndarray, "N 4 4"]
    """Camera-to-world; NaN where a row holds no usable pose."""


def known_poses(T_world_cam: Float64[np.ndarray, "N 4 4"]) -> Bool[np.ndarray, "N"]:
    """Which poses are finite."""
    return np.all(np.isfinite(T_world_cam), axis=(-2, -1))


def matrix_from_quaternion(wxyz: Float64[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 3 3"]:
    """Rotation matrices of quaternions of any length; NaN for zero or non-finite ones."""
    size = np.max(np.abs(wxyz), axis=-1, keepdims=True, initial=0.0)
    usable = np.isfinite(size) & (size > _SMALLEST_QUATERNION)
    # Scaled by the largest entry first, since the square of a huge one would overflow.
    unit = np.where(usable, wxyz / np.where(usable, size, 1.0), np.array([1.0, 0.0, 0.0, 0.0]))
    rotations = Rotation.from_quat(unit[:, [1, 2, 3, 0]]).as_matrix().reshape(-1, 3, 3)
    return np.where(usable[..., None], rotations, np.nan)


def quaternion_from_matrix(rotations: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, "N 4"]:
    """Unit quaternions wxyz with w >= 0 of rotation matrices; NaN for matrices that are not finite."""
    usable = np.all(np.isfinite(rotations), axis=(-2, -1))
    safe = np.where(usable[:, None, None], rotations, np.eye(3))
    xyzw = Rotation.from_matrix(safe).as_quat(canonical=True).reshape(-1, 4)
    return np.where(usable[:, None], xyzw[:, [3, 0, 1, 2]], np.nan)


def project_rotations(rotations: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, "N 3 3"]:
    """The nearest rotation (Frobenius norm) to each near-rotation.

    NaN where the matrix is not finite, is mirrored (determinant below 0), or has a singular value farther
    than MAX_STRETCH from 1.
    """
    with np.errstate(invalid="ignore"):
        usable = np.all(np.abs(rotations) <= _LARGEST_ENTRY, axis=(-2, -1))
    # Of what is not finite there is no decomposition: the identity stands in, and is no result
    left, stretch, right = np.linalg.svd(np.where(usable[:, None, None], rotations, np.eye(3)))
    nearest = left @ right
    good = usable & (np.abs(stretch - 1).max(axis=-1) <= MAX_STRETCH) & (np.linalg.det(nearest) > 0)
    return np.where(good[:, None, None], nearest, np.nan)


def clean_poses(
    matrices: Float64[np.ndarray, "N 4 4"], source: str
) -> tuple[Float64[np.ndarray, "N 4 4"], tuple[str, ...]]:
    """Poses with exact rotations, NaN where a matrix is no pose, and remarks that count those.

    `source` is the file named in the remarks.
    """
    finite = known_poses(matrices)
    poses = matrices.copy()
    poses[:, :3, :3] = project_rotations(matrices[:, :3, :3])
    with np.errstate(invalid="ignore"):
        skew = np.abs(matrices[:, 3] - np.array(_BOTTOM_ROW)) > _BOTTOM_ROW_TOLERANCE
        near = np.abs(matrices[:, :3, 3]).max(axis=-1) <= FARTHEST_M
    rigid = finite & known_poses(poses) & ~skew.any(axis=-1) & near
    # It was right up to a tolerance: exact from here on
    poses[:, 3] = _BOTTOM_ROW
    poses[~rigid] = np.nan
    return poses, _remarks(finite, rigid, source)


def read_matrix_rows(path: Path) -> tuple[Float64[np.ndarray, "N 4 4"], tuple[str, ...]]:
    """Poses of a file with 16 numbers a row, row-major, and remarks. Raises InputError on malformed rows."""
    return clean_poses(read_number_rows(path, _MATRIX_COLUMNS).reshape(-1, 4, 4), path.name)


def read_true_matrices(path: Path) -> tuple[Float64[np.ndarray, "N 4 4"], tuple[str, ...]]:
    """The same of a file of truth, which never stops a run: what cannot be read is unknown, and remarked on.

    Rows of 12 numbers, as KITTI has them, lack the last row of each matrix.
    """
    count = _MATRIX_COLUMNS if _columns(path) != _KITTI_COLUMNS else _KITTI_COLUMNS
    rows, malformed = read_true_rows(path, count)
    if count == _KITTI_COLUMNS:
        rows = np.concatenate([rows, np.tile(_BOTTOM_ROW, (len(rows), 1))], axis=1)
    poses, remarks = clean_poses(rows.reshape(-1, 4, 4), path.name)
    return poses, malformed + remarks


def _columns(path: Path) -> int:
    """Numbers in the first row of a file; 0 if it is empty or unreadable."""
    try:
        lines = content_lines(path)
    except InputError:
        return 0
    return len(lines[0][1].replace(",", " ").split()) if lines else 0


def read_matrix_files(
    paths: list[Path | None], source: str
) -> tuple[Float64[np.ndarray, "N 4 4"] | None, tuple[str, ...]]:
    """Poses from one 4 x 4 text file a frame, and remarks; None if no file exists at all.

    A missing, empty or malformed file is one unknown pose, since ground truth must not stop a run.
    """
    matrices = np.full((len(paths), 4, 4), np.nan)
    present = [(row, path) for row, path in enumerate(paths) if path is not None and path.is_file()]
    malformed = 0
    for row, path in present:
        try:
            matrices[row] = read_number_block(path, 4, 4)
        except InputError:
            malformed += 1
    if not present:
        return None, ()
    remarks = (f"{source}: {malformed} pose files are malformed",) if malformed else ()
    poses, more = clean_poses(matrices, source)
    return poses, remarks + more


def read_tum(path: Path) -> Trajectory:
    """A TUM trajectory, `timestamp tx ty tz qx qy qz qw` a row, in seconds and metres.

    Rows with NaN, inf or a zero quaternion become NaN poses. Raises InputError on malformed rows and on
    timestamps that are not finite.
    """
    rows = read_number_rows(path, _TUM_COLUMNS)
    timestamps = rows[:, 0]
    if not np.isfinite(timestamps).all():
        raise InputError(f"{path}: row {int(np.argmin(np.isfinite(timestamps))) + 1} has no finite timestamp")
    return _of_tum_rows(rows)


def read_true_tum(path: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """The same of a file of truth, which never stops a run: rows that cannot be read are left out, and remarked on."""
    rows, remarks = read_true_rows(path, _TUM_COLUMNS)
    return _of_tum_rows(rows[np.isfinite(rows[:, 0])]), remarks


def _of_tum_rows(rows: Float64[np.ndarray, "N 8"]) -> Trajectory:
    timestamps = rows[:, 0]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = rows[:, 1:4]
    # A file has x y z w, memory w x y z
    poses[:, :3, :3] = matrix_from_quaternion(rows[:, [7, 4, 5, 6]])
    with np.errstate(invalid="ignore"):
        near = np.abs(rows[:, 1:4]).max(axis=-1, initial=0.0) <= FARTHEST_M
    poses[~known_poses(poses) | ~near] = np.nan
    return Trajectory(timestamps, poses)


def write_tum(
    path: Path, timestamps: Float64[np.ndarray, "N"], T_world_cam: Float64[np.ndarray, "N 4 4"]
) -> None:
    """Writes a TUM trajectory; poses that are not finite are left out.

    The file is replaced in one step, so that a crash leaves the old one or the new one. Raises OutputError.
    """
    known = known_poses(T_world_cam)
    wxyz = quaternion_from_matrix(T_world_cam[known, :3, :3])
    values = np.concatenate([T_world_cam[known, :3, 3], wxyz[:, [1, 2, 3, 0]]], axis=-1)
    rows = [
        f"{time:.6f} " + " ".join(f"{value:.9f}" for value in row)
        for time, row in zip(timestamps[known], values, strict=True)
    ]
    write_atomically(path, ("\n".join([_TUM_HEADER, *rows]) + "\n").encode())


def _remarks(finite: Bool[np.ndarray, "N"], rigid: Bool[np.ndarray, "N"], source: str) -> tuple[str, ...]:
    unknown, rejected = int((~finite).sum()), int((finite & ~rigid).sum())
    remarks = []
    if unknown:
        remarks.append(f"{source}: {unknown} of {len(finite)} true poses are not finite, left unknown")
    if rejected:
        remarks.append(
            f"{source}: {rejected} of {len(finite)} true poses rejected, left unknown "
            f"(mirrored, not rigid, or farther than {FARTHEST_M:g} m)"
        )
    return tuple(remarks)
