"""Replica."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from write_layouts import FRAMES, pose, write_replica

from mipsjax.core.camera import Intrinsics
from mipsjax.data import replica
from mipsjax.data.calibration import Options, declared_intrinsics
from mipsjax.data.trajectory import known_poses
from mipsjax.errors import InputError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_replica(tmp_path / "office0")


def test_replica(root: Path) -> None:
    sequence = replica.read(root, Options())
    assert replica.matches(root)
    assert (sequence.name, sequence.layout, len(sequence)) == ("office0", "replica", FRAMES)
    assert sequence.intrinsics == Intrinsics(60, 60, 31.5, 23.5, 64, 48)
    assert sequence.T_world_cam is not None
    np.testing.assert_allclose(sequence.T_world_cam, [pose(n) for n in range(FRAMES)], atol=1e-12)
    depth = sequence[1].depth
    assert depth is not None
    np.testing.assert_allclose(depth[1:], 2.01, atol=1e-4)  # the unit of depth is 0.15 mm
    np.testing.assert_allclose(sequence.timestamps, np.arange(FRAMES) / 30)
    assert sequence.notes == ("no times known: frames taken to be 1/30 s apart",)


def test_scale_is_read_from_the_camera_file(root: Path) -> None:
    file = root.parent / "cam_params.json"
    content = json.loads(file.read_text())
    content["camera"]["scale"] = 13107.0
    (root / "cam_params.json").write_text(json.dumps(content))  # the nearer file counts
    depth = replica.read(root, Options())[0].depth
    assert depth is not None
    np.testing.assert_allclose(depth[1:], 1.0, atol=1e-4)


def test_without_camera_file(root: Path) -> None:
    (root.parent / "cam_params.json").unlink()
    with pytest.raises(InputError, match="for 1200 x 680 images, depth images are 64 x 48"):
        replica.read(root, Options())
    sequence = replica.read(root, Options(declared_intrinsics([60, 60, 31.5, 23.5])))
    assert any("published Replica renders assumed" in note for note in sequence.notes)


def test_camera_file_of_ours_comes_first(root: Path) -> None:
    (root.parent / "cam_params.json").write_text("not needed")
    text = '{"fx": 61, "fy": 61, "cx": 31.5, "cy": 23.5, "depth_scale": 13107, "fps": 30}'
    (root / "camera.json").write_text(text)
    sequence = replica.read(root, Options())
    assert (sequence.intrinsics.fx, sequence.depth_scale.units_per_metre, sequence.notes) == (61, 13107, ())


def test_scale_must_be_positive(root: Path) -> None:
    file = root.parent / "cam_params.json"
    file.write_text(file.read_text().replace("6553.5", "0"))
    with pytest.raises(InputError, match=r"cam_params\.json: scale must be positive, got 0"):
        replica.read(root, Options())


@pytest.mark.parametrize("text", ["[1]", '{"camera": 3}', '{"camera": {"w": 64}}'])
def test_malformed_camera_file(root: Path, text: str) -> None:
    (root / "cam_params.json").write_text(text)
    with pytest.raises(InputError, match=r"cam_params\.json"):
        replica.read(root, Options())


def test_frame_without_color_and_short_trajectory(root: Path) -> None:
    (root / "results" / "frame000001.jpg").unlink()
    rows = (root / "traj.txt").read_text().splitlines()
    (root / "traj.txt").write_text("\n".join([rows[0], " ".join(["nan"] * 16), rows[2]]))
    sequence = replica.read(root, Options())
    assert sequence[1].problem == "missing_color: no file"
    assert sequence.T_world_cam is not None
    assert known_poses(sequence.T_world_cam).tolist() == [True, False, True, False, False]


def test_without_trajectory(root: Path) -> None:
    (root / "traj.txt").unlink()
    assert replica.read(root, Options()).T_world_cam is None


def test_malformed_trajectory(root: Path) -> None:
    """Truth never stops a run."""
    (root / "traj.txt").write_text("1 2 3\n")
    sequence = replica.read(root, Options())
    assert sequence.T_world_cam is None
    (note,) = [note for note in sequence.notes if "malformed" in note]
    assert "traj.txt, line 1: 16 numbers expected, 3 found" in note


def test_living_room(shared_data: Path) -> None:
    sequence = replica.read(shared_data / "small_house" / "living", Options())
    assert len(sequence) == 369
    assert sequence.intrinsics == Intrinsics(288, 288, 159.5, 119.5, 320, 240)
    assert sequence.T_world_cam is not None and known_poses(sequence.T_world_cam).all()
    depth = sequence[100].depth
    assert depth is not None and 0.5 < np.median(depth[depth > 0]) < 6
