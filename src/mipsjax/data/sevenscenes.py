"""7-Scenes as published: `frame-%06d.color.png`, `.depth.png`, `.pose.txt`, in millimetres.

Colour is not registered to depth in it, and its rotations are orthonormal to about 1e-3 only.
"""

from __future__ import annotations

from pathlib import Path

from mipsjax.data.calibration import (
    MILLIMETRES,
    Calibration,
    Options,
    frame_rate,
    read_matrix_intrinsics,
    with_camera_file,
)
from mipsjax.data.framefiles import (
    COLOR_SUFFIXES,
    DEPTH_SUFFIXES,
    list_files,
    numbered_times,
    pair_by_name,
    require_images,
)
from mipsjax.data.imagesequence import ImageSequence, image_sequence
from mipsjax.data.trajectory import read_matrix_files
from mipsjax.errors import InputError

LAYOUT = "sevenscenes"
MARKERS = "frame-*.color.png, frame-*.depth.png, frame-*.pose.txt"

PUBLISHED = Calibration(585.0, 585.0, 320.0, 240.0, (640, 480), "the 7-Scenes documentation")

_INTRINSICS_FILE = "camera-intrinsics.txt"
_INTRINSICS_ROWS = 3


def matches(path: Path) -> bool:
    """Whether a folder looks like this layout, or holds folders `seq-XX` that do."""
    return _is_sequence(path) or bool(_sequences_in(path))


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a sequence, or the only sequence of a scene. Raises InputError if a scene has several."""
    folder, notes = _choose(path)
    options = with_camera_file(options, folder)
    colors = [file for file in list_files(folder, COLOR_SUFFIXES) if ".color." in file.name]
    depths = [file for file in list_files(folder, DEPTH_SUFFIXES) if ".depth." in file.name]
    keys, files = pair_by_name(colors, depths, _frame_name)
    require_images(files, folder, "frame-*.depth.png")
    places = zip(files.depth_paths, files.color_paths, strict=True)
    poses, pose_notes = read_matrix_files(
        [_pose_file(depth or color) for depth, color in places], "*.pose.txt"
    )
    calibration, camera_notes = _calibration(folder, options)
    fps, rate_notes = frame_rate(options)
    return image_sequence(
        name=folder.name,
        layout=LAYOUT,
        source=files,
        timestamps=numbered_times(keys, fps),
        T_world_cam=poses,
        calibration=calibration,
        depth_scale=options.depth_scale or MILLIMETRES,
        input=options.input,
        notes=(
            *notes,
            *camera_notes,
            *pose_notes,
            *rate_notes,
            "colour is not registered to depth in 7-Scenes: it is off by some pixels",
        ),
    )


def _choose(path: Path) -> tuple[Path, tuple[str, ...]]:
    if _is_sequence(path):
        return path, ()
    sequences = _sequences_in(path)
    if len(sequences) == 1:
        return sequences[0], (f"the only sequence of the folder taken: {sequences[0].name}",)
    names = ", ".join(folder.name for folder in sequences) or "none"
    hint = f"; choose one, such as {sequences[0]}" if sequences else ""
    raise InputError(f"{path}: {len(sequences)} sequences in this folder ({names}){hint}")


def _calibration(folder: Path, options: Options) -> tuple[Calibration, tuple[str, ...]]:
    if options.intrinsics is not None:
        return options.intrinsics, ()
    file = folder / _INTRINSICS_FILE
    if file.is_file():
        return read_matrix_intrinsics(file, _INTRINSICS_ROWS, "depth"), ()
    return PUBLISHED, (f"intrinsics of {PUBLISHED.source} assumed",)


def _is_sequence(path: Path) -> bool:
    return any(path.glob("frame-*.depth.png"))


def _sequences_in(path: Path) -> list[Path]:
    return sorted(folder for folder in path.glob("seq-*") if folder.is_dir() and _is_sequence(folder))


def _frame_name(path: Path) -> str:
    # Without `.color.png` and the like: `Path.stem` takes the last ending only
    return path.name.split(".", 1)[0]


def _pose_file(image: Path | None) -> Path | None:
    return image.with_name(f"{_frame_name(image)}.pose.txt") if image else None
