"""The evaluation program: formats, matching, exit codes, output."""

import json
import os
import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from mipsjax.app import evaluate
from mipsjax.errors import InputError
from mipsjax.metrics import poses as metrics


def wander(seed, count=40):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(size=(count, 3)), axis=0) * 0.05).as_matrix()
    T[:, :3, 3] = np.cumsum(rng.normal(size=(count, 3)), axis=0) * 0.05
    return T


def write_tum(path, T, times):
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    np.savetxt(path, np.column_stack([times, T[:, :3, 3], quaternions]), fmt="%.12f")
    return str(path)


def write_matrices(path, T):
    np.savetxt(path, T.reshape(-1, 16), fmt="%.12f")
    return str(path)


@pytest.fixture
def pair(tmp_path):
    truth = wander(1)
    estimate = truth.copy()
    estimate[:, :3, 3] += np.random.default_rng(2).normal(size=(40, 3)) * 0.01
    return tmp_path, estimate, truth


def numbers(path):
    return json.loads(path.read_text())


def test_table_and_json_carry_the_library_numbers(pair, capsys):
    folder, estimate, truth = pair
    times = np.arange(40) / 30
    files = write_tum(folder / "e.txt", estimate, times), write_tum(folder / "t.txt", truth, times)
    assert evaluate.main([*files, "--delta", "3", "--json", str(folder / "out.json")]) == 0
    found = numbers(folder / "out.json")
    ate, rpe = metrics.absolute_error(estimate, truth), metrics.relative_error(estimate, truth, 3)
    assert found["ate_rmse_m"] == pytest.approx(ate.rmse_m, abs=1e-9)
    assert found["rpe_trans_m"] == pytest.approx(rpe.trans_rmse_m, abs=1e-9)
    assert found["rpe_rot_deg"] == pytest.approx(rpe.rot_rmse_deg, abs=1e-5)
    assert found["te_mean_m"] == pytest.approx(metrics.translation_error(estimate, truth).mean_m, abs=1e-9)
    printed = capsys.readouterr().out
    for name, protocol in found["protocol"].items():
        assert name in printed and protocol in printed


def test_matching_by_time_survives_offset_gaps_and_order(pair):
    folder, estimate, truth = pair
    times = 1e9 + np.arange(40) / 30
    some = np.random.default_rng(0).permutation(40)[:25]
    files = (
        write_tum(folder / "e.txt", estimate[some], times[some] + 0.004),
        write_tum(folder / "t.txt", truth, times),
    )
    found = evaluate.matched(folder / "e.txt", folder / "t.txt", 0.01)
    np.testing.assert_allclose(found.T_world_cam, estimate[np.sort(some)], atol=1e-9)
    np.testing.assert_allclose(found.T_truth_cam, truth[np.sort(some)], atol=1e-9)
    assert found.unmatched == 0
    assert evaluate.main([*files, "--max-dt", "0.001"]) == 3


def test_rows_of_matrices_are_matched_by_row_or_by_fps(pair):
    folder, estimate, truth = pair
    write_tum(folder / "e.txt", estimate, np.arange(40) / 30)
    write_matrices(folder / "t.txt", truth)
    by_row = evaluate.matched(folder / "e.txt", folder / "t.txt", 0.01)
    np.testing.assert_allclose(by_row.T_truth_cam, truth, atol=1e-9)
    write_tum(folder / "e.txt", estimate[5:20], np.arange(5, 20) / 30)
    by_time = evaluate.matched(folder / "e.txt", folder / "t.txt", 0.01, fps=30.0)
    np.testing.assert_allclose(by_time.T_truth_cam, truth[5:20], atol=1e-9)


def test_neighbours_are_those_of_the_estimate_where_the_truth_has_gaps(pair):
    """What lies between two true poses that are far apart is no interval of one frame."""
    folder, estimate, truth = pair
    times = np.arange(40) / 30
    some = [0, 1, 2, *range(10, 40, 5)]
    files = (
        write_tum(folder / "e.txt", estimate, times),
        write_tum(folder / "t.txt", truth[some], times[some]),
    )
    assert evaluate.main([*files, "--json", str(folder / "out.json")]) == 0
    found = numbers(folder / "out.json")
    near = metrics.relative_error(estimate[:3], truth[:3])
    assert found["rpe_trans_m"] == pytest.approx(near.trans_rmse_m, abs=1e-9)
    assert (found["poses_unmatched"], found["poses_without_truth"]) == (40 - len(some), 0)
    assert found["poses_compared"] == len(some)


def test_one_number_that_cannot_be_told_leaves_the_others(pair, capsys):
    """The truth at half the rate has no neighbours of one frame, but of two."""
    folder, estimate, truth = pair
    times = np.arange(40) / 30
    files = (
        write_tum(folder / "e.txt", estimate, times),
        write_tum(folder / "t.txt", truth[::2], times[::2]),
    )
    assert evaluate.main([*files, "--json", str(folder / "out.json")]) == 0
    found = numbers(folder / "out.json")
    assert found["rpe_trans_m"] is None and "--delta" in found["protocol"]["rpe_trans_m"]
    assert found["ate_rmse_m"] > 0 and found["te_mean_m"] > 0
    assert re.search(r"rpe_trans_m +-  RPE over 1 frames", capsys.readouterr().out)
    assert evaluate.main([*files, "--delta", "2", "--json", str(folder / "out.json")]) == 0
    assert numbers(folder / "out.json")["rpe_trans_m"] > 0


