"""What a run writes: complete, atomic, and readable whatever the numbers are."""

from __future__ import annotations

import errno
import json
import os
from copy import copy
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from mipsjax.app import outputs
from mipsjax.app.summary import FrameRow, Run, metrics_content, verdict
from mipsjax.config.presets import preset
from mipsjax.config.sections import Config
from mipsjax.core import mapping
from mipsjax.core.volume import Box
from mipsjax.data.open import open_sequence
from mipsjax.data.synth import SynthSequence
from mipsjax.errors import OutputError
from mipsjax.files import write_atomically
from mipsjax.mesh.reconstruct import observed_points, reconstruct
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.bundle import make_keyframe
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import How, Loop, Record, SlamState, Status, Submap
from mipsjax.uncertainty.agreement import Agreement, Part

CFG = preset("tiny")
WRITTEN = 8
"""Files of a run at its end; config.json is there from the start."""


@pytest.fixture(scope="module")
def run() -> Run:
    """Three frames that were never mapped: poses and keyframes as after a run, without its time."""
    sequence = open_sequence("synth:tiny", frames=slice(4))
    assert isinstance(sequence, SynthSequence) and sequence.T_world_cam is not None
    frames = [sequence[position] for position in range(4)]
    keyframe = make_keyframe(frames[1], 0, np.eye(4), CFG, sequence.intrinsics)
    infos = (
        FrameInfo(),
        FrameInfo(residual_after=float("inf"), note='no, "depth"'),
        FrameInfo(),
    )
    records = tuple(
        Record(frame.number, frame.timestamp, 0, 0, np.eye(4), status)
        for frame, status in zip(frames[1:], (Status.OK, Status.SKIPPED, Status.OK), strict=True)
    )
    box = Box(np.full(3, -4.0), np.full(3, 4.0))
    learned = mapping.create(jax.random.key(0), CFG)
    submap = Submap(learned, box, (keyframe,), sequence.T_world_cam[1])
    state = SlamState((submap,), 0, Records.of(records), sequence.intrinsics, 0)
    waited = (FrameRow(0, 0.0, Status.SKIPPED, FrameInfo(note="no depth")),)
    return Run(sequence, state, waited, infos, (0.1,) * 4, (0.2,) * 4, "done")


def row(status: str) -> FrameRow:
    return FrameRow(0, 0.0, Status[status.upper()], FrameInfo())


@pytest.mark.parametrize(
    ("statuses", "expected"),
    [
        ("ok ok", "ok"),
        ("skipped ok weak skipped", "ok"),
        ("ok lost ok", "degraded"),
        ("ok lost lost lost ok ok", "degraded"),
        ("ok lost lost lost ok", "failed"),
        ("ok ok ok lost", "failed"),
        ("ok ok ok lost skipped", "failed"),
        ("skipped skipped", "failed"),
        ("ok skipped skipped", "failed"),
    ],
)
def test_verdict(statuses: str, expected: str) -> None:
    assert verdict(tuple(row(status) for status in statuses.split())) == expected


def test_a_run_whose_depth_images_contradict_each_other_is_degraded(run: Run) -> None:
    part = Part(0.3, 0, 2)
    contradicted = run._replace(agreement=Agreement(part, part, 20))
    content = metrics_content(contradicted, None, {})
    assert content["status"] == "degraded" and content["looked_through"] == 0.3
    assert content["contradiction"] == {
        "indices": [1, 3],
        "timestamps": [run.rows[1].timestamp, run.rows[3].timestamp],
        "looked_through": 0.3,
    }
    (reason,) = content["reasons"]
    assert "30 %" in reason and "between frames 1 and 3" in reason
    assert json.loads(outputs.events_jsonl(contradicted, []).splitlines()[-1])["status"] == "degraded"


def test_a_run_whose_depth_images_agree_or_cannot_be_compared_is_ok(run: Run) -> None:
    agreeing = metrics_content(run._replace(agreement=Agreement(Part(0.01, 0, 2), None, 20)), None, {})
    assert (agreeing["status"], agreeing["looked_through"], agreeing["reasons"]) == ("ok", 0.01, [])
    unknown = metrics_content(run, None, {})
    assert (unknown["status"], unknown["looked_through"], unknown["contradiction"]) == ("ok", None, None)
    assert "too few" in unknown["protocol"]["looked_through"]


def test_metrics_count_what_happened(run: Run) -> None:
    content = metrics_content(run, None, {"open": 1.0})
    assert content["frames"] == 4 and content["status_counts"] == {
        "ok": 2,
        "weak": 0,
        "lost": 0,
        "skipped": 2,
    }
    assert [bad["index"] for bad in content["bad_frames"]] == [0, 2]
    assert content["fps"] is None, "two usable frames, and both compile"
    assert content["fps_overall"] == pytest.approx(4 / 1.2)
    assert content["te_mean_m"] > 0 and content["seconds"] >= 2.2
    assert (content["submaps"], content["unjoined_submaps"]) == (1, [])


