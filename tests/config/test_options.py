"""Configurations: files, merging, plain dictionaries, and that presets are valid."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from mipsjax.config.options import merged, read_toml, suggestion, to_dict, validate
from mipsjax.config.presets import PRESETS, preset
from mipsjax.config.sections import Config
from mipsjax.errors import ConfigError


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_json(name: str) -> None:
    cfg = preset(name)
    validate(cfg)
    text = json.dumps(to_dict(cfg), allow_nan=False)
    assert merged(Config(), json.loads(text)) == cfg


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a = " + "[" * 1000 + "]" * 1000, "nested too deep"),
        ("seed = " + "9" * 400, "seed must be at most"),
        ("seed = " + "9" * 5000, "not valid TOML"),
        ("# " + "a" * (1 << 20), "more than"),
        ('map.steps = "\\u0000"', "map.steps must be a whole number"),
    ],
)
def test_a_file_of_any_content_is_a_config_or_an_error(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "options.toml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        validate(read_toml(tmp_path / "options.toml", Config()))


def test_only_a_regular_file_is_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(ConfigError, match="no regular file"):
            read_toml(path, Config())


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


def test_suggestions() -> None:
    assert suggestion("--map.step", ["--map.steps", "--seed"]) == "; did you mean --map.steps?"
    assert suggestion("--zzz", ["--map.steps", "--seed"]) == ""
