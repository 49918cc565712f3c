"""7-Scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from write_layouts import FRAMES, WIDTH, pose, write_sevenscenes

from mipsjax.core.camera import Intrinsics
from mipsjax.data import sevenscenes
from mipsjax.data.calibration import Options, declared_intrinsics
from mipsjax.data.trajectory import known_poses
from mipsjax.errors import InputError

OPTIONS = Options(declared_intrinsics([60, 60, 31.5, 23.5]))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_sevenscenes(tmp_path: Path, suffix: str) -> None:
    root = write_sevenscenes(tmp_path / "seq-01", suffix)
    sequence = sevenscenes.read(root, OPTIONS)
    assert sevenscenes.matches(root)
    assert (sequence.name, sequence.layout, len(sequence)) == ("seq-01", "sevenscenes", FRAMES)
    assert sequence.T_world_cam is not None
    np.testing.assert_allclose(sequence.T_world_cam, [pose(n) for n in range(FRAMES)], atol=1e-12)
    frame = sequence[1]
    assert frame.problem == "" and frame.color is not None and frame.depth is not None
    assert np.count_nonzero(frame.depth == 0) == 2 * WIDTH  # one row of 0 and one of 65535
    np.testing.assert_allclose(frame.depth[2:], 2.01)


def test_published_intrinsics_follow_the_size(tmp_path: Path) -> None:
    sequence = sevenscenes.read(write_sevenscenes(tmp_path / "seq-01"), Options())
    assert sequence.intrinsics == Intrinsics(585, 585, 320, 240, 640, 480).resized(64, 48)
    assert "intrinsics of the 7-Scenes documentation assumed" in sequence.notes


def test_intrinsics_beside_the_images(tmp_path: Path) -> None:
    root = write_sevenscenes(tmp_path / "seq-01")
    (root / "camera-intrinsics.txt").write_text("58 0 32\n0 59 24\n0 0 1\n")
    assert sevenscenes.read(root, Options()).intrinsics == Intrinsics(58, 59, 32, 24, 64, 48)


def test_several_sequences_have_to_be_chosen_from(tmp_path: Path) -> None:
    for name in ("seq-01", "seq-02"):
        write_sevenscenes(tmp_path / name)
    assert sevenscenes.matches(tmp_path)
    with pytest.raises(
        InputError, match=r"2 sequences in this folder \(seq-01, seq-02\); choose one, such as"
    ):
        sevenscenes.read(tmp_path, OPTIONS)


def test_a_single_sequence_is_taken(tmp_path: Path) -> None:
    write_sevenscenes(tmp_path / "seq-03")
    (tmp_path / "seq-04").mkdir()
    sequence = sevenscenes.read(tmp_path, OPTIONS)
    assert sequence.name == "seq-03"
    assert "the only sequence of the folder taken: seq-03" in sequence.notes


def test_missing_pose_and_color(tmp_path: Path) -> None:
    root = write_sevenscenes(tmp_path / "seq-01")
    (root / "frame-000001.pose.txt").unlink()
    (root / "frame-000002.color.png").unlink()
    sequence = sevenscenes.read(root, OPTIONS)
    assert sequence.T_world_cam is not None
    assert known_poses(sequence.T_world_cam).tolist() == [True, False, True, True, True]
    assert sequence[2].problem == "missing_color: no file"


def test_no_sequence_at_all(tmp_path: Path) -> None:
    assert not sevenscenes.matches(tmp_path)
    with pytest.raises(InputError, match="0 sequences"):
        sevenscenes.read(tmp_path, OPTIONS)


def test_real_excerpt(shared_data: Path) -> None:
    sequence = sevenscenes.read(shared_data / "sevenscenes_excerpt" / "seq-01", Options())
    assert len(sequence) == 40
    assert sequence.intrinsics == Intrinsics(292.5, 292.5, 160, 120, 320, 240)
    assert sequence.T_world_cam is not None and known_poses(sequence.T_world_cam).all()
    frame = sequence[10]
    assert frame.problem == "" and frame.depth is not None and frame.color is not None
    assert frame.depth.max() <= 8 and 1 < np.median(frame.depth[frame.depth > 0]) < 3


def test_raw_excerpt_shows_what_the_prepared_kitchen_shows(shared_data: Path) -> None:
    from mipsjax.data import folder

    raw = sevenscenes.read(shared_data / "sevenscenes_excerpt" / "seq-01", Options())
    prepared = folder.read(shared_data / "redkitchen", Options())
    assert raw.T_world_cam is not None and prepared.T_world_cam is not None
    # Nine decimals in the file of the prepared sequence; both made orthonormal here.
    np.testing.assert_allclose(raw.T_world_cam[:40], prepared.T_world_cam[:40], atol=1e-3)
    first, second = raw[0].depth, prepared[0].depth
    assert first is not None and second is not None
    both = (first > 0) & (second > 0)
    assert np.median(np.abs(first - second)[both]) < 0.01
