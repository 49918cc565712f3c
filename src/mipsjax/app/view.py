"""`python -m mipsjax.view DIR`: the results of a run, finished or cut short, in a browser."""

from __future__ import annotations

import csv
import json
import math
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from time import sleep
from typing import Annotated, Any

import numpy as np
import tyro
from jaxtyping import Float64

from mipsjax.app import signals
from mipsjax.app.commandline import check_port, ended, read_options, say
from mipsjax.app.evaluate import read_mesh
from mipsjax.app.kept_map import read_map
from mipsjax.app.results_folder import CONFIG
from mipsjax.config.options import merged
from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.data.trajectory import read_tum
from mipsjax.errors import ConfigError, InputError, MipsjaxError
from mipsjax.metrics.poses import absolute_error
from mipsjax.submaps.state import SlamState, Status
from mipsjax.viewer import PORT
from mipsjax.viewer.live import HOW_TO_GET_IT, is_installed
from mipsjax.viewer.shown import Shown, ShownMesh, of_mesh, shown

POLL_S = 0.2


@dataclass(frozen=True)
class Options:
    """Shows the results of a run in a browser, until Ctrl-C."""

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder of the results."""
    port: int = PORT
    """Port of the page, or the next one that is free."""


def main(arguments: list[str] | None = None) -> int:
    """The program; returns its exit code. Errors are one line on stderr."""
    return ended(lambda: _main(sys.argv[1:] if arguments is None else arguments))


def _main(arguments: list[str]) -> int:
    names = ["--" + item.name for item in fields(Options)]
    options = read_options(Options, "python -m mipsjax.view", arguments, names, "no folder of results given")
    check_port(options.port, "--port")
    if not is_installed():
        raise ConfigError(f"the viewer takes another package: {HOW_TO_GET_IT}")
    what, mesh = results(options.folder)
    from mipsjax.viewer.stage import Stage

    with signals.noted() as stop:
        stage = Stage(options.port)
        stage.show(what)
        if mesh is not None:
            stage.show_mesh(mesh)
        say(f"{options.folder} at {stage.url}; Ctrl-C ends it")
        while not stop():
            sleep(POLL_S)
        stage.close()
    return 0


def results(folder: Path) -> tuple[Shown, ShownMesh | None]:
    """What there is to show of a folder of results, and the mesh where there is one.

    Raises:
        InputError: it has none, or they are damaged.
    """
    if not (folder / "trajectory.txt").is_file():
        raise InputError(f"{folder}: has no trajectory.txt; name the folder of a run")
    poses = read_tum(folder / "trajectory.txt").T_world_cam
    content = _json(folder / CONFIG)
    state, cfg = _map(folder)
    known = shown(state) if state is not None else _without_map(content)
    mesh, problem = None, ""
    try:
        if (folder / "mesh.ply").is_file():
            mesh = of_mesh(read_mesh(folder / "mesh.ply"), state, cfg)
    except InputError as error:  # an empty one, too
        problem = f"  \n{error}"
    known = known._replace(
        T_world_cam=poses,
        statuses=_statuses(folder, len(poses)),
        T_truth_cam=_truth(folder, poses),
        text=_text(folder) + problem,
    )
    return known, mesh


def _map(folder: Path) -> tuple[SlamState | None, Config | None]:
    """The map that the run kept and its configuration; None where it kept none that can be read."""
    try:
        state, about = read_map(folder)
    except MipsjaxError:
        return None, None
    try:
        return state, merged(Config(), about["config"])
    except (MipsjaxError, KeyError, AttributeError):
        return state, None


def _without_map(content: Any) -> Shown:
    """What is shown of a run that kept no map: no submaps, no loops."""
    try:
        camera = Intrinsics(**content["sequence"]["intrinsics"])
    except (KeyError, TypeError) as error:
        raise InputError(f"{CONFIG}: says nothing of the camera; name the folder of a run") from error
    return Shown(camera, np.zeros((0, 4, 4)), (), (), -1, np.zeros((0, 2, 3)), np.zeros(0, bool), {})


def _statuses(folder: Path, count: int) -> tuple[Status, ...]:
    """Of the frames of the trajectory, which are the last of those in `status.csv`; `ok` where that is missing."""
    try:
        text = (folder / "status.csv").read_text(encoding="utf-8", errors="backslashreplace")
        words = [row["status"] for row in csv.DictReader(text.splitlines())]
        found = [
            next(status for status in Status if str(status) == word)
            for word in words[max(0, len(words) - count) :]
        ]
    except (OSError, KeyError, StopIteration):
        found = []
    return tuple([Status.OK] * (count - len(found)) + found)


def _truth(folder: Path, poses: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "N 4 4"] | None:
    """True poses, aligned to those that were found; None where they cannot be."""
    try:
        truth = read_tum(folder / "trajectory_gt.txt").T_world_cam
        return np.linalg.inv(absolute_error(poses, truth).T_truth_estimate) @ truth
    except (InputError, ValueError):  # there is none, or of other frames
        return None


def _text(folder: Path) -> str:
    """The verdict, in a line or two."""
    content = _json(folder / "metrics.json")
    lines = [f"{content.get('frames', 'some')} frames: **{content.get('status', 'unknown')}**"]
    lines += [str(reason) for reason in content.get("reasons", [])]
    ate = content.get("ate_rmse_m")
    lines += [f"ATE {100 * ate:.2f} cm"] if isinstance(ate, float) and math.isfinite(ate) else []
    return "  \n".join(lines)


def _json(path: Path) -> dict[str, Any]:
    """The object of a file of ours; empty where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
