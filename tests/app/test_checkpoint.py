"""A run that was cut short goes on to the same bytes, or says in one line why it cannot."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import running
from mipsjax.app import checkpoint, outputs
from mipsjax.app.results_folder import LOCK
from mipsjax.app.run import main
from mipsjax.errors import OutputError
from mipsjax.slam import step as slam
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps import saved
from mipsjax.submaps.state import SlamState
from running import FRAMES, Program, image, read, write

pytestmark = pytest.mark.slow

# Fixtures: as assignments, so that parameters of the same name are no redefinitions of an import
program = running.program

CUT = 6
"""Frames after which a run is cut short; the one that is under way is finished."""
ALWAYS = ("--checkpoint.every-seconds", "0.000001")
Step = Callable[..., tuple[SlamState, FrameInfo]]


def cut_short(step: Step) -> Step:
    """A step that hears Ctrl-C."""

    def interrupted(state: SlamState, *rest: object) -> tuple[SlamState, FrameInfo]:
        if len(state.records) == CUT:
            os.kill(os.getpid(), signal.SIGINT)
        return step(state, *rest)

    return interrupted


def begun(sequence: str, out: Path, *options: str) -> Path:
    """The folder of a run that was interrupted."""
    arguments = [sequence, "--preset", "tiny", "--quiet", "--no-mesh", "--out", str(out), *options]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slam, "step", cut_short(slam.step))
        assert main(arguments) == 130
    return out


@pytest.fixture(scope="module")
def whole(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run, never interrupted."""
    out = tmp_path_factory.mktemp("whole") / "out"
    assert main([str(exported), "--preset", "tiny", "--quiet", "--no-mesh", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def interrupted(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return begun(str(exported), tmp_path_factory.mktemp("cut") / "out", *ALWAYS)


@pytest.fixture
def cut(interrupted: Path, tmp_path: Path) -> Path:
    """A copy of its folder, to be spoiled or gone on with."""
    return shutil.copytree(interrupted, tmp_path / "out")


def same_trajectory(one: Path, other: Path) -> bool:
    return (one / "trajectory.txt").read_bytes() == (other / "trajectory.txt").read_bytes()


def without_times(out: Path) -> list[dict[str, str]]:
    """Of status.csv, all but milliseconds."""
    rows = csv.DictReader((out / "status.csv").read_text().splitlines())
    return [{name: cell for name, cell in row.items() if not name.endswith("_ms")} for row in rows]


def test_an_interrupted_run_goes_on_to_the_same_bytes(
    program: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "save_picture", lambda *_: None)  # takes longer than the rest
    frames = ("--frames", f":{FRAMES}")
    never = program("synth:tiny", *frames, "--out", str(tmp_path / "whole"), mesh=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(slam, "step", cut_short(slam.step))
        before = program("synth:tiny", *frames, mesh=True)
    assert before.code == 130 and f"--resume {before.out} goes on" in before.stderr
    assert [path.name for path in checkpoint.written(before.out)] == [f"{CUT + 1:06d}.npz"]
    assert before.metrics["frames"] == CUT + 1
    after = program.plain("--resume", str(before.out))
    assert after.code == 0 and f"goes on after {CUT + 1} frames" in after.stdout
    for name in ("trajectory.txt", "mesh.ply"):
        assert (after.out / name).read_bytes() == (never.out / name).read_bytes()
    assert without_times(after.out) == without_times(never.out)
    assert {path.name for path in after.out.iterdir()} == {path.name for path in never.out.iterdir()}
    again = program.plain("--resume", str(before.out))
    assert again.code == 0 and "this run has ended (done), its results are there" in again.stdout


@pytest.mark.fault(42, 43)
def test_a_killed_run_goes_on_to_the_same_bytes(
    program: Program, exported: Path, whole: Path, tmp_path: Path
) -> None:
    """It leaves its lock and half a file behind."""
    out = tmp_path / "out"
    code = f"""
import os, signal, sys, time
from pathlib import Path
from mipsjax.app.results_folder import LOCK
from mipsjax.app.run import main
from mipsjax.slam import step as slam
step, folder = slam.step, Path(sys.argv[1]) / "checkpoint"
def killed(state, *rest):
    if len(state.records) == {CUT}:
        while not list(folder.glob("*.npz")):
            time.sleep(0.01)
        (folder / ".000099.npz.abc.part").write_bytes(b"PK")
        os.kill(os.getpid(), signal.SIGKILL)
    return step(state, *rest)
slam.step = killed
main(sys.argv[2:])
"""
    arguments = [str(exported), "--preset", "tiny", "--quiet", "--no-mesh", "--out", str(out), *ALWAYS]
    done = subprocess.run([sys.executable, "-c", code, str(out), *arguments])
    assert done.returncode == -signal.SIGKILL
    assert (out / LOCK).exists() and not (out / "trajectory.txt").exists()
    refused = program(exported, "--out", str(out))
    assert refused.code == 5 and f"go on with --resume {out}" in refused.stderr
    after = program.plain("--resume", str(out), "--quiet")
    assert after.code == 0 and after.stdout == ""
    assert same_trajectory(out, whole) and not list(out.rglob(".*"))


def test_only_the_last_two_are_kept(cut: Path) -> None:
    found = checkpoint.written(cut)
    assert len(found) == checkpoint.KEPT and found[0].stem == f"{CUT + 1:06d}"
    assert {path.name for path in (cut / checkpoint.FOLDER).iterdir()} == {path.name for path in found}


@pytest.mark.parametrize("how", ["flipped", "truncated", "empty"])
@pytest.mark.fault(43, 44)
def test_where_the_last_one_is_damaged_the_one_before_it_serves(
    program: Program, cut: Path, whole: Path, how: str
) -> None:
    last, before = checkpoint.written(cut)
    data = bytearray(last.read_bytes())
    data[len(data) // 2] ^= 1
    last.write_bytes({"flipped": bytes(data), "truncated": bytes(data[:-100]), "empty": b""}[how])
    result = program_in(program, cut)
    assert result.code == 0 and f"warning: {last}" in result.stdout
    assert f"goes on after frame {int(before.stem)}" in result.stdout
    assert same_trajectory(cut, whole)
    assert any(event["event"] == "warning" for event in result.events)


def program_in(program: Program, folder: Path, *options: str) -> running.Result:
    """`--resume` of a folder, whose results are looked at."""
    program.out = folder
    return program.plain("--resume", str(folder), *options)


@pytest.mark.fault(44)
def test_where_all_are_damaged_nothing_is_made_of_them(program: Program, cut: Path) -> None:
    before = (cut / "trajectory.txt").read_bytes()
    for path in checkpoint.written(cut):
        path.write_bytes(path.read_bytes()[:-1000])
    result = program_in(program, cut)
    assert result.code == 3 and "no checkpoint to go on with" in result.stderr
    assert "is damaged or cut short" in result.stderr
    assert (cut / "trajectory.txt").read_bytes() == before


@pytest.mark.fault(45)
def test_another_version_is_refused(program: Program, cut: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "version", lambda _: "99.0")
        result = program_in(program, cut)
    assert result.code == 3 and "and this is 99.0" in result.stderr
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "_code", lambda: "of another day")
        result = program_in(program, cut)
    assert result.code == 3 and "another state of mipsjax's source" in result.stderr
    earlier = saved.FORMAT
    monkeypatch.setattr(saved, "FORMAT", earlier + 1)
    result = program_in(program, cut)
    assert result.code == 3 and f"has version {earlier} of the format" in result.stderr


@pytest.mark.fault(45)
def test_another_configuration_is_refused(program: Program, cut: Path) -> None:
    path = cut / "config.json"
    content = json.loads(path.read_text())
    content["config"]["map"]["steps"] += 1
    path.write_text(json.dumps(content))
    result = program_in(program, cut)
    assert result.code == 3 and "another configuration" in result.stderr


@pytest.mark.fault(45)
def test_another_sequence_is_refused(program: Program, cut: Path, exported: Path, tmp_path: Path) -> None:
    other = shutil.copytree(exported, tmp_path / exported.name)
    last = image(other, "depth", -1)
    write(last, read(last) + 1)
    path = cut / "config.json"
    content = json.loads(path.read_text())
    content["sequence"]["source"] = str(other)
    path.write_text(json.dumps(content))
    result = program_in(program, cut)
    assert result.code == 3 and "it differs in files" in result.stderr
    shutil.rmtree(other)
    result = program_in(program, cut)
    assert result.code == 3 and "does not exist" in result.stderr


def test_the_sequence_is_found_from_another_folder(
    program: Program, exported: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(exported.parent)
    out = begun(exported.name, tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    assert program_in(program, out).code == 0 and same_trajectory(out, whole)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--map.steps", "3"], "--map.steps cannot be given beside --resume"),
        (["synth:tiny"], "synth:tiny cannot be given beside --resume"),
        (["--seed=3"], "--seed=3 cannot be given beside --resume"),
    ],
)
def test_what_would_change_the_method_is_refused(
    program: Program, cut: Path, arguments: list[str], message: str
) -> None:
    result = program_in(program, cut, *arguments)
    assert result.code == 2 and message in result.stderr and "config.json" in result.stderr


def test_a_folder_without_a_run_is_refused(program: Program, cut: Path, tmp_path: Path) -> None:
    result = program_in(program, tmp_path / "none")
    assert result.code == 3 and "no run to go on with" in result.stderr
    assert not (tmp_path / "none").exists()
    shutil.rmtree(cut / checkpoint.FOLDER)
    result = program_in(program, cut)
    assert result.code == 3 and "has no checkpoint to go on with" in result.stderr
    (cut / "config.json").write_text("{}")
    result = program_in(program, cut)
    assert result.code == 3 and "is not as a run writes it" in result.stderr
    assert program.plain("--resume").code == 2


def test_none_is_written_where_none_is_wanted(exported: Path, tmp_path: Path) -> None:
    off = ("--checkpoint.every-keyframes", "0", "--checkpoint.every-seconds", "0")
    out = begun(str(exported), tmp_path / "out", *off)
    assert not (out / checkpoint.FOLDER).exists()


def test_a_checkpoint_folder_of_somebody_else_is_left_alone(program: Program, exported: Path) -> None:
    theirs = program.out / checkpoint.FOLDER / "model.bin"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("theirs")
    result = program(exported, *ALWAYS)
    assert result.code == 5 and checkpoint.FOLDER in result.stderr
    assert theirs.read_text() == "theirs" and not (program.out / "config.json").exists()


@pytest.mark.parametrize("error", [OutputError("no room"), MemoryError("no room")])
def test_one_that_cannot_be_written_ends_no_run(
    program: Program, exported: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def write(path: Path, data: bytes) -> None:
        raise error

    monkeypatch.setattr(checkpoint, "write_atomically", write)
    result = program(exported, *ALWAYS)
    assert result.code == 0 and "warning: no checkpoint after" in result.stdout
    assert any("no checkpoint after" in event.get("text", "") for event in result.events)


def test_the_run_waits_for_none(interrupted: Path) -> None:
    """A millisecond or so to hand the state over; a thread does the rest. Half of them, since a machine may be busy."""
    rows = csv.DictReader((interrupted / "status.csv").read_text().splitlines())
    waited = sorted(float(row["checkpoint_ms"]) for row in rows)
    assert waited[len(waited) // 2] < 5


def test_one_has_the_time_that_the_run_waited_for_it(interrupted: Path) -> None:
    """The one before the last, which was begun beside the frames."""
    before = checkpoint.read(checkpoint.written(interrupted)[1])
    rows = list(csv.DictReader((interrupted / "status.csv").read_text().splitlines()))
    # status.csv has six digits
    written = [float(row["checkpoint_ms"]) for row in rows[: len(before.infos)]]
    assert [info.checkpoint_ms for info in before.infos] == pytest.approx(written, rel=1e-5)
    assert written[-1] > 0
