"""Finding the files of frames by their names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from write_layouts import pose

from mipsjax.data.framefiles import (
    frame_key,
    frame_numbers,
    list_files,
    numbered_times,
    pair_by_name,
    require_images,
    rows_for_frames,
)
from mipsjax.data.trajectory import known_poses
from mipsjax.errors import InputError


def keys(*names: str) -> list:
    return [frame_key(name) for name in names]


def paths(*names: str) -> list[Path]:
    return [Path(name) for name in names]


@pytest.mark.fault(25)
def test_numeric_order_not_lexical() -> None:
    found, files = pair_by_name(
        paths("10.jpg", "2.jpg", "1.jpg"), paths("000001.png", "10.png"), lambda p: p.stem
    )
    assert frame_numbers(found) == [1, 2, 10]
    assert files.color_paths == tuple(paths("1.jpg", "2.jpg", "10.jpg"))
    assert files.depth_paths == (Path("000001.png"), None, Path("10.png"))


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("frame-1", "frame-5"), [1, 5]),
        (("a", "b"), None),
        (("1.5", "2.5"), None),
        (("1341836537655691", "1341836537687429"), None),  # microseconds
        ((), None),
    ],
)
def test_numbers_of_frames(names: tuple[str, ...], numbers: list[int] | None) -> None:
    assert frame_numbers(keys(*names)) == numbers


@pytest.mark.fault(20)
def test_times_follow_the_numbers() -> None:
    np.testing.assert_allclose(numbered_times(keys("3", "4", "7"), 30.0), np.array([0, 1, 4]) / 30)
    np.testing.assert_allclose(numbered_times(keys("a", "b"), 30.0), np.array([0, 1]) / 30)
    assert numbered_times([], 30.0).shape == (0,)


def test_rows_match_by_order_or_by_number() -> None:
    rows = np.array([pose(number) for number in range(4)])
    same, notes = rows_for_frames(rows, keys("10", "11", "12", "13"), "poses.txt")
    np.testing.assert_array_equal(same, rows)
    assert notes == ()
    fewer, notes = rows_for_frames(rows, keys("1", "3", "9"), "poses.txt")
    np.testing.assert_array_equal(fewer[:2], rows[[1, 3]])
    assert known_poses(fewer).tolist() == [True, True, False]
    assert notes == ("poses.txt: 4 rows for 3 frames, matched by number; 2 frames have one",)
    assert not known_poses(rows_for_frames(rows[:0], keys("1"), "poses.txt")[0]).any()


def test_listing_leaves_out_hidden_and_other_files(tmp_path: Path) -> None:
    for name in ("1.PNG", "._1.png", "1.txt", "2.png"):
        (tmp_path / name).touch()
    assert [path.name for path in list_files(tmp_path, (".png",))] == ["1.PNG", "2.png"]
    assert list_files(tmp_path / "none", (".png",)) == []


def test_numbers_of_many_digits_are_as_many_times() -> None:
    keys = [frame_key(str(10**20 + number)) for number in range(4)]
    np.testing.assert_array_equal(numbered_times(keys, 10.0), np.arange(4) / 10)


def test_colour_and_depth_of_other_names_are_refused(tmp_path: Path) -> None:
    _, files = pair_by_name([tmp_path / "a1.png"], [tmp_path / "b1.png"], lambda path: path.stem)
    with pytest.raises(InputError, match=r"a1\.png and b1\.png"):
        require_images(files, tmp_path, "*.png")
