"""The fault cases of the reliability contract, by their numbers, on copies of a small sequence."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
import trimesh

import running
from compilations import compilations
from mipsjax.app import run, signals
from mipsjax.app.results_folder import LOCK, claimed, is_ours
from mipsjax.slam import step as slam
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.state import SlamState
from running import FRAMES, Program, Result, image, read, write

# Fixtures: as assignments, so that parameters of the same name are no redefinitions of an import
program, sequence = running.program, running.sequence

BAD = 5
"""The frame that is spoiled."""


def spoil(folder: Path, kind: str, change: Callable[[bytes], bytes]) -> None:
    path = image(folder, kind, BAD)
    path.write_bytes(change(path.read_bytes()))


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0x10]) + data[middle + 1 :]


def edit_depth(folder: Path, numbers: range, change: Callable[[np.ndarray], np.ndarray]) -> None:
    for number in numbers:
        path = image(folder, "depth", number)
        write(path, change(read(path)))


def edit_camera(folder: Path, **values: float) -> None:
    path = folder / "camera.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def is_good(result: Result) -> bool:
    return result.code == 0 and result.metrics["status"] == "ok"


@pytest.mark.fault(1)
def test_missing_folder_or_a_file(program: Program, sequence: Path) -> None:
    result = program(sequence / "nothing" / "here")
    assert result.code == 3 and str(sequence / "nothing" / "here") in result.stderr
    assert result.stderr.endswith(f"the nearest folder that does is {sequence}\n")
    result = program(sequence / "rgb.txt")
    assert result.code == 3 and "rgb.txt" in result.stderr
    assert not program.out.exists()


@pytest.mark.fault(2)
def test_unknown_layout(program: Program, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    result = program(tmp_path / "empty")
    assert result.code == 3 and "tum" in result.stderr and "nothing" in result.stderr


@pytest.mark.fault(3)
def test_two_layouts(program: Program, sequence: Path) -> None:
    (sequence / "color").mkdir()
    result = program(sequence)
    assert result.code == 3 and "--layout" in result.stderr
    assert is_good(program(sequence, "--layout", "tum"))


@pytest.mark.parametrize("kind", ["rgb", "depth"])
@pytest.mark.fault(4, 5)
def test_missing_image(program: Program, sequence: Path, kind: str) -> None:
    image(sequence, kind, BAD).unlink()
    result = program(sequence)
    assert is_good(result)
    assert result.statuses.count("skipped") == (kind == "depth")
    assert [bad["index"] for bad in result.metrics["bad_frames"]] == [BAD]
    assert result.metrics["frames"] == FRAMES


@pytest.mark.parametrize("change", [lambda data: b"", lambda data: data[: len(data) // 2], flipped])
@pytest.mark.fault(6, 7, 8)
def test_damaged_depth(
    program: Program,
    sequence: Path,
    change: Callable[[bytes], bytes],
) -> None:
    spoil(sequence, "depth", change)
    result = program(sequence)
    assert is_good(result) and result.statuses[BAD] == "skipped"
    (event,) = [event for event in result.events if event["event"] == "bad_frame"]
    assert event["index"] == BAD and event["reason"].startswith("unreadable_depth")


@pytest.mark.fault(9)
def test_truncated_jpeg_keeps_its_depth(program: Program, sequence: Path) -> None:
    path = image(sequence, "rgb", BAD)
    _, data = cv2.imencode(".jpg", read(path))
    path.write_bytes(data.tobytes()[: len(data) // 2])
    result = program(sequence)
    assert is_good(result) and result.statuses[BAD] == "ok"
    assert "truncated JPEG" in result.metrics["bad_frames"][0]["reason"]


@pytest.mark.fault(10)
def test_one_frame_of_another_size(program: Program, sequence: Path) -> None:
    write(image(sequence, "depth", BAD), np.full((30, 40), 5000, np.uint16))
    result = program(sequence)
    assert is_good(result) and result.statuses[BAD] == "skipped"
    assert "40 x 30" in result.metrics["bad_frames"][0]["reason"]


@pytest.mark.parametrize(("size", "code"), [((160, 120), 0), ((80, 80), 3)])
@pytest.mark.fault(11)
def test_colour_of_another_size(
    program: Program,
    sequence: Path,
    size: tuple[int, int],
    code: int,
) -> None:
    for number in range(FRAMES):
        path = image(sequence, "rgb", number)
        write(path, cv2.resize(read(path), size))
    result = program(sequence)
    assert result.code == code
    assert f"{size[0]} x {size[1]}" in result.stdout + result.stderr


@pytest.mark.parametrize("pixels", [np.full((60, 80), 9, np.uint8), np.full((60, 80, 3), 9, np.uint16)])
@pytest.mark.fault(12)
def test_depth_of_a_wrong_type(program: Program, sequence: Path, pixels: np.ndarray) -> None:
    edit_depth(sequence, range(FRAMES), lambda _: pixels)
    result = program(sequence)
    assert result.code == 3 and "16-bit single channel" in result.stderr and ".png" in result.stderr


@pytest.mark.fault(13)
def test_one_frame_without_depth(program: Program, sequence: Path) -> None:
    edit_depth(sequence, range(BAD, BAD + 1), np.zeros_like)
    result = program(sequence)
    assert is_good(result) and result.statuses[BAD] == "skipped"


@pytest.mark.fault(14)
def test_waits_for_the_first_usable_frame(program: Program, sequence: Path) -> None:
    edit_depth(sequence, range(BAD), np.zeros_like)
    result = program(sequence)
    assert is_good(result)
    assert result.statuses == ["skipped"] * BAD + ["ok"] * (FRAMES - BAD)
    assert result.metrics["ate_rmse_m"] < 0.05


@pytest.mark.fault(14)
def test_nothing_usable(program: Program, sequence: Path) -> None:
    edit_depth(sequence, range(1, FRAMES), np.zeros_like)
    image(sequence, "rgb", 0).unlink()
    result = program(sequence)
    assert result.code == 3 and "usable" in result.stderr
    result = program(sequence, "--input.max-bad-frames", "4")
    assert result.code == 3 and "none of 5" in result.stderr
    assert f"the other {FRAMES - 5} were not read: --input.max-bad-frames" in result.stderr


@pytest.mark.fault(15)
def test_hardly_any_pixel(program: Program, sequence: Path) -> None:
    keep = np.random.default_rng(0).random((60, 80)) < 0.01
    edit_depth(sequence, range(BAD, BAD + 1), lambda depth: np.where(keep, depth, 0).astype(np.uint16))
    result = program(sequence)
    assert result.code == 0
    assert result.statuses[BAD] == "weak" and set(result.statuses) == {"ok", "weak"}
    shutil.rmtree(result.out)
    with compilations() as compiled:
        assert program(sequence).code == 0
    assert not compiled


@pytest.mark.fault(17)
def test_saturated_pixels(program: Program, sequence: Path) -> None:
    def saturate(depth: np.ndarray) -> np.ndarray:
        depth[:20] = 65535
        return depth

    edit_depth(sequence, range(FRAMES), saturate)
    assert is_good(program(sequence, "--input.depth-max", "20"))  # they would be 13 m


@pytest.mark.fault(18)
def test_depth_scale(program: Program, sequence: Path) -> None:
    result = program(sequence, "--depth-scale", "5e6")
    assert result.code == 3 and "--depth-scale" in result.stderr and "median depth" in result.stderr
    for factor in ("0.2", "5"):
        result = program(sequence, "--depth-scale", str(5000 * float(factor)), "--inspect")
        assert result.code == 0 and "is --depth-scale right?" in result.stdout, factor


@pytest.mark.fault(19)
def test_intrinsics(program: Program, sequence: Path) -> None:
    assert program(sequence, "--intrinsics", "65", "65", "39", "400").code == 3
    assert program(sequence, "--intrinsics", "65", "-65", "39", "29", "--inspect").code == 0
    edit_camera(sequence, fy=-65.0)
    result = program(sequence)
    assert result.code == 3 and "--intrinsics" in result.stderr


@pytest.mark.parametrize("rows", ["nan", "none", "few"])
@pytest.mark.fault(26, 28)
def test_holes_in_the_ground_truth(program: Program, sequence: Path, rows: str) -> None:
    path = sequence / "groundtruth.txt"
    lines = path.read_text().splitlines()
    if rows == "none":
        path.unlink()
    elif rows == "few":
        path.write_text("\n".join(lines[:3]) + "\n")
    else:
        spoiled = [
            f"{line.split()[0]} nan inf 0 0 0 0 1" if n > BAD else line for n, line in enumerate(lines)
        ]
        path.write_text("\n".join(spoiled) + "\n")
    result = program(sequence)
    assert is_good(result)
    if rows == "none":
        assert "ate_rmse_m" not in result.metrics and not (result.out / "trajectory_gt.txt").exists()
    elif rows == "few":
        assert result.metrics["ate_rmse_m"] is None and "at least" in result.metrics["protocol"]["ate_rmse_m"]
    else:
        assert f"{FRAMES - BAD} without truth" in result.metrics["protocol"]["ate_rmse_m"]
        assert result.metrics["ate_rmse_m"] < 0.05


@pytest.mark.fault(27)
def test_poses_that_are_hardly_rotations(program: Program, sequence: Path) -> None:
    (sequence / "rgb").rename(sequence / "color")
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        (sequence / name).unlink()
    skewed = np.tile(np.eye(4), (FRAMES, 1, 1))
    skewed[:, :3, :3] *= 1 + 4e-4
    skewed[BAD, 0] *= -1
    np.savetxt(sequence / "poses.txt", skewed.reshape(FRAMES, 16))
    result = program(sequence, "--layout", "folder", "--depth-scale", "5000")
    assert is_good(result) and "mirrored" in result.stdout
    assert "1 without truth" in result.metrics["protocol"]["ate_rmse_m"]


@pytest.mark.parametrize("number", signals.ENDING)
@pytest.mark.fault(40, 41)
def test_a_signal_finishes_the_frame(
    program: Program,
    sequence: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
) -> None:
    step = slam.step

    def interrupted(state: SlamState, *rest: object) -> tuple[SlamState, FrameInfo]:
        if len(state.records) == BAD:
            os.kill(os.getpid(), number)
        return step(state, *rest)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(slam, "step", interrupted)
    before = signal.getsignal(number)
    result = program(sequence)
    assert result.code == 130 and result.metrics["end"] == "interrupted"
    assert result.metrics["frames"] == BAD + 1
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("number", signals.ENDING)
@pytest.mark.fault(40, 41)
def test_a_second_signal_ends_at_once(number: signal.Signals) -> None:
    """The first one leaves all to the system, which ends the process without asking it."""

    def handlers() -> list[object]:
        return [signal.getsignal(number) for number in signals.ENDING]

    before = handlers()
    with signals.noted() as stop:
        assert not stop()
        signal.raise_signal(number)
        assert stop() and handlers() == [signal.SIG_DFL] * len(signals.ENDING)
    assert handlers() == before


@pytest.mark.parametrize("number", signals.ENDING)
def test_a_signal_during_the_mesh_loses_the_mesh_only(
    program: Program,
    sequence: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: signal.Signals,
) -> None:
    def interrupted(*_: object) -> None:
        signal.raise_signal(number)

    monkeypatch.setattr(run, "reconstruct", interrupted)
    result = program(sequence, "--frames", ":3", mesh=True)
    assert result.code == 130 and "all results but the mesh" in result.stderr
    assert result.metrics["mesh"] == "unfinished" and result.metrics["frames"] == 3
    assert (result.out / "trajectory.txt").exists() and not (result.out / "mesh.ply").exists()


@pytest.mark.fault(50)
def test_a_mesh_that_fails_loses_the_mesh_only(
    program: Program, sequence: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        raise MemoryError("no room")

    monkeypatch.setattr(run, "reconstruct", failing)
    result = program(sequence, "--frames", ":3", mesh=True)
    assert result.code == 1 and "too little memory (no room): --volume.max-submaps" in result.stderr
    assert result.metrics["mesh"] == "unfinished" and result.metrics["frames"] == 3
    assert (result.out / "trajectory.txt").exists() and (result.out / "status.csv").exists()


def test_truth_in_surveyed_coordinates(program: Program, sequence: Path) -> None:
    """As near the origin, but for steps of the last bits of double precision."""
    place = np.array([691_234.5, 5_335_678.25, 512.125])
    path = sequence / "groundtruth.txt"
    near = program(sequence, "--frames", ":3", mesh=True)
    mesh = trimesh.load_mesh(near.out / "mesh.ply", process=False)
    shutil.rmtree(near.out)
    rows = np.loadtxt(path)
    rows[:, 1:4] += place
    np.savetxt(path, rows, fmt="%.9f")
    far = program(sequence, "--frames", ":3", mesh=True)
    moved = trimesh.load_mesh(far.out / "mesh.ply", process=False)
    assert far.code == 0 and far.metrics["mesh"] == "done"
    assert far.metrics["ate_rmse_m"] == pytest.approx(near.metrics["ate_rmse_m"], abs=1e-4)
    # Cells are whole voxels of the world, so that surfaces agree within one and not vertex by vertex
    spread = [np.percentile(vertices, [5, 50, 95], axis=0) for vertices in (moved.vertices, mesh.vertices)]
    np.testing.assert_allclose(spread[0] - place, spread[1], atol=0.05)
    assert len(np.unique(moved.vertices[:, 1])) > 0.9 * len(np.unique(mesh.vertices[:, 1]))


def test_a_reader_that_goes_away_ends_no_run(exported: Path, tmp_path: Path) -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    options = ["--preset", "tiny", "--frames", ":3", "--no-mesh", "--out", str(tmp_path / "out")]
    command = [sys.executable, "-m", "mipsjax.run", str(exported), *options]
    environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(jax.config.jax_compilation_cache_dir or "")}
    run = subprocess.run(command, stdout=theirs, stderr=subprocess.PIPE, env=environment, timeout=300)
    os.close(theirs)
    assert run.returncode == 0 and b"Traceback" not in run.stderr
    assert (tmp_path / "out" / "metrics.json").exists()


@pytest.mark.fault(46)
def test_folder_cannot_be_written(program: Program, sequence: Path) -> None:
    for out in (sequence / "rgb.txt" / "out", Path("/proc/nowhere"), sequence.parent / ("long" * 100)):
        result = program(sequence, "--out", str(out))
        assert result.code == 5 and str(out) in result.stderr


@pytest.mark.fault(48)
def test_results_are_left_alone(
    program: Program,
    sequence: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(sequence.parent)
    short = (str(sequence), "--preset", "tiny", "--frames", ":3", "--no-mesh")
    assert program.plain(*short).code == 0
    first = (sequence.parent / "runs" / "sequence" / "metrics.json").read_bytes()
    assert program.plain(*short).code == 0
    assert (sequence.parent / "runs" / "sequence-2" / "metrics.json").exists()
    result = program.plain(*short, "--out", "runs/sequence")
    assert result.code == 5 and "finished run" in result.stderr
    assert (sequence.parent / "runs" / "sequence" / "metrics.json").read_bytes() == first


@pytest.mark.fault(49)
def test_a_running_run_is_left_alone(program: Program, sequence: Path) -> None:
    with claimed(program.out):
        result = program(sequence)
        assert result.code == 5 and "in use by another run" in result.stderr
        assert [path.name for path in program.out.iterdir()] == [LOCK]


def test_a_folder_that_is_deleted_meanwhile_loses_nothing(
    program: Program, sequence: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = run.judged

    def deleted(*arguments: object) -> object:
        shutil.rmtree(program.out)
        return judged(*arguments)  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(run, "judged", deleted)
    result = program(sequence, "--frames", ":3")
    assert result.code == 0 and "deleted or taken" in result.stdout and not program.out.exists()
    beside = program.out.with_name("out-2")
    assert json.loads((beside / "metrics.json").read_text())["frames"] == 3 and is_ours(beside)


@pytest.mark.fault(57)
def test_input_is_never_written_to(program: Program, sequence: Path) -> None:
    """`Program` sees to it at every run, and here where the results are meant to lie in the input."""
    assert program(sequence, "--out", str(sequence / "out")).code == 5


@pytest.mark.fault(53)
def test_empty_mesh(program: Program, sequence: Path) -> None:
    result = program(sequence, "--mesh.depth-max", "0.05", "--frames", ":3", mesh=True)
    assert result.code == 0 and "mesh is empty" in result.stdout
    assert (result.out / "mesh.ply").read_bytes().startswith(b"ply")
    assert [event for event in result.events if event["event"] == "warning"]


@pytest.mark.fault(54)
def test_one_frame(program: Program, sequence: Path) -> None:
    assert program(sequence, "--frames", ":1").code == 3
    assert program("synth:tiny", "--frames", ":1").code == 3


def test_too_many_bad_frames(program: Program, sequence: Path) -> None:
    edit_depth(sequence, range(3, FRAMES), np.zeros_like)
    result = program(sequence, "--input.max-bad-frames", "4")
    assert result.code == 3 and "--input.max-bad-frames" in result.stderr
    assert result.metrics["frames"] == 8 and result.metrics["end"] == "bad frames"
    again = program.plain("--resume", str(result.out))
    assert (
        again.code == 3 and "has ended (bad frames)" in again.stderr and "of 8 frames 5 were" in again.stderr
    )


@pytest.mark.parametrize(
    ("lost", "code", "status"), [(range(5, 7), 0, "degraded"), (range(8, FRAMES), 4, "failed")]
)
@pytest.mark.fault(29)
def test_lost_for_a_while_and_for_good(
    program: Program,
    sequence: Path,
    lost: range,
    code: int,
    status: str,
) -> None:
    # Noise fits nowhere; a wall right before the camera may be taken for one of the map
    rng = np.random.default_rng(0)
    edit_depth(sequence, lost, lambda depth: rng.integers(5000, 30000, depth.shape).astype(np.uint16))
    result = program(sequence)
    assert result.code == code and result.metrics["status"] == status
    assert (f"first in frame {lost[0]};" in result.stderr) == (status == "failed")
    assert result.metrics["status_counts"]["lost"] == len(lost)
    assert [event["index"] for event in result.events if event["event"] == "lost"] == list(lost)
    again = program.plain("--resume", str(result.out))
    assert again.code == code and "has ended (done)" in again.stdout + again.stderr
    assert (f"tracking was lost in {len(lost)}:" in again.stderr) == (status == "failed")


@pytest.mark.fault(57)
def test_odd_path_and_link(program: Program, sequence: Path) -> None:
    shutil.move(sequence, sequence.parent / "ein Weg ü")
    (sequence.parent / "link").symlink_to(sequence.parent / "ein Weg ü")
    assert is_good(program(sequence.parent / "link", "--frames", ":4"))


@pytest.mark.fault(58)
def test_a_clock_that_jumps_changes_nothing_and_no_terminal_is_needed(
    program: Program, sequence: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hours = count(10**9, -3600)
    monkeypatch.setattr(time, "time", lambda: float(next(hours)))
    result = program(sequence)
    assert is_good(result)
    times = [result.metrics["seconds"], *result.metrics["seconds_per_stage"].values()]
    assert min(times) >= 0 and max(times) < 600
    # One line at the beginning, one for the last frame, one at the end
    assert "\r" not in result.stdout and len(result.stdout.splitlines()) == 3
