"""The program called in this process, and copies of one small sequence for it to fail on."""

from __future__ import annotations

import csv
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np
import pytest
import trimesh

from mipsjax.app.run import main
from mipsjax.config.sections import InputConfig
from mipsjax.data.synth import open_synth
from mipsjax.data.synth.export import export_tum
from mipsjax.data.trajectory import known_poses, read_tum
from mipsjax.submaps.state import Status

FRAMES = 12
"""Of the exported sequence: enough for a second keyframe."""


class Result(NamedTuple):
    """What a call of the program left."""

    code: int
    stdout: str
    stderr: str
    out: Path

    @property
    def metrics(self) -> dict[str, Any]:
        return json.loads((self.out / "metrics.json").read_text())

    @property
    def statuses(self) -> list[str]:
        lines = (self.out / "status.csv").read_text().splitlines()[1:]
        return [line.split(",")[2] for line in lines]

    @property
    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.out / "events.jsonl").read_text().splitlines()]


class Program:
    """Calls `main` with the tiny preset and checks what holds for every call."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.out, self._capsys = folder / "out", capsys

    def __call__(self, sequence: Path | str, *options: str, mesh: bool = False) -> Result:
        more = [] if mesh else ["--no-mesh"]
        more += [] if "--out" in options else ["--out", str(self.out)]
        before = contents(Path(sequence))
        result = self.plain(str(sequence), "--preset", "tiny", *more, *options)
        assert contents(Path(sequence)) == before, "the input was written to"
        return result

    def plain(self, *arguments: str) -> Result:
        """Without any option of its own."""
        self._capsys.readouterr()
        out = Path(arguments[arguments.index("--out") + 1]) if "--out" in arguments else self.out
        before = hidden(out)
        with jax.numpy_rank_promotion("allow"):  # as users have it
            code = main(list(arguments))
        printed = self._capsys.readouterr()
        assert "Traceback" not in printed.out + printed.err
        assert len(printed.err.strip().splitlines()) == (0 if code == 0 else 1), printed.err
        check_outputs(out)
        assert hidden(out) <= before, "a lock or half a file is left"
        return Result(code, printed.out, printed.err, out)


def check_outputs(out: Path) -> None:
    """Whatever is there is whole, readable and finite."""
    if not os.path.isdir(out):
        return
    if (out / "trajectory.txt").exists():
        found = read_tum(out / "trajectory.txt")
        # Of a camera that was never found in a map no pose is known
        options = json.loads((out / "config.json").read_text()).get("options", {})
        in_map = options.get("map") is not None
        assert (len(found.timestamps) or in_map) and known_poses(found.T_world_cam).all()
    for path in out.glob("*.json*"):
        for line in [path.read_text()] if path.suffix == ".json" else path.read_text().splitlines():
            json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    if (out / "status.csv").exists():
        check_status((out / "status.csv").read_text())
    if (out / "mesh.ply").exists():
        mesh = trimesh.load_mesh(out / "mesh.ply", process=False)
        assert np.isfinite(mesh.vertices).all()


def check_status(text: str) -> None:
    """Of a `status.csv`: whole lines, finite numbers, and what is not known left empty."""
    names, *rows = csv.reader(text.splitlines())
    for row in rows:
        cells = dict(zip(names, row, strict=True))
        assert cells.pop("status") in map(str, Status)
        assert (cells.pop("found") + cells.pop("note")).isprintable()
        for name in ("surfaces", "together", "free"):  # six numbers of a tracked frame
            numbers = [float(number) for number in cells.pop(name).split()]
            assert len(numbers) in (0, 6) and all(map(math.isfinite, numbers))
        assert all(math.isfinite(float(cell)) for cell in cells.values() if cell)


def hidden(folder: Path) -> set[Path]:
    return set(folder.glob(".*")) if os.path.isdir(folder) else set()


def contents(folder: Path) -> dict[Path, tuple[int, int]]:
    """Size and time of all that is in a folder; nothing for a built-in sequence."""
    found = ((path, path.lstat()) for path in folder.rglob("*"))
    return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in found}


@pytest.fixture
def program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Program:
    return Program(tmp_path, capsys)


def export(folder: Path) -> Path:
    """Writes `synth:tiny` in the TUM layout."""
    export_tum(open_synth("tiny", slice(FRAMES), InputConfig()), folder, voxel_m=None)
    return folder


@pytest.fixture
def sequence(exported: Path, tmp_path: Path) -> Path:
    """A copy of it to spoil."""
    return shutil.copytree(exported, tmp_path / "sequence")


def image(folder: Path, kind: str, number: int) -> Path:
    """File of one frame; `kind` is rgb or depth."""
    return sorted((folder / kind).iterdir())[number]


def read(path: Path) -> np.ndarray:
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None
    return pixels


def write(path: Path, pixels: np.ndarray) -> None:
    assert cv2.imwrite(str(path), pixels)
