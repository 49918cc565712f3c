"""ScanNet as exported."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from write_layouts import color_image, pose, write_scannet

from mipsjax.core.camera import Intrinsics
from mipsjax.data import fastcamo, scannet
from mipsjax.data.calibration import Options, declared_intrinsics
from mipsjax.data.trajectory import known_poses
from mipsjax.errors import InputError


@pytest.mark.parametrize("level", ["", "frames"])
def test_scannet(tmp_path: Path, level: str) -> None:
    root = tmp_path / "scene0000_00"
    write_scannet(root / level)
    sequence = scannet.read(root, Options())
    assert scannet.matches(root) and not fastcamo.matches(root)
    assert (sequence.name, sequence.layout, len(sequence)) == ("scene0000_00", "scannet", 10)
    # Numeric order: 0, 2, ..., 18; the missing odd numbers are time that passed.
    np.testing.assert_allclose(sequence.timestamps, np.arange(0, 20, 2) / 30)
    assert sequence.T_world_cam is not None
    assert known_poses(sequence.T_world_cam).tolist() == [True, True, False] + [True] * 7
    np.testing.assert_allclose(sequence.T_world_cam[9], pose(18), atol=1e-12)
    frame = sequence[9]
    assert frame.problem == "" and frame.color is not None and frame.depth is not None
    np.testing.assert_allclose(frame.depth[1:], 2.18)
    assert np.abs(frame.color[..., 0].astype(int) - color_image(9)[..., 0]).max() <= 6  # JPEG


def test_color_intrinsics_are_rescaled_to_depth(tmp_path: Path) -> None:
    sequence = scannet.read(write_scannet(tmp_path / "scene"), Options())
    expected = Intrinsics(117.0, 117.0, 64.5, 48.0, 130, 97).resized(64, 48)
    assert sequence.intrinsics == expected
    assert "intrinsics of intrinsic_color.txt rescaled from 130 x 97 to 64 x 48" in sequence.notes
    assert "colour resampled from 130 x 97 to the depth's 64 x 48" in sequence.notes
    assert "pose/: 1 of 10 true poses are not finite, left unknown" in sequence.notes


def test_depth_intrinsics_come_first(tmp_path: Path) -> None:
    write_scannet(tmp_path / "scene")
    k = np.diag([57.0, 57.0, 1.0, 1.0])
    k[0, 2], k[1, 2] = 31.0, 23.0
    np.savetxt(tmp_path / "scene" / "intrinsic" / "intrinsic_depth.txt", k)
    assert scannet.read(tmp_path / "scene", Options()).intrinsics == Intrinsics(57, 57, 31, 23, 64, 48)


def test_camera_file_comes_before_the_exported_intrinsics(tmp_path: Path) -> None:
    root = write_scannet(tmp_path / "scene")
    (root / "camera.json").write_text('{"fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5}')
    assert scannet.read(root, Options()).intrinsics == Intrinsics(60, 60, 31.5, 23.5, 64, 48)


def test_color_of_another_aspect(tmp_path: Path) -> None:
    root = write_scannet(tmp_path / "scene", color_size=(160, 90))
    with pytest.raises(InputError, match="colour is 160 x 90 and depth 64 x 48"):
        scannet.read(root, Options())


def test_without_intrinsics(tmp_path: Path) -> None:
    root = write_scannet(tmp_path / "scene", intrinsic="")
    assert scannet.matches(root) and not fastcamo.matches(root)
    with pytest.raises(InputError, match="pass --intrinsics"):
        scannet.read(root, Options())
    assert len(scannet.read(root, Options(declared_intrinsics([57, 57, 31, 23])))) == 10


def test_pose_files_may_be_missing_or_broken(tmp_path: Path) -> None:
    root = write_scannet(tmp_path / "scene")
    (root / "pose" / "0.txt").unlink()
    (root / "pose" / "2.txt").write_text("nonsense")
    sequence = scannet.read(root, Options())
    assert sequence.T_world_cam is not None
    assert known_poses(sequence.T_world_cam).sum() == 7
    assert "pose/: 1 pose files are malformed" in sequence.notes


def test_malformed_intrinsics(tmp_path: Path) -> None:
    root = write_scannet(tmp_path / "scene")
    (root / "intrinsic" / "intrinsic_color.txt").write_text("1 2 3")
    with pytest.raises(InputError, match=r"intrinsic_color\.txt: 16 numbers expected, 3 found"):
        scannet.read(root, Options())
