"""The sequence behind all readers: broken frames, sizes, undistortion, decimation."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from write_layouts import CAMERA, FRAMES, color_image, depth_image, pose, write_folder, write_image

from mipsjax.config.sections import InputConfig
from mipsjax.core.camera import Intrinsics
from mipsjax.data.calibration import Calibration, Options
from mipsjax.data.folder import read
from mipsjax.data.imagesequence import (
    ImageSequence,
    Shape,
    decimate_color,
    shape_color,
    shape_depth,
    undistortion_maps,
)
from mipsjax.data.sequence import Sequence
from mipsjax.errors import InputError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "a folder ü")


def open_folder(root: Path, working_width: int = 320) -> ImageSequence:
    return read(root, Options(input=InputConfig(working_width=working_width)))


def damage(path: Path, how: str) -> None:
    data = bytearray(path.read_bytes())
    if how == "flipped":
        data[len(data) // 2] ^= 1
    path.write_bytes({"empty": b"", "truncated": bytes(data[: len(data) // 2])}.get(how, bytes(data)))


def test_it_is_a_sequence(root: Path) -> None:
    sequence = open_folder(root)
    assert isinstance(sequence, Sequence)
    assert len(list(sequence)) == len(sequence) == FRAMES
    with pytest.raises(IndexError):
        sequence[FRAMES]
    assert sequence[-1].number == FRAMES - 1


@pytest.mark.parametrize("how", ["empty", "truncated", "flipped"])
def test_broken_depth_is_a_problem_of_its_frame(root: Path, how: str) -> None:
    damage(root / "depth" / "000002.png", how)
    frame = open_folder(root)[2]
    assert frame.depth is None and frame.color is not None
    assert frame.problem.startswith("unreadable_depth: 000002.png")
    assert open_folder(root)[3].problem == ""


def test_truncated_color_keeps_depth(root: Path) -> None:
    damage(root / "color" / "000002.jpg", "truncated")
    frame = open_folder(root)[2]
    assert frame.color is None and frame.depth is not None
    assert frame.problem == "unreadable_color: 000002.jpg: truncated JPEG"


@pytest.mark.parametrize(("kind", "suffix"), [("color", "jpg"), ("depth", "png")])
def test_missing_image(root: Path, kind: str, suffix: str) -> None:
    (root / kind / f"000002.{suffix}").unlink()
    sequence = open_folder(root)
    assert len(sequence) == FRAMES
    assert sequence[2].problem == f"missing_{kind}: no file"
    assert getattr(sequence[2], kind) is None
    np.testing.assert_allclose(np.diff(sequence.timestamps), 0.1)


def test_image_deleted_after_opening(root: Path) -> None:
    sequence = open_folder(root)
    (root / "depth" / "000002.png").unlink()
    (root / "color" / "000002.jpg").unlink()
    assert sequence[2].problem == "missing_color: 000002.jpg; missing_depth: 000002.png"


def test_wrong_size_of_one_frame_says_both_sizes(root: Path) -> None:
    write_image(root / "depth" / "000001.png", depth_image(1, width=32, height=24))
    write_image(root / "color" / "000003.jpg", color_image(1, width=32, height=24))
    sequence = open_folder(root)
    assert sequence[1].problem == "wrong_size: depth is 32 x 24, the sequence 64 x 48"
    assert sequence[1].depth is None and sequence[1].color is not None
    assert sequence[3].problem == "wrong_size: color is 32 x 24, the sequence 64 x 48"


def test_eight_bit_depth_of_one_frame_is_its_problem(root: Path) -> None:
    write_image(root / "depth" / "000001.png", np.ones((48, 64), np.uint8))
    frame = open_folder(root)[1]
    assert frame.depth is None and "depth must be 16-bit single channel" in frame.problem


@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_eight_bit_depth_throughout_is_an_error(root: Path, shape: tuple[int, ...]) -> None:
    for file in (root / "depth").iterdir():
        write_image(file, np.ones(shape, np.uint8))
    with pytest.raises(InputError, match=r"000000\.png: depth must be 16-bit single channel"):
        open_folder(root)


def test_no_readable_depth_at_all(root: Path) -> None:
    for file in (root / "depth").iterdir():
        file.write_bytes(b"")
    with pytest.raises(InputError, match=r"no depth image can be read; the first is .*000000\.png"):
        open_folder(root)


def test_larger_color_is_resampled(root: Path) -> None:
    for number in range(FRAMES):
        write_image(root / "color" / f"{number:06d}.jpg", color_image(number, 128, 96))
    sequence = open_folder(root)
    assert sequence.notes == ("colour resampled from 128 x 96 to the depth's 64 x 48",)
    assert sequence.intrinsics == Intrinsics(60, 61, 31.5, 23.5, 64, 48)  # camera.json is for 64 x 48
    color = sequence[2].color
    assert color is not None
    assert np.abs(color.astype(int) - color_image(2)).max() <= 6  # JPEG, and another sampling of a ramp


def test_color_of_another_view_is_an_error(root: Path) -> None:
    for number in range(FRAMES):
        write_image(root / "color" / f"{number:06d}.jpg", color_image(number, 96, 48))
    with pytest.raises(InputError, match="colour is 96 x 48 and depth 64 x 48"):
        open_folder(root)


def test_depth_only(root: Path) -> None:
    for file in (root / "color").iterdir():
        file.unlink()
    sequence = open_folder(root)
    assert "no colour image can be read: depth only" in sequence.notes
    assert sequence[0].color is None and sequence[0].depth is not None


@pytest.mark.parametrize("every_px", [1, 2, 3, 4])
def test_decimated_color_agrees_with_decimated_intrinsics(every_px: int) -> None:
    ramp = np.broadcast_to(np.arange(0, 240, 4, dtype=np.uint8)[None, :, None], (48, 60, 3)).copy()
    small = decimate_color(ramp, every_px)
    k = Intrinsics(60, 60, 29.5, 23.5, 60, 48).decimated(every_px)
    assert small.shape[:2] == (k.height, k.width)
    inner = slice(1, (60 - every_px) // every_px)  # the blur reflects at the border
    np.testing.assert_array_equal(small[:, inner], ramp[::every_px, ::every_px][:, inner])


def test_decimation_suppresses_what_it_cannot_show() -> None:
    stripes = np.zeros((48, 64, 3), np.uint8)
    stripes[:, ::2] = 200
    assert np.ptp(decimate_color(stripes, 2)[:, 1:-1]) <= 1


def test_working_width(root: Path) -> None:
    sequence = open_folder(root, working_width=32)
    frame = sequence[1]
    assert sequence.intrinsics == Intrinsics(30, 30.5, 15.75, 11.75, 32, 24)
    assert frame.color is not None and frame.color.shape == (24, 32, 3)
    assert frame.depth is not None and frame.depth.shape == (24, 32)
    np.testing.assert_array_equal(frame.depth[0], 0)
    np.testing.assert_allclose(frame.depth[1:], 2.01)


def test_depth_is_never_averaged() -> None:
    depth = np.where(np.arange(64) % 7 < 3, 1000, 3000).astype(np.uint16) * np.ones((48, 1), np.uint16)
    maps = undistortion_maps(Intrinsics(60, 60, 31.5, 23.5, 64, 48), (0.2, -0.5, 0.001, 0.002, 0.3))
    shaped = shape_depth(depth, Shape((64, 48), (64, 48), maps, 2))
    assert set(np.unique(shaped)) <= {0, 1000, 3000}


def test_undistortion_straightens_a_drawn_point() -> None:
    k = Intrinsics(517.3, 516.5, 318.6, 255.3, 640, 480)
    distortion = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    point = np.array([[0.45, -0.3, 1.0]])
    matrix = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
    (u, v) = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0].ravel()
    image = np.zeros((480, 640, 3), np.uint8)
    image[round(v) - 1 : round(v) + 2, round(u) - 1 : round(u) + 2] = 255
    straight = shape_color(image, Shape((640, 480), (640, 480), undistortion_maps(k, distortion), 1))
    rows, columns = np.nonzero(straight[..., 0] > 128)
    # Half a pixel of rounding, and the size of the drawn square.
    assert abs(columns.mean() - (k.fx * 0.45 + k.cx)) < 1
    assert abs(rows.mean() - (k.fy * -0.3 + k.cy)) < 1


def test_no_distortion_needs_no_maps() -> None:
    assert undistortion_maps(Intrinsics(60, 60, 31.5, 23.5, 64, 48), ()) is None


def test_selection_keeps_numbers_times_and_poses(root: Path) -> None:
    sequence = open_folder(root).select(slice(1, None, 2))
    assert [frame.number for frame in sequence] == [1, 3]
    np.testing.assert_allclose(sequence.timestamps, [0.1, 0.3])
    assert sequence.T_world_cam is not None
    np.testing.assert_allclose(sequence.T_world_cam, [pose(1), pose(3)], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": -60.0}, "a focal length is negative"),
        ({"cx": 64.0}, "principal point is outside"),
        ({"fx": 0.0}, "unusable intrinsics"),
        ({"cx": float("inf")}, "cx must be a number"),
        ({"width": 64, "height": 64}, "are for 64 x 64 images, depth images are 64 x 48"),
    ],
)
def test_impossible_intrinsics(root: Path, change: dict[str, float], message: str) -> None:
    import json

    (root / "camera.json").write_text(json.dumps(CAMERA | change))
    with pytest.raises(InputError, match=message):
        open_folder(root)


def test_negative_focal_length_may_be_declared(root: Path) -> None:
    given = Calibration(481.2, -480.0, 31.5, 23.5, "depth", "--intrinsics", declared=True)
    sequence = read(root, Options(intrinsics=given))
    assert sequence.intrinsics.fy == -480
    assert any("negative, as declared" in note for note in sequence.notes)


def test_intrinsics_of_a_larger_image_are_rescaled(root: Path) -> None:
    given = Calibration(120.0, 122.0, 63.5, 47.5, (128, 96), "--intrinsics", declared=True)
    sequence = read(root, Options(intrinsics=given))
    assert sequence.intrinsics == Intrinsics(60, 61, 31.5, 23.5, 64, 48)
    assert "intrinsics of --intrinsics rescaled from 128 x 96 to 64 x 48" in sequence.notes
