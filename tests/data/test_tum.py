"""TUM RGB-D."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from write_layouts import FRAMES, color_image, write_tum

from mipsjax.core.camera import Intrinsics
from mipsjax.data import tum
from mipsjax.data.calibration import Options, declared_intrinsics
from mipsjax.data.trajectory import known_poses
from mipsjax.errors import InputError

OPTIONS = Options(declared_intrinsics([60, 60, 31.5, 23.5]))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_tum(tmp_path / "desk")


def test_tum(root: Path) -> None:
    sequence = tum.read(root, OPTIONS)
    assert tum.matches(root)
    assert len(sequence) == FRAMES and sequence.layout == "tum" and sequence.notes == ()
    np.testing.assert_allclose(sequence.timestamps, 100 + np.arange(FRAMES) / 10)  # the time of depth
    assert sequence.T_world_cam is not None
    # Half way between two rows of the ground truth, which begins 5 ms earlier at 1 m/s.
    np.testing.assert_allclose(sequence.T_world_cam[:, 0, 3], 0.005 + np.arange(FRAMES) / 10, atol=1e-6)
    frame = sequence[2]
    assert frame.color is not None and frame.depth is not None
    np.testing.assert_array_equal(frame.color, color_image(2))
    np.testing.assert_allclose(frame.depth[1:], 2.02)


def test_intrinsics_are_needed(root: Path) -> None:
    with pytest.raises(InputError, match="pass --intrinsics"):
        tum.read(root, Options())
    (root / "camera.json").write_text('{"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}')
    assert tum.read(root, Options()).intrinsics == Intrinsics(60, 60, 31.5, 23.5, 64, 48)


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("rgbd_dataset_freiburg1_desk", "freiburg1"),
        ("fr2_xyz", "freiburg2"),
        ("fr3/office", "freiburg3"),
        ("tum/Freiburg3-long", "freiburg3"),
        ("fr1/fr2_xyz", "freiburg2"),
        ("fr12", None),
        ("afr1", None),
        ("freiburg4", None),
    ],
)
def test_camera_from_the_name(name: str, source: str | None) -> None:
    camera = tum.camera_from_name(Path("/data") / name)
    assert (camera and camera.source) == source


def test_images_of_the_first_camera_are_undistorted(tmp_path: Path) -> None:
    root = write_tum(tmp_path / "rgbd_dataset_freiburg1_x", (640, 480))
    sequence = tum.read(root, Options())
    assert "intrinsics of freiburg1 from the name of the folder, images undistorted" in sequence.notes
    assert sequence.intrinsics == Intrinsics(517.3 / 2, 516.5 / 2, 318.6 / 2, 255.3 / 2, 320, 240)
    frame = sequence[1]
    assert frame.color is not None and frame.depth is not None
    assert frame.color.shape == (240, 320, 3) and frame.depth.shape == (240, 320)
    assert set(np.unique(frame.depth)) == {0, np.float32(2.01)}
    assert np.abs(frame.color[120, 160].astype(int) - color_image(1, 640, 480)[240, 320]).max() <= 2


@pytest.mark.parametrize("depth_first", [False, True])
def test_associations(root: Path, depth_first: bool) -> None:
    rows = []
    for number in range(FRAMES):
        color = f"{99.99 + number / 10:.6f} rgb/{99.99 + number / 10:.6f}.png"
        depth = f"{100 + number / 10:.6f} depth/{100 + number / 10:.6f}.png"
        rows.append(f"{depth} {color}" if depth_first else f"{color} {depth}")
    (root / "associations.txt").write_text("\n".join(rows[:3]))
    (root / "rgb.txt").unlink()
    sequence = tum.read(root, OPTIONS)
    order = "depth first" if depth_first else "colour first"
    assert sequence.notes == (f"pairs taken from associations.txt ({order})",)
    np.testing.assert_allclose(sequence.timestamps, [100, 100.1, 100.2])
    assert all(frame.problem == "" for frame in sequence)


def test_frame_numbers_for_times(root: Path) -> None:
    rows = [
        f"{number} depth/{100 + number / 10:.6f}.png {number} rgb/{99.99 + number / 10:.6f}.png"
        for number in range(FRAMES)
    ]
    (root / "associations.txt").write_text("\n".join(rows))
    (root / "groundtruth.txt").write_text("\n".join(f"{n} {n} 0 0 0 0 0 1" for n in range(FRAMES)))
    sequence = tum.read(root, OPTIONS)
    np.testing.assert_allclose(sequence.timestamps, np.arange(FRAMES) / 30)
    assert "timestamps are frame numbers: frames taken to be 1/30 s apart" in sequence.notes
    assert sequence.T_world_cam is not None
    np.testing.assert_allclose(sequence.T_world_cam[:, 0, 3], np.arange(FRAMES))
    (root / "camera.json").write_text('{"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "fps": 60}')
    faster = tum.read(root, OPTIONS)
    np.testing.assert_allclose(faster.timestamps, np.arange(FRAMES) / 60)
    assert "timestamps are frame numbers: frames taken to be 1/60 s apart" in faster.notes


def test_camera_file_leaves_times_alone(root: Path) -> None:
    (root / "camera.json").write_text('{"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "fps": 60}')
    np.testing.assert_allclose(tum.read(root, Options()).timestamps, 100 + np.arange(FRAMES) / 10)


@pytest.mark.fault(21, 22)
def test_unsorted_and_repeated_rows(root: Path) -> None:
    lines = (root / "depth.txt").read_text().splitlines()
    (root / "depth.txt").write_text("\n".join([*reversed(lines), lines[2]]))
    sequence = tum.read(root, OPTIONS)
    assert np.all(np.diff(sequence.timestamps) > 0) and len(sequence) == FRAMES
    assert "depth.txt: timestamps were not in order, sorted" in sequence.notes
    assert "depth.txt: 1 entries with a repeated timestamp dropped" in sequence.notes


@pytest.mark.fault(23)
def test_another_clock(root: Path) -> None:
    lines = (root / "rgb.txt").read_text().replace("\n", "\n1").splitlines()[1:-1]
    (root / "rgb.txt").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"0 of 5 pairs within 0\.08 s; nearest"):
        tum.read(root, OPTIONS)


def test_images_without_partner_are_counted(root: Path) -> None:
    lines = (root / "rgb.txt").read_text().splitlines()
    (root / "rgb.txt").write_text("\n".join(lines[:2] + lines[3:]))
    sequence = tum.read(root, OPTIONS)
    assert len(sequence) == FRAMES - 1
    assert sequence.notes[0].startswith("4 pairs of 4 colour and 5 depth images")


def test_listed_file_that_is_missing(root: Path) -> None:
    (root / "rgb" / "100.090000.png").unlink()
    frame = tum.read(root, OPTIONS)[1]
    assert frame.color is None and frame.problem == "missing_color: 100.090000.png"


def test_without_ground_truth(root: Path) -> None:
    (root / "groundtruth.txt").unlink()
    assert tum.read(root, OPTIONS).T_world_cam is None


def test_ground_truth_with_unknown_rows(root: Path) -> None:
    lines = (root / "groundtruth.txt").read_text().splitlines()
    (root / "groundtruth.txt").write_text("\n".join([*lines[:15], "100.14 nan nan nan 0 0 0 1"]))
    sequence = tum.read(root, OPTIONS)
    assert sequence.T_world_cam is not None
    assert known_poses(sequence.T_world_cam).tolist() == [True, True, False, False, False]
    assert "groundtruth.txt: true pose known for 2 of 5 frames" in sequence.notes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "lists no images"),
        ("1.0\n", "line 1: a time and a file name expected"),
        ("one rgb/a.png\n", "line 1: 'one' is not a number"),
        ("nan rgb/a.png\n", "line 1: 'nan' is not a time"),
    ],
)
def test_malformed_lists(root: Path, text: str, message: str) -> None:
    (root / "rgb.txt").write_text(text)
    with pytest.raises(InputError, match=message):
        tum.read(root, OPTIONS)


@given(st.text(alphabet=st.sampled_from("0123456789.-einfa# \n\trgb/p\0é"), max_size=120))
def test_any_text_is_a_list_or_an_error(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "rgb.txt").write_text(text, encoding="utf-8")
        (Path(folder) / "depth.txt").write_text("0 depth/a.png\n1 depth/b.png\n")
        (Path(folder) / "associations.txt").write_text(text, encoding="utf-8")
        for read in (tum.read_lists, lambda place: tum.read_associations(place / "associations.txt")):
            try:
                read(Path(folder))
            except InputError as error:
                assert folder in str(error)


def test_real_excerpt(shared_data: Path) -> None:
    sequence = tum.read(shared_data / "rgbd_dataset_freiburg3_excerpt", Options())
    assert len(sequence) == 45
    assert sequence.intrinsics == Intrinsics(535.4 / 2, 539.2 / 2, 320.1 / 2, 247.6 / 2, 320, 240)
    assert sequence.T_world_cam is not None
    # The motion capture begins 0.15 s after the first image.
    assert known_poses(sequence.T_world_cam).tolist() == [False] * 5 + [True] * 40
    frame = sequence[20]
    assert frame.problem == "" and frame.depth is not None and frame.color is not None
    assert 1.0 < np.median(frame.depth[frame.depth > 0]) < 4.0


def test_the_list_of_colour_may_have_its_other_name(root: Path) -> None:
    expected = tum.read(root, OPTIONS)
    (root / "rgb.txt").rename(root / "color.txt")
    assert tum.matches(root) and len(tum.read(root, OPTIONS)) == len(expected)


def test_times_in_whole_seconds_are_refused(root: Path) -> None:
    rows = [line.split() for line in (root / "depth.txt").read_text().splitlines() if line[0] != "#"]
    (root / "depth.txt").write_text("".join(f"{float(time):.0f} {name}\n" for time, name in rows))
    with pytest.raises(InputError, match="fractions of a second"):
        tum.read(root, OPTIONS)


def test_a_cut_line_of_truth_stops_nothing(root: Path) -> None:
    path = root / "groundtruth.txt"
    path.write_text(path.read_text().rstrip()[:-9])
    sequence = tum.read(root, OPTIONS)
    assert sequence.T_world_cam is not None and any("malformed" in note for note in sequence.notes)


def test_names_with_a_nul_are_missing_images(root: Path) -> None:
    path = root / "depth.txt"
    lines = path.read_text().splitlines()
    lines[-1] = lines[-1] + "\0.png"
    path.write_text("\n".join(lines))
    assert "unreadable_depth" in tum.read(root, OPTIONS)[FRAMES - 1].problem
