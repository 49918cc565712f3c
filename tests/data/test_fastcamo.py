"""FastCaMo: folders and `.seq` files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from write_layouts import FRAMES, HEIGHT, WIDTH, color_image, write_scannet, write_seq

from mipsjax.core.camera import Intrinsics
from mipsjax.data import fastcamo, scannet
from mipsjax.data.calibration import Options, declared_intrinsics
from mipsjax.errors import InputError

OPTIONS = Options(declared_intrinsics([60, 60, 31.5, 23.5]))


def write_synth(root: Path) -> Path:
    return write_scannet(root, suffix=".png", color_size=(WIDTH, HEIGHT), intrinsic="")


def test_synthetic_folder(tmp_path: Path) -> None:
    root = write_synth(tmp_path / "apartment_1")
    sequence = fastcamo.read(root, Options())
    assert fastcamo.matches(root) and not scannet.matches(root)
    assert (sequence.name, sequence.layout, len(sequence)) == ("apartment_1", "fastcamo", 10)
    assert sequence.intrinsics == Intrinsics(320, 320, 319.5, 239.5, 640, 480).resized(64, 48)
    assert "intrinsics of FastCaMo-Synth assumed" in sequence.notes
    frame = sequence[3]
    assert frame.color is not None and frame.depth is not None
    np.testing.assert_array_equal(frame.color, color_image(3))
    np.testing.assert_allclose(frame.depth[1:], 2.06)


def test_camera_file_in_the_folder(tmp_path: Path) -> None:
    root = write_synth(tmp_path / "mine")
    (root / "camera.json").write_text('{"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}')
    sequence = fastcamo.read(root, Options())
    assert sequence.intrinsics == Intrinsics(60, 60, 31.5, 23.5, 64, 48)


def test_seq_file(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "lab.seq")
    sequence = fastcamo.read(path, OPTIONS)
    assert fastcamo.matches(path)
    assert (sequence.name, len(sequence), sequence.T_world_cam) == ("lab", FRAMES, None)
    np.testing.assert_allclose(sequence.timestamps, np.arange(FRAMES) / 30)
    for number in range(FRAMES):
        frame = sequence[number]
        assert frame.color is not None and frame.depth is not None
        np.testing.assert_array_equal(frame.color, color_image(number))
        np.testing.assert_allclose(frame.depth[1:], 2 + 0.01 * number, rtol=1e-6)
        np.testing.assert_array_equal(frame.depth[0], 0)


def test_seq_file_needs_intrinsics(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "lab.seq")
    with pytest.raises(InputError, match="pass --intrinsics FX FY CX CY or put"):
        fastcamo.read(path, Options())
    (tmp_path / "camera.json").write_text('{"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}')
    assert fastcamo.read(path, Options()).intrinsics.fx == 60


def test_seq_file_cut_short(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "lab.seq", announced=7)
    sequence = fastcamo.read(path, OPTIONS)
    assert len(sequence) == FRAMES
    assert "lab.seq: 7 frames announced, 5 are complete" in sequence.notes
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="not one is complete"):
        fastcamo.read(path, OPTIONS)


@given(st.binary(max_size=64))
def test_any_bytes_are_no_seq_file(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("seq") / "a.seq"
    path.write_bytes(content)
    try:
        source, _ = fastcamo.open_seq(path)
    except InputError as error:
        assert "a.seq" in str(error)
    else:
        assert len(source) > 0


def test_seq_file_cut_while_it_is_read(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "office.seq")
    sequence = fastcamo.read(path, OPTIONS)
    assert sequence[FRAMES - 1].depth is not None
    path.write_bytes(path.read_bytes()[:-5])
    frame = sequence[FRAMES - 1]
    assert frame.color is None and frame.depth is not None and "cut short" in frame.problem
    path.unlink()
    assert "unreadable_depth" in sequence[0].problem


def test_seq_file_with_a_forged_header(tmp_path: Path) -> None:
    path = tmp_path / "forged.seq"
    np.array([3, 16384, 16384], "<i4").tofile(path)
    os.truncate(path, 12 + 3 * 5 * 16384**2)  # takes no room
    with pytest.raises(InputError, match="16384 x 16384 pixels"):
        fastcamo.read(path, OPTIONS)
