"""What is shown of a run, the page beside it, and what becomes of a run without one."""

from __future__ import annotations

import importlib.util
import io
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import maps
import running
from mipsjax.app import view
from mipsjax.config.presets import PRESETS
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Frame
from mipsjax.slam import step as slam
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.ids import FrameId, RecordId, SubmapId
from mipsjax.submaps.state import How, Loop, Record, SlamState, Status, trajectory
from mipsjax.viewer import live
from mipsjax.viewer.live import MeshRequest
from mipsjax.viewer.shown import ShownMesh, bare, shown, small
from mipsjax.viewer.stage import COLORINGS, PALETTE, UNKNOWN, Stage, colors_of
from running import FRAMES, Program

pytestmark = pytest.mark.slow

program, sequence = running.program, running.sequence


@pytest.fixture
def state() -> SlamState:
    """Two submaps a metre apart, a loop between them, and a lost frame."""
    shift = maps.pose(translation=(1.0, 0.0, 0.0))
    second = maps.submap(maps.keyframe(1), maps.keyframe(2, shift), T_world_sub=shift)
    state = maps.state(maps.submap(maps.keyframe(0)), second)
    lost = Record(FrameId(7), 0.1, SubmapId(1), RecordId(2), np.eye(4), Status.LOST)
    loop = Loop(RecordId(1), SubmapId(1), SubmapId(0), How.BOX, 1.0, 0.1, 0.1, 0.0)
    return state.with_record(lost)._replace(loops=(loop,), active=SubmapId(1))


def test_what_is_shown_of_a_state(state):
    picture = shown(state, known={RecordId(0)})
    np.testing.assert_array_equal(picture.T_world_cam, trajectory(state))
    assert picture.statuses == (Status.OK, Status.LOST) and picture.active == 1
    assert [submap.keyframes for submap in picture.submaps] == [(0,), (1, 2)]
    np.testing.assert_array_equal(picture.submaps[1].T_world_cam[:, :3, 3], [[1, 0, 0], [2, 0, 0]])
    assert set(picture.images) == {1, 2}, "the first was shown before"
    np.testing.assert_array_equal(picture.loops, [[[2, 0, 0], [0, 0, 0]]])
    assert list(picture.kept) == [False] and "frame 7: **lost**" in picture.text


def test_messages_come_as_they_were_sent(state):
    stream = io.BytesIO()
    for picture in (shown(state), shown(state, known={RecordId(0)})):
        live.send(stream, picture)
    stream.seek(0)
    first, second = live.received(stream)
    assert isinstance(first, type(second)) and len(first.images) == len(second.images) + 1
    # The run was killed in the middle of one
    assert len(list(live.received(io.BytesIO(stream.getvalue()[:-1])))) == 1


def test_images_are_made_small_and_never_large():
    image = np.zeros((48, 64, 3), np.uint8)
    assert small(image) is image and small(image, 32).shape == (24, 32, 3)


MESH = ShownMesh(
    np.eye(3),
    np.array([[0, 1, 2]]),
    np.full((3, 3), 9, np.uint8),
    np.array([0.0, 0.5, 1.0], np.float32),
    np.array([0, len(PALETTE), -1]),
)


def test_a_surface_has_three_colourings():
    by_submap, by_doubt = colors_of(MESH, "submap"), colors_of(MESH, "uncertainty")
    np.testing.assert_array_equal(by_submap, [PALETTE[0], PALETTE[0], UNKNOWN])
    # From green to red
    assert np.all(np.diff(by_doubt[:, 0].astype(int)) > 0) and np.all(np.diff(by_doubt[:, 1].astype(int)) < 0)
    np.testing.assert_array_equal(colors_of(MESH, COLORINGS[0]), MESH.color)
    unknown = MESH._replace(uncertainty=np.full(3, np.nan, np.float32))
    assert np.all(colors_of(unknown, "uncertainty") == UNKNOWN)


def soon(holds: Callable[[], bool], what: str) -> None:
    """Waits until something holds, a few minutes at most: pages are served by what a busy machine leaves."""
    end = time.monotonic() + 200
    while not holds():
        assert time.monotonic() < end, f"does not come: {what}"
        time.sleep(0.01)


