"""From a state to a verdict on the whole run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import maps
from mipsjax.config.sections import Config, SensorConfig
from mipsjax.core.camera import Intrinsics
from mipsjax.slam.judge import contradiction, judged
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import Record, SlamState, Status, thumbnail

CAMERA = Intrinsics(45.0, 45.0, 23.5, 17.5, 48, 36)
COUNT = 40
CORNER = 25
"""Its record, and all later ones, lie off in the contradicting state."""


def state_of(off_m: float = 0.0, status: Status = Status.OK) -> SlamState:
    """A camera that goes towards a wall 3 m away, 1 cm a frame."""
    records = []
    for i in range(COUNT):
        depth = np.full((CAMERA.height, CAMERA.width), 3.0 - 0.01 * i, np.float32)
        T = maps.pose(translation=(0.0, 0.0, 0.01 * i - (off_m if i >= CORNER else 0.0)))
        record = Record(10 + i, i / 30, 0, 0, T, status)
        records.append(record._replace(depth=thumbnail(depth, CAMERA)))
    state = maps.state(maps.submap(maps.keyframe(0)))
    return state._replace(records=Records.of(records), camera=CAMERA)


def test_agreement_is_silent(caplog: pytest.LogCaptureFixture) -> None:
    state = state_of()
    found = judged(state, Config())
    assert found is not None and found.begins is None and found.worst.share == 0
    assert not caplog.records and contradiction(state, found) == ""


def test_a_contradiction_is_said_with_the_frames_where_it_begins(caplog: pytest.LogCaptureFixture) -> None:
    state = state_of(0.3)
    found = judged(state, Config())
    assert found is not None and found.begins is not None
    assert found.begins.first < CORNER <= found.begins.last
    (record,) = caplog.records
    assert record.getMessage() == contradiction(state, found)
    frames = f"between frames {10 + found.begins.first} and {10 + found.begins.last}"
    assert frames in record.getMessage() and record.levelname == "WARNING"


def test_a_preset_without_growth_of_noise_does_not_take_the_sensor_for_perfect() -> None:
    flat = replace(Config(), sensor=SensorConfig(noise_growth=0.0))
    assert judged(state_of(0.3), flat) == judged(state_of(0.3), Config())


@pytest.mark.parametrize("status", [Status.LOST, Status.SKIPPED])
def test_frames_whose_pose_is_not_trusted_do_not_count(status: Status) -> None:
    assert judged(state_of(0.3, status), Config()) is None


def test_frames_without_a_thumbnail_give_no_verdict() -> None:
    state = state_of()
    bare = tuple(record._replace(depth=None) for record in state.records)
    assert judged(state._replace(records=Records.of(bare)), Config()) is None
    assert judged(state._replace(records=Records.of(state.records[:5])), Config()) is None
