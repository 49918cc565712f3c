"""Camera files and the intrinsics option."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mipsjax.core.camera import Intrinsics
from mipsjax.data.calibration import (
    DepthScale,
    Options,
    declared_intrinsics,
    frame_rate,
    read_camera_json,
    resolve_intrinsics,
    with_camera_file,
)
from mipsjax.errors import ConfigError, InputError


def read(text: str) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.json"
        path.write_text(text)
        return read_camera_json(path)


def test_camera_json() -> None:
    camera = read('{"fx": 1, "fy": 2.5, "cx": 3, "cy": 4, "width": 5, "height": 6, "depth_scale": 1000}')
    assert (camera.calibration.fy, camera.calibration.size) == (2.5, (5, 6))
    assert (camera.depth_scale, camera.fps) == (DepthScale(1000.0, "camera.json"), None)


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"fx": true}', '{"fx": "1"}', '{"fx": 1e999}', "[" * 100_000]
)
def test_malformed_camera_json(text: str) -> None:
    with pytest.raises(InputError, match=r"camera\.json"):
        read(text)


NAMES = ["fx", "fy", "cx", "cy", "width", "height", "depth_scale", "fps"]
json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(st.dictionaries(st.sampled_from(NAMES), json_values))
def test_any_json_is_a_camera_or_an_error(content: dict[str, Any]) -> None:
    try:
        read(json.dumps(content))
    except InputError as error:
        assert "camera.json" in str(error)


def test_declared_intrinsics() -> None:
    assert declared_intrinsics([1, 2, 3, 4]).size == "depth"
    assert declared_intrinsics(Intrinsics(1, 2, 3, 4, 5, 6)).size == (5, 6)
    with pytest.raises(ConfigError, match="got 3 numbers"):
        declared_intrinsics([1, 2, 3])


def test_swapped_declared_intrinsics_are_refused() -> None:
    with pytest.raises(InputError, match="the order is FX FY CX CY"):
        resolve_intrinsics(declared_intrinsics([320, 240, 585, 585]), (640, 480), (640, 480))


@pytest.mark.parametrize("name", ["depth_scale", "fps"])
@pytest.mark.parametrize(
    ("value", "message"), [("0", "positive"), ("-1", "positive"), ("NaN", "a number"), ("null", "a number")]
)
def test_depth_scale_and_rate_must_be_positive(name: str, value: str, message: str) -> None:
    with pytest.raises(InputError, match=rf"camera\.json: {name} must be {message}"):
        read(f'{{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "{name}": {value}}}')


def test_camera_file_fills_what_options_leave_open(tmp_path: Path) -> None:
    given_scale = Options(depth_scale=DepthScale(5.0, "--depth-scale"))
    assert with_camera_file(given_scale, tmp_path) == given_scale
    (tmp_path / "camera.json").write_text('{"fx": 1, "fy": 2, "cx": 3, "cy": 4, "depth_scale": 7, "fps": 9}')
    filled = with_camera_file(given_scale, tmp_path)
    assert filled.intrinsics is not None and filled.intrinsics.source == "camera.json"
    assert (filled.depth_scale, filled.fps) == (given_scale.depth_scale, 9.0)
    assert with_camera_file(Options(), tmp_path).depth_scale == DepthScale(7.0, "camera.json")


@pytest.mark.fault(20)
def test_frame_rate() -> None:
    assert frame_rate(Options(fps=60.0)) == (60.0, ())
    assert frame_rate(Options()) == (30.0, ("no times known: frames taken to be 1/30 s apart",))


NAN, HUGE = float("nan"), 10**400


@pytest.mark.parametrize(
    "numbers",
    [
        [65, 65, 40, 30, NAN, NAN],
        [65, 65, 40, 30, 0, 0],
        [65, 65, 40, 30, HUGE, HUGE],
        [65, 65, 40, 30, 1e9, 1e9],
        [NAN, 65, 40, 30],
        [65, HUGE, 40, 30],
        [65, 65, 40, 30, 80],
    ],
)
def test_numbers_that_are_no_intrinsics(numbers: list[float]) -> None:
    with pytest.raises(ConfigError, match="--intrinsics"):
        declared_intrinsics(numbers)


@pytest.mark.parametrize("focal", [1e9, 2500, 7, 1e-300])
def test_a_focal_length_that_no_camera_has(focal: float) -> None:
    with pytest.raises(InputError, match="no camera has such a focal length"):
        resolve_intrinsics(declared_intrinsics([focal, focal, 40, 30]), (80, 60), (80, 60))


@pytest.mark.parametrize("key", ["width", "height", "fps", "depth_scale"])
def test_values_of_a_camera_file_have_bounds(key: str) -> None:
    for value in (0, 1e300, 1e-300):
        with pytest.raises(InputError, match=key):
            read(json.dumps({"fx": 1, "fy": 1, "cx": 1, "cy": 1, "width": 9, "height": 9} | {key: value}))