def test_missing_truth_is_counted(pair):
    folder, estimate, truth = pair
    truth[[3, 4]] = np.nan
    files = write_matrices(folder / "e.txt", estimate), write_matrices(folder / "t.txt", truth)
    assert evaluate.main([*files, "--json", str(folder / "out.json")]) == 0
    found = numbers(folder / "out.json")
    assert (found["poses_compared"], found["poses_without_truth"]) == (38, 2)


def test_mesh_is_moved_by_the_trajectory_alignment(pair):
    folder, _, truth = pair
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, 1.0, -0.4]).as_matrix(), [1, 2, 3]
    files = write_matrices(folder / "e.txt", T @ truth), write_matrices(folder / "t.txt", truth)
    box = trimesh.creation.box((2, 1, 1))
    box.export(folder / "reference.ply")
    box.apply_transform(T).export(folder / "mesh.ply")
    meshes = ["--mesh", str(folder / "mesh.ply"), "--reference", str(folder / "reference.ply")]
    options = [*files, *meshes, "--points", "20000", "--json", str(folder / "out.json")]
    assert evaluate.main(options) == 0
    assert numbers(folder / "out.json")["f_score"] == 1.0
    assert evaluate.main([*options, "--align-mesh", "none"]) == 0
    assert numbers(folder / "out.json")["f_score"] < 0.5


def broken(folder, case):
    """Arguments for one fault, the exit code it must give, and a word of its message."""
    good = write_matrices(folder / "good.txt", wander(1))
    (folder / "empty.txt").write_text("# nothing\n")
    (folder / "words.txt").write_text("a b c d e f g h\n")
    (folder / "binary.txt").write_bytes(bytes(range(256)))
    (folder / "junk.ply").write_bytes(b"ply\nnonsense")
    trimesh.creation.box().export(folder / "box.ply")
    short = write_matrices(folder / "short.txt", wander(1)[:30])
    unknown = write_matrices(folder / "unknown.txt", np.full((40, 4, 4), np.nan))
    mesh = ["--mesh", str(folder / "box.ply")]
    return {
        "missing": ([good, str(folder / "no.txt")], 3, "no.txt"),
        "folder": ([good, str(folder)], 3, str(folder)),
        "empty": ([good, str(folder / "empty.txt")], 3, "empty"),
        "words": ([str(folder / "words.txt"), good], 3, "not a number"),
        "binary": ([str(folder / "binary.txt"), good], 3, "binary.txt"),
        "lengths": ([short, good], 3, "--fps"),
        "no truth": ([good, unknown], 3, "ATE needs"),
        "mesh alone": ([good, good, *mesh], 2, "--reference"),
        "mesh missing": ([good, good, *mesh, "--reference", "no.ply"], 3, "no.ply"),
        "mesh broken": ([good, good, *mesh, "--reference", str(folder / "junk.ply")], 3, "junk.ply"),
        "zero interval": ([good, good, "--delta", "0"], 2, "--delta"),
        "seed below zero": ([good, good, "--seed", "-1"], 2, "--seed"),
        "zero fps": ([good, good, "--fps", "0"], 2, "--fps"),
        "unwritable": ([good, good, "--json", str(folder / "no" / "out.json")], 5, "cannot write"),
    }[case]


TRAJECTORY_FAULTS = ["missing", "folder", "empty", "words", "binary", "lengths", "no truth"]
MESH_FAULTS = ["mesh alone", "mesh missing", "mesh broken"]
OPTION_FAULTS = ["zero interval", "seed below zero", "zero fps", "unwritable"]


@pytest.mark.parametrize("case", TRAJECTORY_FAULTS + MESH_FAULTS + OPTION_FAULTS)
def test_faults_give_one_line_and_their_exit_code(case, tmp_path, capsys):
    arguments, code, word = broken(tmp_path, case)
    assert evaluate.main(arguments) == code
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and captured.err.startswith("error: ")
    assert word in captured.err and captured.out == ""


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["a", "b", "--thresold-m", "0.1"], "--threshold-m"),
        (["a", "b", "--delta", "two"], "two"),
        (["a"], "truth"),
    ],
)
def test_wrong_options_give_one_line_and_exit_with_two(arguments, word, capsys):
    assert evaluate.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1 and captured.err.startswith("error: ")
    assert word in captured.err and captured.out == ""


def test_a_bug_of_ours_is_one_line_and_its_traceback_is_in_a_file(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(evaluate, "evaluate", lambda options: 1 / 0)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert evaluate.main(["a", "b"]) == 1
    (saved,) = tmp_path.iterdir()
    assert "ZeroDivisionError" in saved.read_text()
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and str(saved) in error


def test_help_says_what_the_options_are(capsys):
    with pytest.raises(SystemExit) as stopped:
        evaluate.main(["--help"])
    assert stopped.value.code == 0
    assert "--threshold-m" in capsys.readouterr().out


def test_numbers_are_not_written_over_what_they_are_made_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        (tmp_path / name).write_text("0 0 0 0 0 0 0 1\n")
    (tmp_path / "link").symlink_to(tmp_path / "a")
    code = evaluate.main([str(tmp_path / "a"), str(tmp_path / "b"), "--json", str(tmp_path / "link")])
    assert code == 2 and "--json" in capsys.readouterr().err
    assert (tmp_path / "a").read_text().startswith("0 ")


def test_archives_are_not_unpacked_for_a_mesh(tmp_path: Path) -> None:
    for name in ("mesh.zip", "mesh.ply.gz", "mesh"):
        (tmp_path / name).write_bytes(b"PK")
        with pytest.raises(InputError, match="one of the kinds"):
            evaluate.read_mesh(tmp_path / name)


def test_a_pipe_is_no_trajectory(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="no regular file"):
        evaluate.read_trajectory(tmp_path / "pipe")
