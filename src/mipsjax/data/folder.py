"""Our own layout: `color/*.jpg|png`, `depth/*.png`, `camera.json`, optional `poses.txt`.

Depth is 16-bit; `camera.json` holds width, height, fx, fy, cx, cy, depth_scale (units per metre) and fps;
`poses.txt` has 16 numbers a row, camera-to-world.
"""

from __future__ import annotations

from pathlib import Path

from mipsjax.data.calibration import CAMERA_FILE, MILLIMETRES, Options, frame_rate, with_camera_file
from mipsjax.data.framefiles import (
    COLOR_SUFFIXES,
    DEPTH_SUFFIXES,
    list_files,
    numbered_times,
    pair_by_name,
    require_images,
    rows_for_frames,
)
from mipsjax.data.imagesequence import ImageSequence, image_sequence
from mipsjax.data.trajectory import read_true_matrices
from mipsjax.errors import InputError

LAYOUT = "folder"
MARKERS = f"color/, depth/, {CAMERA_FILE}"


def matches(path: Path) -> bool:
    """Whether a folder looks like this layout."""
    # With `pose/` it is ScanNet or FastCaMo
    return (path / "color").is_dir() and (path / "depth").is_dir() and not (path / "pose").is_dir()


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a folder. Files of one name are one frame. Raises InputError."""
    keys, files = pair_by_name(
        list_files(path / "color", COLOR_SUFFIXES), list_files(path / "depth", DEPTH_SUFFIXES), _stem
    )
    require_images(files, path, "depth/*.png")
    options = with_camera_file(options, path)
    if options.intrinsics is None:
        raise InputError(f"{path}: no {CAMERA_FILE}; pass --intrinsics FX FY CX CY")
    fps, notes = frame_rate(options)
    if options.depth_scale is None:
        notes += ("no depth scale known: depth taken to be in millimetres",)
    poses = None
    if (path / "poses.txt").is_file():
        rows, pose_notes = read_true_matrices(path / "poses.txt")
        poses, row_notes = rows_for_frames(rows, keys, "poses.txt")
        notes += pose_notes + row_notes
    return image_sequence(
        name=path.name,
        layout=LAYOUT,
        source=files,
        timestamps=numbered_times(keys, fps),
        T_world_cam=poses,
        calibration=options.intrinsics,
        depth_scale=options.depth_scale or MILLIMETRES._replace(source="an assumption"),
        input=options.input,
        notes=notes,
    )


def _stem(path: Path) -> str:
    return path.stem
