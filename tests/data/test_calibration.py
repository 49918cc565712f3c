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
from mipsjax.data.calibration import declared_intrinsics, read_camera_json, require_scale, resolve_intrinsics
from mipsjax.errors import ConfigError, InputError


def read(text: str) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "camera.json"
        path.write_text(text)
        return read_camera_json(path)


def test_camera_json() -> None:
    camera = read('{"fx": 1, "fy": 2.5, "cx": 3, "cy": 4, "width": 5, "height": 6, "depth_scale": 1000}')
    assert (camera.calibration.fy, camera.calibration.size) == (2.5, (5, 6))
    assert (camera.depth_scale, camera.fps) == (1000.0, None)


@pytest.mark.parametrize(
    "text", ["", "[]", "{", '{"fx": true}', '{"fx": "1"}', '{"fx": 1e999}', "[" * 100_000]
)
def test_malformed_camera_json(text: str) -> None:
    with pytest.raises(InputError, match=r"camera\.json"):
        read(text)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(st.dictionaries(st.sampled_from(["fx", "fy", "cx", "cy", "width", "height", "fps"]), json_values))
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


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_depth_scale_must_be_positive(scale: float) -> None:
    with pytest.raises(InputError, match="positive"):
        require_scale(scale, 1000.0)
