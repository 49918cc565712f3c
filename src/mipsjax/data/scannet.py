"""ScanNet as exported: `color/N.jpg`, `depth/N.png`, `pose/N.txt`, `intrinsic/intrinsic_*.txt`.

Also with the `frames/` level of other exports. Poses of lost frames are inf in ScanNet.
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

LAYOUT = "scannet"
MARKERS = "color/N.jpg, depth/N.png, pose/N.txt, intrinsic/"

_INTRINSIC_ROWS = 4


def find_root(path: Path) -> Path | None:
    """The folder with `color/`, `depth/` and `pose/`: the given one or its `frames/`; None if neither."""
    parts = ("color", "depth", "pose")
    roots = (root for root in (path, path / "frames") if all((root / part).is_dir() for part in parts))
    return next(roots, None)


def has_png_color(root: Path) -> bool:
    """Whether colour is PNG, as in FastCaMo-Synth and never in ScanNet."""
    return any((root / "color").glob("*.png"))


def matches(path: Path) -> bool:
    """Whether a folder looks like this layout."""
    root = find_root(path)
    # Without intrinsics, PNG colour is FastCaMo-Synth's, which has the same folders
    return root is not None and (_intrinsic_folder(path) is not None or not has_png_color(root))


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a folder. Raises InputError."""
    options = with_camera_file(options, path)
    calibration = options.intrinsics or _calibration(path)
    if calibration is None:
        raise InputError(f"{path}: no intrinsic/intrinsic_*.txt; pass --intrinsics FX FY CX CY")
    return read_frames(path, LAYOUT, calibration, options)


def read_frames(
    path: Path, layout: str, calibration: Calibration, options: Options, notes: tuple[str, ...] = ()
) -> ImageSequence:
    """Opens the folders `color/`, `depth/` and `pose/` with files numbered by frame. Raises InputError."""
    root = find_root(path) or path
    keys, files = pair_by_name(
        list_files(root / "color", COLOR_SUFFIXES), list_files(root / "depth", DEPTH_SUFFIXES), _stem
    )
    require_images(files, root, "depth/*.png")
    # Poses have the number of whichever image there is
    stems = [(depth or color) for depth, color in zip(files.depth_paths, files.color_paths, strict=True)]
    poses, pose_notes = read_matrix_files(
        [root / "pose" / f"{stem.stem}.txt" if stem else None for stem in stems], "pose/"
    )
    fps, rate_notes = frame_rate(options)
    return image_sequence(
        name=path.name,
        layout=layout,
        source=files,
        timestamps=numbered_times(keys, fps),
        T_world_cam=poses,
        calibration=calibration,
        depth_scale=options.depth_scale or MILLIMETRES,
        input=options.input,
        notes=notes + pose_notes + rate_notes,
    )


def _calibration(path: Path) -> Calibration | None:
    """Depth intrinsics where there are some, else those of colour."""
    folder = _intrinsic_folder(path)
    if folder is not None:
        for kind in ("depth", "color"):
            file = folder / f"intrinsic_{kind}.txt"
            if file.is_file():
                return read_matrix_intrinsics(file, _INTRINSIC_ROWS, kind)
    return None


def _intrinsic_folder(path: Path) -> Path | None:
    folders = (path / "intrinsic", path / "frames" / "intrinsic")
    return next((folder for folder in folders if folder.is_dir()), None)


def _stem(path: Path) -> str:
    return path.stem