@pytest.fixture
def taken() -> Iterator[int]:
    """A port that another program listens at."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield other.getsockname()[1]


def page(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=20) as answer:
        return answer.read()


@pytest.fixture
def stage(taken) -> Iterator[Stage]:
    made = Stage(taken)
    yield made
    made.close()


@pytest.mark.fault(52)
def test_a_page_at_the_next_free_port(stage, taken):
    assert int(stage.url.rsplit(":", 1)[1]) > taken and b"<html" in page(stage.url)


def drawn(stage: Stage, layer: str) -> dict[str, bool]:
    """The nodes of a layer, and which of them are seen."""
    return {name: node.visible for name, node in stage._drawn[layer].items()}


def test_what_is_shown_again_replaces_what_was_there(stage, state):
    for _ in range(2):
        stage.show(shown(state))
        stage.show_mesh(MESH)
    assert set(drawn(stage, "keyframes")) == {"/keyframes/0/0", "/keyframes/1/1", "/keyframes/1/2"}
    assert len(drawn(stage, "submaps")) == 2 and drawn(stage, "loops") and drawn(stage, "mesh")
    kept = stage._drawn["keyframes"]["/keyframes/0/0"]
    moved = state.with_submap(SubmapId(0), T_world_sub=maps.pose(translation=(0.0, 3.0, 0.0)))
    stage.show(shown(moved))
    assert stage._drawn["keyframes"]["/keyframes/0/0"] is kept
    np.testing.assert_allclose(kept.position, [0, 3, 0])
    stage.show(shown(maps.state(maps.submap(maps.keyframe(0)))))
    stage.show_mesh(MESH._replace(faces=np.zeros((0, 3), int)))
    assert set(drawn(stage, "keyframes")) == {"/keyframes/0/0"}
    assert not drawn(stage, "loops") and not drawn(stage, "mesh") and not drawn(stage, "path")


def test_switches_hide_what_they_name(stage, state):
    stage.show(shown(state))
    stage._switches["submaps"].value = False
    soon(lambda: not any(drawn(stage, "submaps").values()), "hidden")
    stage.show(shown(state))
    assert not any(drawn(stage, "submaps").values()) and all(drawn(stage, "keyframes").values())
    frustum = stage._drawn["keyframes"]["/keyframes/1/2"]
    assert frustum.image is None
    stage._switches["keyframe images"].value = True
    soon(lambda: frustum.image is not None, "its image")
    stage.show_mesh(MESH)
    stage._coloring.value = "submap"
    assert len(drawn(stage, "mesh")) == 1


def test_poses_that_are_not_known_are_left_out_and_far_ones_drawn_near(stage, state):
    far = maps.pose(translation=(691_234.0, 5_335_678.0, 512.0))
    picture = shown(state)
    poses = far @ np.concatenate([np.full((1, 4, 4), np.nan), picture.T_world_cam])
    away = [
        submap._replace(T_world_sub=far @ submap.T_world_sub, T_world_cam=far @ submap.T_world_cam)
        for submap in picture.submaps
    ]
    picture = picture._replace(
        T_world_cam=poses, statuses=(Status.LOST, *picture.statuses), submaps=tuple(away), T_truth_cam=poses
    )
    stage.show(picture)
    position = np.asarray(stage._drawn["keyframes"]["/keyframes/0/0"].position)
    assert np.abs(position).max() < 10 and drawn(stage, "true path")
    stage.show(picture._replace(T_truth_cam=None))
    assert drawn(stage, "true path"), "it was shown before"


@pytest.mark.fault(52)
def test_without_the_package_the_run_goes_on(program: Program, sequence: Path, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "viser" else found(name))
    result = program(sequence, "--viewer")
    assert result.code == 0 and result.metrics["frames"] == FRAMES
    assert result.stdout.count("pip install 'mipsjax[viewer]'") == 1


@pytest.mark.fault(52)
def test_a_page_beside_a_run(program: Program, sequence: Path, monkeypatch, taken):
    """It is there while the run goes, and neither it nor its end changes what comes of the run."""
    plain = program(sequence)
    said, pages, step, real = [], [], slam.step, live.viewer

    def slow(state, *rest):
        if not pages:
            soon(lambda: bool(said), "a page")
            pages.append(page(re.search(r"http\S+", said[0])[0]))
        return step(state, *rest)

    def heard(cfg, tell, port, truth):
        return real(cfg, said.append, port, truth)

    monkeypatch.setattr("mipsjax.app.run.viewer", heard)
    monkeypatch.setattr(slam, "step", slow)
    program.out = program.out.with_name("beside")
    result = program(sequence, "--viewer", "--viewer-port", str(taken))
    assert result.code == 0 and b"<html" in pages[0] and f":{taken}" not in said[0]
    assert f"python -m mipsjax.view {result.out} shows it" in result.stdout
    same = [(run.out / "trajectory.txt").read_bytes() for run in (plain, result)]
    assert same[0] == same[1]


def test_the_process_makes_a_surface_of_what_it_is_sent(sequence: Path, taken, caplog):
    cfg, frames = PRESETS["tiny"], open_sequence(sequence)
    state, info = slam.start(frames[0], frames.intrinsics, cfg)
    said: list[str] = []
    with live.viewer(cfg, said.append, taken) as beside:
        assert beside is not None
        soon(lambda: bool(said), "a page")
        assert beside._process.stdin is not None
        live.send(beside._process.stdin, MeshRequest(bare(state), cfg, 0.1))
        beside._mesh_due = False
        soon(lambda: beside._mesh_due, "a surface")
        beside.after(state, info, frames[0])
        soon(lambda: bool(beside._known), "a picture")
    assert not caplog.messages


@pytest.fixture
def child(monkeypatch) -> Callable[[str], None]:
    """A function that gives the next viewer a process that does something else."""
    real = subprocess.Popen

    def instead(code: str) -> None:
        monkeypatch.setattr(
            live.subprocess, "Popen", lambda _, **how: real([sys.executable, "-c", code], **how)
        )

    return instead


PAUSED = """
import json, pathlib, sys, time
print(json.dumps({"url": "nowhere"}), flush=True)
print(json.dumps({"paused": True}), flush=True)
"""


def test_a_run_waits_as_long_as_somebody_pauses_it(child, tmp_path):
    go = tmp_path / "go"
    child(
        PAUSED
        + f"""
