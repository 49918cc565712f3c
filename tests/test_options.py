"""Configurations: ranges, merging, plain dictionaries, and that presets are valid."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mipsjax.config import Config, InputConfig
from mipsjax.config_tracking import GuardConfig
from mipsjax.errors import ConfigError
from mipsjax.options import RANGES, Range, flat, merged, read_toml, suggestion, to_dict, validate
from mipsjax.presets import PRESETS, preset


def numeric(value: object) -> bool:
    return not isinstance(value, bool | str)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_json(name: str) -> None:
    cfg = preset(name)
    validate(cfg)
    text = json.dumps(to_dict(cfg), allow_nan=False)
    assert merged(Config(), json.loads(text)) == cfg


def test_every_number_has_a_range() -> None:
    assert {name for name, value in flat(Config()) if numeric(value)} == RANGES.keys()


@pytest.mark.parametrize("name", [name for name, value in flat(Config()) if isinstance(value, float)])
@pytest.mark.parametrize("value", [float("nan"), -1.0, float("-inf")])
def test_impossible_numbers_are_named(name: str, value: float) -> None:
    section: dict[str, object] = {}
    inner = section
    *path, last = name.split(".")
    for part in path:
        inner = inner.setdefault(part, {})  # pyright: ignore[reportAssignmentType]
    inner[last] = value
    with pytest.raises(ConfigError, match=name.replace(".", r"\.")):
        validate(merged(Config(), section))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"map": {"frames": 2}}, "map.frames must be at least 3, got 2"),
        ({"field": {"hidden": [64, 0]}}, "field.hidden must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0 and at most 4294967295, got -1"),
    ],
)
def test_message_says_what_is_allowed(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate(merged(Config(), changes))
    assert str(caught.value) == message


def test_contradictions_are_found() -> None:
    with pytest.raises(ConfigError, match=r"guard\.weak must be at least guard\.lost"):
        validate(replace(Config(), guard=GuardConfig(weak=0.3, lost=0.5)))
    with pytest.raises(ConfigError, match=r"input\.depth_max"):
        validate(replace(Config(), input=InputConfig(depth_min=3.0, depth_max=2.0)))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"trak": {"ro": {}}}, "unknown key trak; did you mean track?"),
        (
            {"track": {"ro": {"particels": 3}}},
            "unknown key track.ro.particels; did you mean track.ro.particles?",
        ),
        ({"particles": 3}, "unknown key particles; did you mean track.ro.particles?"),
        ({"map": {"steps": 2.5}}, "map.steps must be a whole number, got 2.5"),
        ({"map": {"steps": True}}, "map.steps must be a whole number, got True"),
        ({"map": 3}, "map is a section of options, got 3"),
        ({"field": {"hidden": 64}}, "field.hidden must be a list, got 64"),
        ({"field": {"classification": 1}}, "field.classification must be true or false, got 1"),
        (
            {"field": {"encoding": "hush"}},
            "field.encoding must be one of frequency, hash, joint, both, got 'hush'",
        ),
        ({"mesh": {"voxel": "big"}}, "mesh.voxel must be a number, got 'big'"),
    ],
)
def test_merging_names_what_is_wrong(content: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        merged(Config(), content)
    assert str(caught.value) == message


def test_merging_keeps_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "fast.toml"
    path.write_text("[track.ro]\nparticles = 64\n[keyframe]\ntranslation = inf\n[mesh]\nvoxel = 1\n")
    cfg = read_toml(path, preset("tiny"))
    assert cfg.track.ro.particles == 64 and cfg.keyframe.translation == float("inf")
    assert cfg.mesh.voxel == 1.0 and isinstance(cfg.mesh.voxel, float)
    assert cfg.track.go == preset("tiny").track.go and cfg.field == preset("tiny").field
    assert hash(cfg) == hash(read_toml(path, preset("tiny")))


@pytest.mark.parametrize("content", ["a = [", "x = 1\nx = 2", "\0"])
def test_broken_toml(tmp_path: Path, content: str) -> None:
    path = tmp_path / "broken.toml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=r"broken\.toml: not valid TOML"):
        read_toml(path, Config())
    with pytest.raises(ConfigError, match="cannot be read"):
        read_toml(tmp_path / "none.toml", Config())


@given(st.floats(), st.floats(0, 10), st.floats(10, 20), st.booleans(), st.booleans())
def test_ranges(value: float, low: float, high: float, above: bool, infinite: bool) -> None:
    allowed = Range(low, high, above, infinite)
    assert allowed.holds(value) == (low <= value <= high and not (above and value == low))
    assert not Range(low).holds(float("inf")) and Range(low, infinite=True).holds(float("inf"))


def test_suggestions() -> None:
    assert suggestion("--map.step", ["--map.steps", "--seed"]) == "; did you mean --map.steps?"
    assert suggestion("--zzz", ["--map.steps", "--seed"]) == ""
