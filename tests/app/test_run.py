"""The program: options, results, the same bytes twice, and what importing the package loads."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import mipsjax
import running
from mipsjax.app import outputs
from mipsjax.app.commandline import parse
from mipsjax.config.presets import preset
from mipsjax.core import mapping, tracking
from mipsjax.data.trajectory import read_tum
from mipsjax.slam import step as slam
from running import FRAMES, Program

# A fixture: as an assignment, so that a parameter of the same name is no redefinition of an import
program = running.program

RESULTS = {
    "trajectory.txt", "trajectory_gt.txt", "mesh.ply", "mesh.png", "metrics.json", "config.json",
    "status.csv", "events.jsonl", "loops.json", "map",
}  # fmt: skip

PUBLIC = {
    "PRESETS", "Blended", "Config", "ConfigError", "Frame", "FrameInfo", "Frames", "InputError", "Intrinsics",
    "Learned", "MipsjaxError", "OutputError", "Sequence", "SlamState", "Status", "Submap", "TrackingLostError",
    "Views", "blend", "blend_of_none", "color", "continued", "create", "finish", "fitness", "init", "load",
    "localise", "open_sequence", "preset", "reconstruct_mesh", "refine", "save", "start", "step", "track",
    "trajectory", "tsdf", "validate",
}  # fmt: skip


def test_a_whole_run(program: Program, exported: Path) -> None:
    result = program(exported, mesh=True)
    assert result.code == 0 and result.stderr == ""
    assert {path.name for path in result.out.iterdir()} == RESULTS
    metrics = result.metrics
    assert metrics["status"] == "ok" and metrics["frames"] == FRAMES and metrics["loops"] == 0
    assert metrics["status_counts"]["ok"] == FRAMES and metrics["submaps"] == 1 and metrics["keyframes"] >= 1
    # 12 frames of 1 cm motion: the tiny preset reaches about 1 cm
    assert 0 < metrics["ate_rmse_m"] < 0.03 and 0 < metrics["rpe_rot_deg"] < 1.5
    assert metrics["map_bytes"] < 4e6 and metrics["peak_memory_bytes"] > 1e6
    assert metrics.keys() >= metrics["protocol"].keys()
    assert len(read_tum(result.out / "trajectory.txt").timestamps) == FRAMES
    assert len(result.statuses) == FRAMES


def test_the_first_pose_is_the_true_one(program: Program, exported: Path) -> None:
    out = program(exported, "--frames", ":2").out
    first, truth = (read_tum(out / name).T_world_cam[0] for name in ("trajectory.txt", "trajectory_gt.txt"))
    # Both are written with nine decimals
    assert abs(first - truth).max() < 1e-8


def test_same_seed_same_bytes(
    program: Program, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outputs, "save_picture", lambda *_: None)  # takes longer than the rest
    one, two = (program(exported, "--out", str(tmp_path / name), mesh=True) for name in "ab")
    for name in ("trajectory.txt", "mesh.ply"):
        assert (one.out / name).read_bytes() == (two.out / name).read_bytes()


def test_synthetic_sequence_measures_its_mesh(program: Program) -> None:
    result = program("synth:tiny", mesh=True)
    metrics = result.metrics
    # A voxel of 5 cm and a field that has hardly learned
    assert metrics["accuracy_m"] < 0.05 and metrics["f_score"] > 0.5
    assert 0 < metrics["completion_ratio"] <= 1 and "culled" in metrics["protocol"]["completeness_m"]


def test_nothing_compiles_anew_for_other_input_or_mesh_options(program: Program, exported: Path) -> None:
    program(exported, "--frames", ":3")
    before = tracking.track._cache_size(), mapping.refine._cache_size()
    options = ("--input.max-bad-frames", "7", "--mesh.voxel", "0.04")
    program(exported, "--frames", ":3", "--out", str(program.out) + "2", *options)
    assert (tracking.track._cache_size(), mapping.refine._cache_size()) == before


def test_config_is_written_whole(program: Program, exported: Path) -> None:
    result = program(exported, "--map.steps", "3", "--frames", ":2", "--seed", "0")
    content = json.loads((result.out / "config.json").read_text())
    assert content["config"]["map"]["steps"] == 3 and content["seed"] == 0
    assert content["options"]["preset"] == "tiny" and content["options"]["sequence"] == str(exported)
    assert content["versions"]["mipsjax"] == mipsjax.__version__ and content["python"] and content["platform"]


def test_quiet_and_inspect(program: Program, exported: Path) -> None:
    result = program(exported, "--quiet", "--frames", ":2")
    assert result.code == 0 and result.stdout == result.stderr == ""
    out = result.out.parent / "inspected"
    result = program(exported, "--inspect", "--out", str(out))
    assert result.code == 0 and "layout        tum" in result.stdout and not out.exists()


def test_order_of_preset_file_and_options(tmp_path: Path) -> None:
    path = tmp_path / "some.toml"
    path.write_text("seed = 4\n[map]\nsteps = 2\npixels = 32\n")
    found = parse(["synth:tiny", "--preset", "tiny", "--config", str(path), "--map.pixels", "16"])
    cfg = found.settings
    assert (cfg.seed, cfg.map.steps, cfg.map.pixels) == (4, 2, 16)
    assert cfg.map.first_steps == preset("tiny").map.first_steps


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no sequence given"),
        (["s", "--track.ro.particls", "3"], "did you mean --track.ro.particles?"),
        (["s", "--particles", "3"], "did you mean --track.ro.particles?"),
        (["s", "--map.steps", "many"], "--map.steps"),
        (["s", "--map.steps", "-3"], "map.steps must be at least 0, got -3"),
        (["s", "--preset", "fast"], "there are default, paper, tiny"),
        (["s", "--frames", "4"], "START:STOP:STEP"),
        (["s", "--frames"], "--frames"),
        (["s", "--field.encoding", "x"], "--field.encoding"),
        (["s", "t"], "t"),
        (["s", "--config", "none.toml"], "none.toml"),
        (["s", "--intrinsics", "1", "2"], "--intrinsics takes FX FY CX CY"),
        (["s", "--layout", "zip"], "--layout"),
    ],
)
@pytest.mark.fault(51)
def test_wrong_options(program: Program, exported: Path, arguments: list[str], message: str) -> None:
    result = program.plain(*(str(exported) if word == "s" else word for word in arguments))
    assert result.code == 2 and message in result.stderr and result.stdout == ""


def test_help_lists_every_option_with_its_docstring(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parse(["--help"])
    assert caught.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    for expected in ("--track.ro.particles INT", "--frames START:STOP:STEP", "Depth units per metre"):
        assert expected in text


def test_help_shows_what_the_preset_sets(capsys: pytest.CaptureFixture[str]) -> None:
    shown = []
    for arguments in (["--help"], ["--preset", "paper", "--help"], ["--preset=paper", "--help"]):
        with pytest.raises(SystemExit):
            parse(arguments)
        shown.append(re.search(r"ro\.particles INT.*?default: (\d+)", capsys.readouterr().out, re.DOTALL)[1])
    assert shown == [str(preset(name).track.ro.particles) for name in ("default", "paper", "paper")]


def test_a_bug_is_one_line_and_a_saved_traceback(
    program: Program, exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("a test")

    monkeypatch.setattr(slam, "step", broken)
    result = program(exported)
    assert result.code == 1 and "RuntimeError: a test" in result.stderr
    (saved,) = result.out.glob("mipsjax-error-*.txt")
    assert str(saved) in result.stderr and "Traceback" in saved.read_text()


def test_importing_starts_no_device_and_loads_no_heavy_package() -> None:
    code = (
        "import sys, mipsjax; dir(mipsjax); mipsjax.__version__; mipsjax.Config; mipsjax.preset('tiny');"
        "heavy = {'jax', 'gtsam', 'cv2', 'trimesh', 'skimage', 'matplotlib', 'tyro', 'viser'};"
        "print(sorted(heavy & set(sys.modules)));"
        "mipsjax.start, mipsjax.track, mipsjax.refine, mipsjax.fitness;"
        "import jax._src.xla_bridge as bridge; print(bridge._backends)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "{}"]


def test_public_names_exist() -> None:
    assert mipsjax._PLACES.keys() == PUBLIC
    for name in PUBLIC:
        assert getattr(mipsjax, name) is not None
    assert callable(mipsjax.reconstruct_mesh)
    with pytest.raises(AttributeError, match="nothing"):
        mipsjax.nothing  # noqa: B018
