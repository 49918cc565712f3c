"""Our own layout: `color/*.jpg|png`, `depth/*.png`, `camera.json`, optional `poses.txt`.

Depth is 16-bit; `camera.json` holds width, height, fx, fy, cx, cy, depth_scale (units per metre) and fps;
`poses.txt` has 16 numbers a row, camera-to-world.
"""

from __future__ import annotations

from pathlib import Path

from mipsjax.data.calibration import (
    DEFAULT_FPS,
    MILLIMETRES,
    CameraFile,
    Options,
    read_camera_json,
    require_scale,
)
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
from mipsjax.data.trajectory import read_matrix_rows
from mipsjax.errors import InputError

LAYOUT = "folder"
MARKERS = "color/, depth/, camera.json"

CAMERA_FILE = "camera.json"


def matches(path: Path) -> bool:
    """Whether a folder looks like this layout."""
    return (path / "color").is_dir() and (path / "depth").is_dir() and not (path / "pose").is_dir()


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a folder. Files of one name are one frame. Raises InputError."""
    keys, files = pair_by_name(
        list_files(path / "color", COLOR_SUFFIXES), list_files(path / "depth", DEPTH_SUFFIXES), _stem
    )
    require_images(files, path, "depth/*.png")
    camera, notes = _camera(path, options)
    poses = None
    if (path / "poses.txt").is_file():
        rows, pose_notes = read_matrix_rows(path / "poses.txt")
        poses, row_notes = rows_for_frames(rows, keys, "poses.txt")
        notes += pose_notes + row_notes
    return image_sequence(
        name=path.name,
        layout=LAYOUT,
        source=files,
        timestamps=numbered_times(keys, camera.fps or DEFAULT_FPS),
        T_world_cam=poses,
        calibration=camera.calibration,
        depth_scale=require_scale(options.depth_scale or camera.depth_scale, MILLIMETRES),
        input=options.input,
        notes=notes,
    )


def _camera(path: Path, options: Options) -> tuple[CameraFile, tuple[str, ...]]:
    """`camera.json`, its intrinsics replaced by declared ones, and remarks on what is assumed."""
    if (path / CAMERA_FILE).is_file():
        camera = read_camera_json(path / CAMERA_FILE)
    elif options.intrinsics is not None:
        camera = CameraFile(options.intrinsics, None, None)
    else:
        raise InputError(f"{path}: no {CAMERA_FILE}; pass --intrinsics FX FY CX CY")
    notes = []
    if camera.fps is None:
        notes.append(f"no times known: frames taken to be 1/{DEFAULT_FPS:g} s apart")
    if camera.depth_scale is None and options.depth_scale is None:
        notes.append("no depth scale known: depth taken to be in millimetres")
    return camera._replace(calibration=options.intrinsics or camera.calibration), tuple(notes)


def _stem(path: Path) -> str:
    return path.stem
