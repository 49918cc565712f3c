"""Replica as rendered for neural SLAM: `results/frame%06d.jpg`, `results/depth%06d.png`, `traj.txt`.

`cam_params.json` lies in the folder or one level up.
"""

from __future__ import annotations

from pathlib import Path

from mipsjax.data.calibration import (
    DEFAULT_FPS,
    Calibration,
    Options,
    json_number,
    read_json,
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

LAYOUT = "replica"
MARKERS = "results/frame*.jpg, results/depth*.png, traj.txt"

DEPTH_UNITS_PER_METRE = 6553.5
"""Of the published renders, where 65535 is ten metres."""

PUBLISHED = Calibration(600.0, 600.0, 599.5, 339.5, (1200, 680), "the published Replica renders")

_CAMERA_FILE = "cam_params.json"
_COLOR, _DEPTH = "frame", "depth"


def matches(path: Path) -> bool:
    """Whether a folder looks like this layout."""
    return any((path / "results").glob(f"{_DEPTH}*.png"))


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a folder. Raises InputError."""
    colors = [file for file in list_files(path / "results", COLOR_SUFFIXES) if file.name.startswith(_COLOR)]
    depths = [file for file in list_files(path / "results", DEPTH_SUFFIXES) if file.name.startswith(_DEPTH)]
    keys, files = pair_by_name(colors, depths, _number)
    require_images(files, path, "results/depth*.png")
    calibration, scale, notes = _camera(path)
    poses = None
    if (path / "traj.txt").is_file():
        rows, pose_notes = read_matrix_rows(path / "traj.txt")
        poses, row_notes = rows_for_frames(rows, keys, "traj.txt")
        notes += pose_notes + row_notes
    return image_sequence(
        name=path.name,
        layout=LAYOUT,
        source=files,
        timestamps=numbered_times(keys, DEFAULT_FPS),
        T_world_cam=poses,
        calibration=options.intrinsics or calibration,
        depth_scale=require_scale(options.depth_scale, scale),
        input=options.input,
        notes=(*notes, f"no times known: frames taken to be 1/{DEFAULT_FPS:g} s apart"),
    )


def _camera(path: Path) -> tuple[Calibration, float, tuple[str, ...]]:
    """Intrinsics, depth units per metre and remarks, from the folder or the one above it."""
    places = (path / _CAMERA_FILE, path.parent / _CAMERA_FILE)
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        note = f"no {_CAMERA_FILE}: camera and depth scale of {PUBLISHED.source} assumed"
        return PUBLISHED, DEPTH_UNITS_PER_METRE, (note,)
    content = read_json(file)
    camera = content.get("camera", content)
    if not isinstance(camera, dict):
        raise InputError(f"{file}: 'camera' must hold the values w, h, fx, fy, cx, cy, scale")
    width, height, fx, fy, cx, cy, scale = (
        json_number(camera, name, file) for name in ("w", "h", "fx", "fy", "cx", "cy", "scale")
    )
    return Calibration(fx, fy, cx, cy, (int(width), int(height)), file.name), scale, ()


def _number(path: Path) -> str:
    return path.stem.removeprefix(_COLOR).removeprefix(_DEPTH)
