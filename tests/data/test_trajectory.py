"""Trajectories: files both ways, rotations made exact, broken rows unknown."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from mipsjax.data.trajectory import (
    clean_poses,
    known_poses,
    matrix_from_quaternion,
    project_rotations,
    quaternion_from_matrix,
    read_matrix_files,
    read_matrix_rows,
    read_true_matrices,
    read_true_tum,
    read_tum,
    write_tum,
)
from mipsjax.errors import InputError, OutputError


def random_poses(count: int) -> np.ndarray:
    rng = np.random.default_rng(7)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-50, 50, (count, 3))
    return poses


def read_text(reader, text: str):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.txt"
        path.write_text(text, encoding="utf-8", errors="replace")
        return reader(path)


def test_written_trajectory_reads_back(tmp_path: Path) -> None:
    poses, times = random_poses(50), 1341836537.655691 + np.arange(50) / 30
    write_tum(tmp_path / "trajectory.txt", times, poses)
    back = read_tum(tmp_path / "trajectory.txt")
    np.testing.assert_allclose(back.timestamps, times, atol=6e-7)  # six decimals
    np.testing.assert_allclose(back.T_world_cam, poses, atol=5e-9)  # nine decimals of a quaternion
    assert [file.name for file in tmp_path.iterdir()] == ["trajectory.txt"]


def test_unknown_poses_are_not_written(tmp_path: Path) -> None:
    poses = random_poses(3)
    poses[1, 0, 3] = np.nan
    write_tum(tmp_path / "t.txt", np.arange(3.0), poses)
    np.testing.assert_array_equal(read_tum(tmp_path / "t.txt").timestamps, [0, 2])


def test_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "t.txt"
    path.write_text("old")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OutputError, match="No space left"):
        write_tum(path, np.zeros(1), np.eye(4)[None])
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_writing_to_no_folder(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot write"):
        write_tum(tmp_path / "none" / "t.txt", np.zeros(1), np.eye(4)[None])


@pytest.mark.parametrize(
    "row", ["1 nan 0 0 0 0 0 1", "1 inf 0 0 0 0 0 1", "1 0 0 0 0 0 0 0", "1 0 0 0 nan 0 0 1"]
)
def test_tum_row_without_a_pose(row: str) -> None:
    trajectory = read_text(read_tum, f"# time pose\n\n0 0 0 0 0 0 0 1\n{row}\n")
    np.testing.assert_array_equal(known_poses(trajectory.T_world_cam), [True, False])
    assert np.isnan(trajectory.T_world_cam[1]).all()


def test_tum_with_commas_and_carriage_returns() -> None:
    trajectory = read_text(read_tum, "\ufeff1,2,3,4,0,0,0,1\r\n2,2,3,4,0,0,0,1\r\n")
    np.testing.assert_array_equal(trajectory.T_world_cam[:, :3, 3], [[2, 3, 4], [2, 3, 4]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("# c\n0 0 0 0 0 0 0 1\n1 2 3\n", "line 3: 8 numbers expected, 3 found"),
        ("0 0 0 0 0 0 0 one\n", "line 1: 'one' is not a number"),
        ("nan 0 0 0 0 0 0 1\n", "row 1 has no finite timestamp"),
    ],
)
def test_malformed_tum(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        read_text(read_tum, text)
    assert "file.txt" in str(error.value)


@given(st.text(alphabet=st.sampled_from("0123456789.-+einfa# ,\n\t\rx\0é"), max_size=200))
def test_any_text_is_a_trajectory_or_an_error(text: str) -> None:
    for reader in (read_tum, read_matrix_rows):
        try:
            read_text(reader, text)
        except InputError as error:
            assert "file.txt" in str(error)


@given(hnp.arrays(np.float64, (4, 8), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_any_numbers_are_poses_or_unknown(rows: np.ndarray) -> None:
    rows[:, 0] = np.arange(4)
    trajectory = read_text(read_tum, "\n".join(" ".join(map(repr, row)) for row in rows.tolist()))
    known = known_poses(trajectory.T_world_cam)
    rotations = trajectory.T_world_cam[known, :3, :3]
    # float64 rounding of a quaternion of any length
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (known.sum(), 1, 1)), atol=1e-12
    )
    assert np.isnan(trajectory.T_world_cam[~known]).all()


@given(hnp.arrays(np.float64, (3, 4, 4), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_any_matrices_are_poses_or_unknown(matrices: np.ndarray) -> None:
    poses, notes = clean_poses(matrices, "traj.txt")
    known = known_poses(poses)
    np.testing.assert_allclose(np.linalg.det(poses[known, :3, :3]), 1, atol=1e-9)
    assert bool(notes) == (not known.all())


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, np.pi - 1e-7, np.pi])
def test_quaternions_and_matrices_are_inverse(angle: float) -> None:
    axis = np.array([0.36, 0.48, 0.8])
    matrix = Rotation.from_rotvec(angle * axis).as_matrix()[None]
    wxyz = quaternion_from_matrix(matrix)
    assert wxyz[0, 0] >= 0
    np.testing.assert_allclose(np.abs(wxyz[0, 0]), np.cos(angle / 2), atol=1e-12)
    np.testing.assert_allclose(matrix_from_quaternion(wxyz), matrix, atol=1e-12)
    np.testing.assert_allclose(matrix_from_quaternion(-3 * wxyz), matrix, atol=1e-12)


@pytest.mark.fault(27)
def test_near_rotations_become_rotations() -> None:
    rotations = random_poses(20)[:, :3, :3]
    noisy = rotations + np.random.default_rng(1).normal(0, 4e-4, rotations.shape)
    projected = project_rotations(noisy)
    np.testing.assert_allclose(
        projected @ projected.swapaxes(1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-14
    )
    assert np.abs(projected - rotations).max() < 3e-3
    distance = np.linalg.norm(projected - noisy, axis=(1, 2))
    assert np.all(distance <= np.linalg.norm(rotations - noisy, axis=(1, 2)) + 1e-15)  # the nearest one
    np.testing.assert_allclose(project_rotations(projected), projected, atol=1e-14)


def test_what_is_no_rotation_is_rejected() -> None:
    matrices = random_poses(6)
    matrices[0, :3, 0] *= -1  # mirrored
    matrices[1, :3, :3] *= 1.5  # scaled
    matrices[2] = matrices[2].T.copy()  # column-major file
    matrices[3, :3, :3] = 0
    matrices[4] = np.inf
    poses, notes = clean_poses(matrices, "traj.txt")
    np.testing.assert_array_equal(known_poses(poses), [False] * 5 + [True])
    assert notes == (
        "traj.txt: 1 of 6 true poses are not finite, left unknown",
        "traj.txt: 4 of 6 true poses rejected, left unknown (mirrored, not rigid, or farther than 1e+08 m)",
    )


def test_pose_files_may_be_missing_or_broken(tmp_path: Path) -> None:
    poses = random_poses(2)
    paths = [tmp_path / f"{number}.txt" for number in range(5)]
    np.savetxt(paths[0], poses[0])
    paths[1].write_text("")
    paths[2].write_text("1 2 three")
    np.savetxt(paths[4], poses[1])
    found, notes = read_matrix_files([*paths, None], "pose/")
    assert found is not None
    np.testing.assert_allclose(found[[0, 4]], poses, atol=1e-14)
    assert not known_poses(found)[[1, 2, 3, 5]].any()
    assert notes[0] == "pose/: 2 pose files are malformed"
    assert read_matrix_files([tmp_path / "none.txt"], "pose/") == (None, ())


def test_published_rotations_are_not_orthonormal_but_ours_are(shared_data: Path) -> None:
    files = sorted((shared_data / "sevenscenes_excerpt" / "seq-01").glob("*.pose.txt"))
    poses, notes = read_matrix_files(list(files), "pose")
    assert poses is not None and notes == ()
    gram = poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2)
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-14)


def test_positions_beyond_the_earth_are_unknown(tmp_path: Path) -> None:
    matrices = random_poses(3)
    matrices[1, 0, 3], matrices[2, 0, 3] = 1e308, 1e7
    poses, notes = clean_poses(matrices, "traj.txt")
    np.testing.assert_array_equal(known_poses(poses), [True, False, True])
    assert "1 of 3 true poses rejected" in notes[0]
    (tmp_path / "truth.txt").write_text("0 1e308 0 0 0 0 0 1\n1 1e7 0 0 0 0 0 1\n")
    np.testing.assert_array_equal(known_poses(read_tum(tmp_path / "truth.txt").T_world_cam), [False, True])


def test_truth_never_stops_a_run(tmp_path: Path) -> None:
    """A cut line is an unknown pose there, and an error where the file is what is asked about."""
    path = tmp_path / "truth.txt"
    path.write_text("0 1 0 0 0 0 0 1\n1 2 0 0 0 0 0 1\n2 3 0")
    found, remarks = read_true_tum(path)
    np.testing.assert_array_equal(found.T_world_cam[:, 0, 3], [1, 2])
    assert len(remarks) == 1 and "1 of 3 rows" in remarks[0] and "line 3" in remarks[0]
    with pytest.raises(InputError, match="line 3"):
        read_tum(path)
    identity = " ".join(str(number) for number in np.eye(4).ravel())
    path.write_text(f"{identity}\nno pose\n{identity}\n")
    poses, remarks = read_true_matrices(path)
    np.testing.assert_array_equal(known_poses(poses), [True, False, True])
    assert "1 of 3 rows are malformed" in remarks[0]
    for unreadable in (tmp_path, tmp_path / "nothing"):
        poses, remarks = read_true_matrices(unreadable)
        assert len(poses) == 0 and "truth left out" in remarks[0]


def test_true_rows_without_the_last_row_of_each_matrix(tmp_path: Path) -> None:
    poses = random_poses(3)
    np.savetxt(tmp_path / "poses.txt", poses[:, :3].reshape(3, 12))
    found, remarks = read_true_matrices(tmp_path / "poses.txt")
    np.testing.assert_allclose(found, poses, atol=1e-12)
    assert remarks == ()
