"""Our own layout."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from write_layouts import FRAMES, color_image, pose, write_folder

from mipsjax.core.camera import Intrinsics
from mipsjax.data import folder
from mipsjax.data.calibration import DepthScale, Options, declared_intrinsics
from mipsjax.errors import InputError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "kitchen")


def test_folder(root: Path) -> None:
    sequence = folder.read(root, Options())
    assert folder.matches(root)
    assert (sequence.name, sequence.layout, sequence.notes) == ("kitchen", "folder", ())
    assert sequence.intrinsics == Intrinsics(60, 61, 31.5, 23.5, 64, 48)
    np.testing.assert_allclose(sequence.timestamps, np.arange(FRAMES) / 10)
    assert sequence.T_world_cam is not None
    np.testing.assert_allclose(sequence.T_world_cam, [pose(number) for number in range(FRAMES)], atol=1e-12)
    frame = sequence[3]
    assert frame.number == 3 and frame.problem == ""
    assert frame.color is not None and frame.depth is not None
    assert np.abs(frame.color.astype(int) - color_image(3)).max() <= 6  # JPEG
    np.testing.assert_allclose(frame.depth[1:], 2.03)


def test_without_ground_truth(root: Path) -> None:
    (root / "poses.txt").unlink()
    assert folder.read(root, Options()).T_world_cam is None


def test_fewer_poses_than_frames(root: Path) -> None:
    rows = (root / "poses.txt").read_text().splitlines()
    (root / "poses.txt").write_text("\n".join(rows[:2]))
    sequence = folder.read(root, Options())
    assert sequence.T_world_cam is not None and np.isnan(sequence.T_world_cam[2:]).all()
    assert any("2 rows for 5 frames" in note for note in sequence.notes)


def test_without_camera_file(root: Path) -> None:
    (root / "camera.json").unlink()
    with pytest.raises(InputError, match=r"no camera\.json; pass --intrinsics"):
        folder.read(root, Options())
    sequence = folder.read(root, Options(declared_intrinsics([60, 60, 31.5, 23.5])))
    np.testing.assert_allclose(sequence.timestamps, np.arange(FRAMES) / 30)
    assert sequence.notes == (
        "no times known: frames taken to be 1/30 s apart",
        "no depth scale known: depth taken to be in millimetres",
    )


def test_options_outweigh_the_camera_file(root: Path) -> None:
    sequence = folder.read(root, Options(declared_intrinsics([70, 70, 30, 20]), DepthScale(2000.0, "")))
    assert sequence.intrinsics == Intrinsics(70, 70, 30, 20, 64, 48)
    depth = sequence[0].depth
    assert depth is not None and depth.max() == 1.0


def test_no_depth_images(root: Path) -> None:
    for file in (root / "depth").iterdir():
        file.unlink()
    with pytest.raises(InputError, match=r"no depth images \(depth/\*\.png\)"):
        folder.read(root, Options())


def test_kitchen(shared_data: Path) -> None:
    sequence = folder.read(shared_data / "redkitchen", Options())
    assert len(sequence) == 1000 and sequence.notes == ()
    assert sequence.intrinsics == Intrinsics(292.5, 292.5, 159.75, 119.75, 320, 240)
    frame = sequence[500]
    assert frame.problem == "" and frame.depth is not None and frame.color is not None
    assert frame.color.shape == (240, 320, 3) and frame.depth.shape == (240, 320)
    assert 0.5 < np.median(frame.depth[frame.depth > 0]) < 5
    assert sequence.T_world_cam is not None and np.isfinite(sequence.T_world_cam).all()