def test_metrics_name_loops_and_submaps_that_hang_on_nothing(run: Run) -> None:
    assert run.state is not None
    (submap,) = run.state.submaps
    later = submap._replace(keyframes=(submap.keyframes[0]._replace(id=2),))
    loops = tuple(Loop(2, 0, 1, How.BOX, 0.9, 0.1, 0.0, weight) for weight in (0.0, 1.0))
    state = run.state._replace(submaps=(submap, later, submap), loops=loops)
    content = metrics_content(run._replace(state=state), None, {})
    assert (content["submaps"], content["unjoined_submaps"]) == (3, [1])
    assert content["loops"] == 1 and content["loops_found"] == outputs.loops_content(state)["loops"]
    assert [row["weight"] for row in content["loops_found"]] == [0, 1]


def test_speed_is_that_of_usable_frames_after_the_two_that_compile(run: Run) -> None:
    assert run.state is not None
    first, skipped, last = run.state.records
    records = (first, skipped, last, last)
    state, infos = run.state._replace(records=Records.of(records)), (*run.infos, FrameInfo())
    others = run._replace(state=state, infos=infos, waited=(), step_s=(9.0, 0.01, 9.0, 0.2))
    assert metrics_content(others, None, {})["fps"] == pytest.approx(5.0)


def test_a_measure_that_cannot_be_told_leaves_the_others(run: Run) -> None:
    sequence = copy(run.sequence)
    sequence.T_world_cam = run.sequence.T_world_cam.copy()
    sequence.T_world_cam[2] = np.nan
    assert run.state is not None
    records = tuple(record._replace(status=Status.OK) for record in run.state.records)
    content = metrics_content(
        run._replace(sequence=sequence, state=run.state._replace(records=Records.of(records))), None, {}
    )
    assert content["rpe_trans_m"] is None and "RPE" in content["protocol"]["rpe_trans_m"]
    assert content["te_mean_m"] is not None


def test_files_are_readable_with_odd_numbers(run: Run, tmp_path: Path) -> None:
    outputs.write_results(tmp_path, run, trimesh.Trimesh(), {"mesh": float("nan")}, ["a warning"])
    metrics = json.loads((tmp_path / "metrics.json").read_text(), parse_constant=pytest.fail)
    assert metrics["seconds_per_stage"]["mesh"] is None and metrics["accuracy_m"] is None
    lines = (tmp_path / "status.csv").read_text().splitlines()
    assert len(lines) == 5 and lines[0].startswith(
        "index,timestamp,status,residual_before_m,residual_after_m,"
    )
    assert lines[3].endswith('"no, ""depth"""') and ",inf" not in lines[3]
    events = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [event["event"] for event in events] == ["bad_frame", "bad_frame", "warning", "end"]


@pytest.mark.parametrize("call", range(WRITTEN))
@pytest.mark.fault(47)
def test_full_disk_leaves_no_half_file(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: int
) -> None:
    calls = []

    def full(handle: int) -> None:
        calls.append(handle)
        if len(calls) > call:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    # Rendering takes long
    monkeypatch.setattr(outputs, "save_picture", lambda path, *_: write_atomically(path, b"a picture"))
    with pytest.raises(OutputError, match="No space left"):
        outputs.write_results(tmp_path, run, trimesh.creation.box(), {}, [])
    assert len(list(tmp_path.iterdir())) == call and not (tmp_path / "metrics.json").exists()
    monkeypatch.setattr(os, "fsync", lambda handle: None)
    outputs.write_results(tmp_path, run, trimesh.creation.box(), {}, [])
    assert len(list(tmp_path.iterdir())) == WRITTEN


def test_observed_points_are_those_of_the_scene(run: Run) -> None:
    assert run.state is not None and isinstance(run.sequence, SynthSequence)
    points = observed_points(run.state, CFG)
    distance = run.sequence.scene.distance(jnp.asarray(points))
    # Rays end within 0.2 mm of a surface, those that graze an edge within a few millimetres
    assert len(points) and float(jnp.abs(distance).max()) < 5e-3 and float(jnp.abs(distance).mean()) < 2e-4


@pytest.mark.fault(53)
def test_a_field_that_is_not_finite_gives_an_empty_mesh(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    assert run.state is not None
    learned = jax.tree.map(
        lambda leaf: leaf * jnp.nan if leaf.dtype == jnp.float32 else leaf, run.state.submap.learned
    )
    with jax.numpy_rank_promotion("allow"):
        mesh = reconstruct(run.state.with_submap(0, learned=learned), CFG)
    assert len(mesh.faces) == 0 and "mesh is empty" in caplog.text


def test_config_file_has_no_infinity(run: Run, tmp_path: Path) -> None:
    cfg: Config = preset("paper")
    options: dict[str, Any] = {"sequence": "synth:tiny", "intrinsics": (1.0, float("nan"))}
    outputs.write_config(tmp_path, cfg, options, run.sequence)
    content = json.loads((tmp_path / "config.json").read_text(), parse_constant=pytest.fail)
    assert (
        content["config"]["keyframe"]["translation"] == "inf" and content["options"]["intrinsics"][1] is None
    )
