"""Opening by looking: layouts, frames, sanity of numbers, and nothing written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from write_layouts import (
    CAMERA,
    FRAMES,
    depth_image,
    write_folder,
    write_image,
    write_replica,
    write_scannet,
    write_seq,
    write_sevenscenes,
    write_tum,
)

from mipsjax.config.sections import InputConfig
from mipsjax.data.imagesequence import ImageSequence
from mipsjax.data.open import (
    LAYOUTS,
    describe,
    detect_layout,
    open_sequence,
    parse_frames,
    typical_depth,
)
from mipsjax.data.sequence import Sequence
from mipsjax.errors import ConfigError, InputError

INTRINSICS = (60.0, 60.0, 31.5, 23.5)


def write_fastcamo(root: Path) -> Path:
    return write_scannet(root, ".png", (64, 48), "")


WRITERS = {
    "folder": write_folder,
    "tum": write_tum,
    "replica": write_replica,
    "scannet": write_scannet,
    "sevenscenes": write_sevenscenes,
    "fastcamo": write_fastcamo,
}


def write_layout(folder: Path, name: str) -> Path:
    return write_seq(folder / "scene.seq") if name == "seq" else WRITERS[name](folder / "scene")


def camera_file(path: Path) -> Path:
    return (path if path.is_dir() else path.parent) / "camera.json"


def opened(path: Path, **options: Any) -> ImageSequence:
    sequence = open_sequence(path, **options)
    assert isinstance(sequence, ImageSequence)
    return sequence


def contents(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(p): (p.stat().st_size, p.stat().st_mtime_ns) for p in folder.rglob("*")}


def test_every_layout_has_a_writer_here() -> None:
    # A bag is written, and read, in test_bag.py
    assert WRITERS.keys() | {"bag"} == LAYOUTS.keys()


@pytest.mark.parametrize("name", WRITERS)
def test_layouts_are_found_and_left_untouched(tmp_path: Path, name: str) -> None:
    root = WRITERS[name](tmp_path / "a sequence ü")
    before = contents(tmp_path)
    sequence = open_sequence(root, intrinsics=INTRINSICS)
    assert isinstance(sequence, Sequence)
    assert sequence.layout == name and sequence.name == "a sequence ü"
    assert np.all(np.diff(sequence.timestamps) > 0)
    k = sequence.intrinsics
    for frame in sequence:
        assert frame.problem == "" and frame.color is not None and frame.depth is not None
        assert frame.color.shape == (k.height, k.width, 3) and frame.color.dtype == np.uint8
        assert frame.depth.shape == (k.height, k.width) and frame.depth.dtype == np.float32
    assert "layout" in describe(sequence)
    assert contents(tmp_path) == before


def test_seq_file_and_symlink(tmp_path: Path) -> None:
    path = write_seq(tmp_path / "lab.seq")
    assert len(open_sequence(path, intrinsics=INTRINSICS)) == FRAMES
    write_folder(tmp_path / "folder")
    (tmp_path / "link").symlink_to(tmp_path / "folder")
    assert open_sequence(str(tmp_path / "link")).name == "link"


def test_current_folder_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(write_folder(tmp_path / "kitchen"))
    assert open_sequence(".").name == "kitchen"


@pytest.mark.fault(1)
def test_missing_path(tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        open_sequence(tmp_path / "no" / "such")
    assert str(tmp_path / "no" / "such") in str(error.value)
    assert str(error.value).endswith(f"the nearest folder that does is {tmp_path}")


def test_a_file_is_no_sequence(tmp_path: Path) -> None:
    (tmp_path / "video.mp4").touch()
    with pytest.raises(InputError, match=r"video\.mp4: is a file, a folder is expected"):
        open_sequence(tmp_path / "video.mp4")


def test_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="it contains: nothing") as error:
        open_sequence(tmp_path)
    assert all(name in str(error.value) for name in LAYOUTS)


@pytest.mark.fault(2)
def test_unknown_layout_shows_ten_names(tmp_path: Path) -> None:
    for number in range(12):
        (tmp_path / f"file{number:02d}").touch()
    with pytest.raises(InputError, match=r"file00, .*, file09, \.\.\.$"):
        open_sequence(tmp_path)


def test_sequence_one_level_down(tmp_path: Path) -> None:
    write_folder(tmp_path / "kitchen")
    with pytest.raises(InputError, match=r"did you mean .*kitchen\?"):
        open_sequence(tmp_path)


@pytest.mark.fault(3)
def test_two_layouts(tmp_path: Path) -> None:
    write_tum(write_folder(tmp_path / "both"))
    with pytest.raises(InputError, match="looks like folder and tum; choose with --layout"):
        open_sequence(tmp_path / "both")
    assert open_sequence(tmp_path / "both", layout="folder", intrinsics=INTRINSICS).layout == "folder"
    with pytest.raises(ConfigError, match="--layout kitti: unknown, choose one of folder, tum"):
        open_sequence(tmp_path / "both", layout="kitti")


def test_every_sequence_here_is_of_one_layout(tmp_path: Path) -> None:
    for name, write in WRITERS.items():
        assert detect_layout(write(tmp_path / name)) == name


def test_frames(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "kitchen")
    sequence = open_sequence(root, frames=parse_frames("1::2"))
    assert [frame.number for frame in sequence] == [1, 3]
    with pytest.raises(InputError, match="1 of 5 frames selected, at least 2"):
        open_sequence(root, frames=parse_frames("4:"))


def test_a_single_frame_is_too_few(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="1 of 1 frames selected"):
        open_sequence(write_folder(tmp_path / "kitchen", range(1)))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("10:20:2", slice(10, 20, 2)),
        ("::4", slice(None, None, 4)),
        ("5:", slice(5, None)),
        (":7", slice(None, 7)),
        (":", slice(None)),
        (" 1:2 ", slice(1, 2)),
    ],
)
def test_parse_frames(text: str, expected: slice) -> None:
    assert parse_frames(text) == expected


@pytest.mark.parametrize("text", ["", "5", "a:b", "1:2:3:4", "::0", "-5:", "5:5", "9:3", "1.5:2", "²:3"])
def test_frames_that_make_no_sense(text: str) -> None:
    with pytest.raises(ConfigError, match="--frames"):
        parse_frames(text)


@given(st.text(max_size=20) | st.text("0123456789:- ", max_size=12))
def test_any_text_is_frames_or_an_error(text: str) -> None:
    try:
        frames = parse_frames(text)
    except ConfigError:
        return
    numbers = [number for number in (frames.start, frames.stop, frames.step) if number is not None]
    assert numbers == [int(part) for part in text.split(":") if part.strip()]
    assert all(number >= 0 for number in numbers) and frames.step != 0


@pytest.mark.parametrize(("scale", "median"), [(1.0, "2e+03"), (1e6, "0.002")])
def test_depth_scale_that_cannot_be(tmp_path: Path, scale: float, median: str) -> None:
    root = write_folder(tmp_path / "kitchen")
    with pytest.raises(InputError) as error:
        open_sequence(root, depth_scale=scale)
    assert f"median depth of frame 0 is {median} m" in str(error.value)
    assert str(error.value).endswith("pass --depth-scale (units per metre); 1000 would make it 2 m")


@pytest.mark.fault(18)
def test_unusual_depth_is_remarked_on(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "kitchen")
    notes = open_sequence(root, depth_scale=100.0).notes
    assert (
        "median depth of frame 0 is 20 m at 100 units per metre (from --depth-scale): is --depth-scale right?"
        in notes
    )
    assert open_sequence(root).notes == ()


@pytest.mark.parametrize("name", [*WRITERS, "seq"])
def test_depth_scale_is_of_the_option_then_of_the_camera_file(tmp_path: Path, name: str) -> None:
    path = write_layout(tmp_path, name)
    own = opened(path, intrinsics=INTRINSICS)
    scale, median = own.depth_scale.units_per_metre, typical_depth(own)[1]
    camera_file(path).write_text(json.dumps(CAMERA | {"depth_scale": 2 * scale}))
    filed, given = opened(path), opened(path, depth_scale=4 * scale)
    assert f"{2 * scale:g} units per metre (from camera.json)" in describe(filed)
    assert f"{4 * scale:g} units per metre (from --depth-scale)" in describe(given)
    np.testing.assert_allclose(typical_depth(filed)[1], median / 2, rtol=1e-6)  # float32 depth
    np.testing.assert_allclose(typical_depth(given)[1], median / 4, rtol=1e-6)


@pytest.mark.parametrize("name", ["replica", "scannet", "sevenscenes", "fastcamo", "seq"])
def test_rate_is_of_the_camera_file(tmp_path: Path, name: str) -> None:
    path = write_layout(tmp_path, name)
    assumed = opened(path, intrinsics=INTRINSICS)
    assert any("1/30 s apart" in note for note in assumed.notes)
    camera_file(path).write_text(json.dumps(CAMERA | {"fps": 60.0}))
    filed = opened(path)
    np.testing.assert_allclose(filed.timestamps, assumed.timestamps / 2)
    assert not any("s apart" in note for note in filed.notes)
    assert filed.calibration.source == "camera.json"


@pytest.mark.parametrize("layout", [None, "folder"])
def test_what_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str | None) -> None:
    root = write_folder(tmp_path / "kitchen")
    iterdir = Path.iterdir

    def refuse(path: Path) -> Iterator[Path]:  # instead of chmod, which does not stop root
        if path.name == "color":
            raise PermissionError(13, "Permission denied", str(path))
        return iterdir(path)

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(InputError, match=r"kitchen/color: cannot be read \(Permission denied\); make it"):
        open_sequence(root, layout=layout)


@pytest.mark.parametrize("scale", [0.0, -5.0, float("nan")])
def test_depth_scale_option(tmp_path: Path, scale: float) -> None:
    with pytest.raises(ConfigError, match="--depth-scale"):
        open_sequence(tmp_path, depth_scale=scale)


def test_first_frames_without_depth_say_nothing(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "kitchen")
    write_image(root / "depth" / "000000.png", np.zeros((48, 64), np.uint16))
    (root / "depth" / "000001.png").write_bytes(b"")
    assert "in frame 2" in describe(open_sequence(root))


def test_no_depth_anywhere(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "kitchen")
    for number in range(FRAMES):
        write_image(root / "depth" / f"{number:06d}.png", np.full((48, 64), 65535, np.uint16))
    with pytest.raises(InputError, match="no usable depth image among the 5 looked at"):
        open_sequence(root)


def test_depth_beyond_the_configured_range_does_not_hide_the_scale(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "kitchen")
    for number in range(FRAMES):
        write_image(root / "depth" / f"{number:06d}.png", 10 * depth_image(number))
    assert any("is 20 m" in note for note in open_sequence(root, input=InputConfig(depth_max=8.0)).notes)


@pytest.mark.fault(19)
def test_wrong_intrinsics(tmp_path: Path) -> None:
    root = write_folder(tmp_path / "kitchen")
    (root / "camera.json").write_text(json.dumps(CAMERA | {"fy": -480.0}))
    with pytest.raises(InputError, match="if that is meant, pass --intrinsics"):
        open_sequence(root)
    assert open_sequence(root, intrinsics=(481.2, -480.0, 31.5, 23.5)).intrinsics.fy == -480


def test_synthetic_sequences_are_opened_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = open_sequence(write_folder(tmp_path / "room"))
    asked: list[object] = []

    def open_synth(*arguments: object) -> Sequence:
        asked.append(arguments)
        return room

    monkeypatch.setattr("mipsjax.data.synth.open_synth", open_synth)
    config = InputConfig()
    assert open_sequence("synth:room", frames=slice(3), input=config) is room
    assert asked == [("room", slice(3), config)]


def test_describe(tmp_path: Path) -> None:
    root = write_scannet(tmp_path / "scene")
    text = describe(open_sequence(root, input=InputConfig(working_width=32)))
    assert text.splitlines()[:6] == [
        "layout        scannet (scene)",
        "frames        10 in 0.6 s, 66.7 ms apart",
        "size          32 x 24, every 2 pixels of 64 x 48",
        "intrinsics    fx 28.80, fy 28.95, cx 15.75, cy 11.75 (from intrinsic_color.txt)",
        "depth         1000 units per metre (from the layout), median 2.00 m in frame 0",
        "ground truth  poses of 9 of 10 frames",
    ]
    assert all(line.startswith("note          ") for line in text.splitlines()[6:])


@pytest.mark.parametrize(
    ("folder", "layout", "frames"),
    [
        ("redkitchen", "folder", 1000),
        ("small_house/living", "replica", 369),
        ("sevenscenes_excerpt/seq-01", "sevenscenes", 40),
        ("rgbd_dataset_freiburg3_excerpt", "tum", 45),
    ],
)
def test_real_sequences(shared_data: Path, folder: str, layout: str, frames: int) -> None:
    sequence = open_sequence(shared_data / folder, frames=slice(0, None, 7))
    assert (sequence.layout, len(sequence)) == (layout, -(-frames // 7))
    assert (sequence.intrinsics.width, sequence.intrinsics.height) == (320, 240)
    frame = sequence[1]
    assert frame.number == 7 and frame.problem == ""
