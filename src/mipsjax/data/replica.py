"""Replica as rendered for neural SLAM: `results/frame%06d.jpg`, `results/depth%06d.png`, `traj.txt`.

`cam_params.json` lies in the folder or one level up.
"""

from __future__ import annotations

from pathlib import Path

from mipsjax.data.calibration import (
    Calibration,
    DepthScale,
    Options,
    frame_rate,
    json_depth_scale,
    json_number,
    json_side,
    read_json,
    with_camera_file,
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
from mipsjax.data.trajectory import read_true_matrices
from mipsjax.errors import InputError

LAYOUT = "replica"
MARKERS = "results/frame*.jpg, results/depth*.png, traj.txt"

PUBLISHED = Calibration(600.0, 600.0, 599.5, 339.5, (1200, 680), "the published Replica renders")

DEPTH_SCALE = DepthScale(6553.5, PUBLISHED.source)
"""65535 is ten metres."""

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
    options = with_camera_file(options, path)
    calibration, scale, notes = _camera(path, options)
    fps, rate_notes = frame_rate(options)
    poses = None
    if (path / "traj.txt").is_file():
        rows, pose_notes = read_true_matrices(path / "traj.txt")
        poses, row_notes = rows_for_frames(rows, keys, "traj.txt")
        notes += pose_notes + row_notes
    return image_sequence(
        name=path.name,
        layout=LAYOUT,
        source=files,
        timestamps=numbered_times(keys, fps),
        T_world_cam=poses,
        calibration=calibration,
        depth_scale=scale,
        input=options.input,
        notes=notes + rate_notes,
    )


def _camera(path: Path, options: Options) -> tuple[Calibration, DepthScale, tuple[str, ...]]:
    """Intrinsics, depth scale and remarks; the file is looked at only for what the options leave open."""
    if options.intrinsics and options.depth_scale:
        return options.intrinsics, options.depth_scale, ()
    calibration, scale, notes = _camera_params(path, options)
    return options.intrinsics or calibration, options.depth_scale or scale, notes


def _camera_params(path: Path, options: Options) -> tuple[Calibration, DepthScale, tuple[str, ...]]:
    """Intrinsics, depth scale and remarks, from the folder or the one above it."""
    places = (path / _CAMERA_FILE, path.parent / _CAMERA_FILE)
    file = next((place for place in places if place.is_file()), None)
    if file is None:
        wanted = {"camera": options.intrinsics, "depth scale": options.depth_scale}
        missing = " and ".join(name for name, known in wanted.items() if known is None)
        return PUBLISHED, DEPTH_SCALE, (f"no {_CAMERA_FILE}: {missing} of {PUBLISHED.source} assumed",)
    content = read_json(file)
    # In a section of its own as published, or at the top
    camera = content.get("camera", content)
    if not isinstance(camera, dict):
        raise InputError(f"{file}: 'camera' must hold the values w, h, fx, fy, cx, cy, scale")
    width, height = json_side(camera, "w", file), json_side(camera, "h", file)
    fx, fy, cx, cy = (json_number(camera, name, file) for name in ("fx", "fy", "cx", "cy"))
    scale = json_depth_scale(camera, "scale", file)
    return Calibration(fx, fy, cx, cy, (width, height), file.name), scale, ()


def _number(path: Path) -> str:
    return path.stem.removeprefix(_COLOR).removeprefix(_DEPTH)
