"""Trajectory metrics: invariances, hand-made cases, and the evo programs as an independent oracle."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mipsjax.errors import InputError
from mipsjax.metrics import poses as metrics

EXACT = 1e-9
"""Rounding of a few hundred double operations on coordinates of a few metres."""


def poses_from(rotations, positions):
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rotations.as_matrix(), positions
    return T


def wander(seed, count=60, step=0.05):
    """A smooth random walk of camera poses."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(size=(count, 3)), axis=0) * step)
    return poses_from(turns, np.cumsum(rng.normal(size=(count, 3)), axis=0) * step)


def disturbed(T, seed, position=0.02, angle=0.01):
    rng = np.random.default_rng(seed)
    noise = poses_from(
        Rotation.from_rotvec(rng.normal(size=(len(T), 3)) * angle), rng.normal(size=(len(T), 3)) * position
    )
    return T @ noise


def motion(seed):
    rng = np.random.default_rng(seed)
    return poses_from(Rotation.random(1, rng=rng), rng.normal(size=(1, 3)) * 5)[0]


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_alignment_recovers_a_rigid_motion(seed):
    T, points = motion(seed), np.random.default_rng(seed).normal(size=(20, 3))
    found = metrics.align_rigid(points, points @ T[:3, :3].T + T[:3, 3])
    np.testing.assert_allclose(found, T, atol=EXACT)


@pytest.mark.parametrize("count", [1, 2, 3, 10])
def test_alignment_of_degenerate_points_is_a_rotation(count):
    """A standing camera and a straight line leave the rotation open; it must still be one."""
    line = np.outer(np.linspace(0, 1, count), [1.0, 2.0, 3.0])
    for source, target in ((line, line[:, ::-1]), (line * 0, line * 0 + 1.0)):
        R = metrics.align_rigid(source, target)[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=EXACT)
        assert np.linalg.det(R) == pytest.approx(1.0)


def test_alignment_of_a_mirror_image_is_no_reflection():
    points = np.random.default_rng(0).normal(size=(30, 3))
    assert np.linalg.det(metrics.align_rigid(points, points * [1, 1, -1])[:3, :3]) == pytest.approx(1.0)


def test_alignment_refuses_nothing():
    with pytest.raises(ValueError, match="non-empty"):
        metrics.align_rigid(np.zeros((0, 3)), np.zeros((0, 3)))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_identical_up_to_a_rigid_motion_is_no_error(seed):
    truth = wander(seed)
    for estimate in (truth, motion(seed) @ truth):
        assert metrics.absolute_error(estimate, truth).max_m < EXACT
        assert metrics.relative_error(estimate, truth).trans_rmse_m < EXACT
        assert metrics.relative_error(estimate, truth).rot_rmse_deg < 1e-6  # degrees of rounding in R - R^T
        assert metrics.translation_error(estimate, truth).max_m < EXACT


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_all_errors_ignore_the_choice_of_world_frames(seed):
    truth = wander(seed)
    estimate = disturbed(truth, seed)
    moved, truth_moved = motion(seed + 1) @ estimate, motion(seed + 2) @ truth
    for measure in (metrics.absolute_error, metrics.relative_error, metrics.translation_error):
        np.testing.assert_allclose(measure(estimate, truth)[:4], measure(moved, truth_moved)[:4], atol=1e-8)


def test_translation_error_is_not_aligned():
    """A first rotation off by 0.1 rad swings a straight path of 3 m by 2 sin(0.05) times the distance."""
    truth = np.tile(np.eye(4), (4, 1, 1))
    truth[:, 0, 3] = np.arange(4)
    estimate = truth.copy()
    estimate[0, :3, :3] = Rotation.from_rotvec([0, 0, 0.1]).as_matrix()
    expected = 2 * np.sin(0.05) * np.arange(4)
    found = metrics.translation_error(estimate, truth)
    assert found.mean_m == pytest.approx(expected.mean()) and found.max_m == pytest.approx(expected.max())
    assert found.rmse_m == pytest.approx(np.sqrt((expected**2).mean()))
    assert metrics.absolute_error(estimate, truth).max_m < EXACT


def test_constant_drift_shows_in_relative_error_by_interval():
    truth = np.tile(np.eye(4), (10, 1, 1))
    estimate = truth.copy()
    estimate[:, 2, 3] = 0.01 * np.arange(10)
    for delta in (1, 3, 9):
        found = metrics.relative_error(estimate, truth, delta)
        assert found.trans_rmse_m == pytest.approx(0.01 * delta) and found.pairs == 10 - delta