while not pathlib.Path({str(go)!r}).exists():
    time.sleep(0.01)
print(json.dumps({{"paused": False}}), flush=True)
sys.stdin.buffer.read()
"""
    )
    said: list[str] = []
    with live.viewer(PRESETS["tiny"], said.append) as beside:
        assert beside is not None
        soon(lambda: "paused in the viewer" in said, "a pause")
        assert beside.wait(lambda: True), "a signal ends a pause"
        waiting = threading.Thread(target=beside.wait, args=(lambda: False,))
        waiting.start()
        waiting.join(0.5)
        assert waiting.is_alive()
        go.touch()
        waiting.join(60)
        assert not waiting.is_alive()
    assert said == ["viewer at nowhere", "paused in the viewer", "goes on"]


@pytest.mark.parametrize("end", ["sys.exit(1)", "print('{\"pau', flush=True, end='')"])
def test_a_page_that_ends_lets_a_paused_run_go_on(child, caplog, end):
    child(PAUSED + "time.sleep(0.2)\n" + end)
    said: list[str] = []
    with live.viewer(PRESETS["tiny"], said.append) as beside:
        assert beside is not None
        soon(lambda: "the viewer has ended; the run goes on without it" in caplog.messages, "the end")
        assert not beside.wait(lambda: False)


def test_a_page_that_reads_nothing_delays_no_end(child, state, monkeypatch):
    """More than a pipe holds is on its way to it."""
    monkeypatch.setattr(live, "END_S", 0.5)
    child("import time\ntime.sleep(600)")
    frame = Frame(0, 0.0, maps.COLOR, maps.DEPTH)
    many = [maps.keyframe(i) for i in range(2000)]
    large = state.with_submap(SubmapId(0), keyframes=tuple(many))
    began = time.monotonic()
    with live.viewer(PRESETS["tiny"], lambda text: None) as beside:
        assert beside is not None
        beside.after(large, FrameInfo(), frame)
        time.sleep(0.5)
    assert time.monotonic() - began < 60 and beside._process.poll() is not None


def test_what_cannot_be_shown_is_said_and_ends_no_run(child, state, caplog):
    child("import sys\nsys.stdin.buffer.read()")
    with live.viewer(PRESETS["tiny"], lambda text: None) as beside:
        assert beside is not None
        beside.after(state._replace(camera=None), FrameInfo(), None)
        beside.after(None, FrameInfo(), None)  # pyright: ignore[reportArgumentType]
        soon(lambda: any("nothing more is shown" in text for text in caplog.messages), "a word")


def test_results_are_shown_with_and_without_their_map(program: Program, sequence: Path):
    with_map = program(sequence, mesh=True)
    what, mesh = view.results(with_map.out)
    assert len(what.T_world_cam) == len(what.statuses) == FRAMES and what.T_truth_cam is not None
    assert mesh is not None and len(mesh.faces) and np.isfinite(mesh.uncertainty).all()
    assert what.submaps and set(mesh.submap) <= set(range(len(what.submaps))) | {-1}
    assert f"{FRAMES} frames: **ok**" in what.text and "ATE" in what.text
    (with_map.out / "map" / "state.npz").unlink()
    (with_map.out / "mesh.ply").unlink()
    bare, none = view.results(with_map.out)
    assert none is None and bare.submaps == () and bare.statuses == what.statuses
    assert bare.camera == what.camera


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["nowhere"], 3, "has no trajectory.txt"),
        ([], 2, "no folder of results given"),
        (["nowhere", "--port", "70000"], 2, "a port is a number"),
    ],
)
def test_what_cannot_be_shown_is_said_in_one_line(arguments, code, text, capsys):
    assert view.main(arguments) == code
    captured = capsys.readouterr()
    assert text in captured.err and len(captured.err.splitlines()) == 1