def test_missing_poses_are_left_out_and_counted():
    truth = wander(3)
    estimate = disturbed(truth, 4)
    holes = truth.copy()
    holes[[5, 17]] = np.nan
    holes[30, 0, 3] = np.inf
    gaps = estimate.copy()
    gaps[[17, 40]] = np.nan
    kept = np.setdiff1d(np.arange(len(truth)), [5, 17, 30, 40])
    found, expected = metrics.absolute_error(gaps, holes), metrics.absolute_error(estimate[kept], truth[kept])
    assert found[:5] == pytest.approx(expected[:5])
    assert (found.poses, found.missing_truth, found.missing_estimate) == (len(kept), 3, 1)
    assert metrics.translation_error(gaps, holes).mean_m == pytest.approx(
        metrics.translation_error(estimate[kept], truth[kept]).mean_m
    )
    relative = metrics.relative_error(gaps, holes, 2)
    # each of the four missing rows is in two pairs of interval 2, and no pair holds two of them
    assert (relative.pairs, relative.missing_pairs) == (58 - 8, 8)


def test_te_starts_at_the_first_common_frame():
    truth = wander(1)
    estimate = disturbed(truth, 2)
    truth[:3] = np.nan
    found = metrics.translation_error(estimate, truth)
    assert found.mean_m == pytest.approx(metrics.translation_error(estimate[3:], truth[3:]).mean_m)


@pytest.mark.parametrize(
    "measure", [metrics.absolute_error, metrics.relative_error, metrics.translation_error]
)
def test_too_few_poses_are_an_input_error(measure):
    truth = np.full((5, 4, 4), np.nan)
    truth[0] = np.eye(4)
    with pytest.raises(InputError, match="needs at least"):
        measure(np.tile(np.eye(4), (5, 1, 1)), truth)


def test_an_interval_longer_than_the_path_is_an_input_error():
    with pytest.raises(InputError, match="RPE over 60"):
        metrics.relative_error(wander(0), wander(0), 60)
    with pytest.raises(InputError, match="at least 1"):
        metrics.relative_error(wander(0), wander(0), 0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-9, np.pi])
def test_angles_keep_their_digits_at_both_ends(angle):
    R = Rotation.from_rotvec(angle * np.array([[0.6, 0.0, 0.8]])).as_matrix()
    assert metrics.angles(R)[0] == pytest.approx(angle, abs=1e-15, rel=1e-6)


def write_tum(path, T):
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    np.savetxt(path, np.column_stack([np.arange(len(T)) / 30, T[:, :3, 3], quaternions]), fmt="%.17g")


def evo(program: str, home: Path, *arguments: str) -> dict[str, float]:
    """Statistics printed by an evo program. It keeps its settings in the home folder."""
    command = [str(Path(sys.executable).parent / program), "tum", *arguments, "-v"]
    environment = {**os.environ, "HOME": str(home), "MPLBACKEND": "Agg"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    return {key: float(value) for key, value in re.findall(r"^\s*(\w+)\s+([-\d.e]+)$", done.stdout, re.M)}


ORACLE = 1e-6
"""evo prints six decimals, which rounds by half of this."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    if not (Path(sys.executable).parent / "evo_ape").exists():
        pytest.skip("evo is not installed beside this Python")
    folder = tmp_path_factory.mktemp("evo")
    truth = wander(11, count=80)
    estimate = motion(12) @ disturbed(truth, 13)
    write_tum(folder / "truth.txt", truth)
    write_tum(folder / "estimate.txt", estimate)
    return folder, estimate, truth


def test_ate_agrees_with_evo(recorded):
    folder, estimate, truth = recorded
    theirs = evo("evo_ape", folder, str(folder / "truth.txt"), str(folder / "estimate.txt"), "--align")
    ours = metrics.absolute_error(estimate, truth)
    assert ours.rmse_m == pytest.approx(theirs["rmse"], abs=ORACLE)
    assert ours.mean_m == pytest.approx(theirs["mean"], abs=ORACLE)
    assert ours.median_m == pytest.approx(theirs["median"], abs=ORACLE)
    assert ours.max_m == pytest.approx(theirs["max"], abs=ORACLE)


@pytest.mark.parametrize("delta", [1, 7])
def test_rpe_agrees_with_evo(recorded, delta):
    folder, estimate, truth = recorded
    ours = metrics.relative_error(estimate, truth, delta)
    files = str(folder / "truth.txt"), str(folder / "estimate.txt")
    interval = ["--delta", str(delta), "--delta_unit", "f", "--all_pairs"]
    trans = evo("evo_rpe", folder, *files, *interval, "-r", "trans_part")
    rot = evo("evo_rpe", folder, *files, *interval, "-r", "angle_deg")
    assert ours.trans_rmse_m == pytest.approx(trans["rmse"], abs=ORACLE)
    assert ours.trans_mean_m == pytest.approx(trans["mean"], abs=ORACLE)
    assert ours.rot_rmse_deg == pytest.approx(rot["rmse"], abs=ORACLE)
    assert ours.rot_mean_deg == pytest.approx(rot["mean"], abs=ORACLE)


def test_te_agrees_with_evo(recorded):
    folder, estimate, truth = recorded
    files = str(folder / "truth.txt"), str(folder / "estimate.txt")
    theirs = evo("evo_ape", folder, *files, "--align_origin")
    assert metrics.translation_error(estimate, truth).mean_m == pytest.approx(theirs["mean"], abs=ORACLE)
