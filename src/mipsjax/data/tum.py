"""TUM RGB-D: `rgb.txt`, `depth.txt` and `groundtruth.txt`, or pairs in `associations.txt`.

Also Bonn and other sequences in this layout; for those the intrinsics are an option or a `camera.json`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.data.association import associate, poses_at, sort_stamps
from mipsjax.data.calibration import DEFAULT_FPS, Calibration, DepthScale, Options, with_camera_file
from mipsjax.data.framefiles import ImageFiles
from mipsjax.data.images import DEPTH_BITS, read_header
from mipsjax.data.imagesequence import ImageSequence, image_sequence
from mipsjax.data.textfile import content_lines, parse_number
from mipsjax.data.trajectory import known_poses, read_true_tum
from mipsjax.errors import InputError

LAYOUT = "tum"
MARKERS = "rgb.txt, depth.txt; or associations.txt"

DEPTH_SCALE = DepthScale(5000.0, "the layout")

CAMERAS = {
    "1": Calibration(
        517.3, 516.5, 318.6, 255.3, (640, 480), "freiburg1", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    "2": Calibration(
        520.9, 521.0, 325.1, 249.7, (640, 480), "freiburg2", (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    "3": Calibration(535.4, 539.2, 320.1, 247.6, (640, 480), "freiburg3"),
}
"""The three cameras of the benchmark, by the digit in the name of a sequence; from its documentation."""

LEAST_OF_ITS_TIME = 0.5
"""Share of the images of a list that must have a time of their own; with fewer, times were rounded."""

_CAMERA_NAME = re.compile(r"(?<![a-z0-9])(?:freiburg|fr)([123])(?![a-z0-9])", re.IGNORECASE)
_ASSOCIATIONS = ("associations.txt", "association.txt", "associate.txt")
_COLOR_LISTS = ("rgb.txt", "color.txt")
_GROUND_TRUTH = ("groundtruth.txt", "pose.txt")
_ASSOCIATION_WORDS = 4


class Listing(NamedTuple):
    """Pairs of images with the time of the depth image."""

    timestamps: Float64[np.ndarray, "N"]
    """As written in the file."""
    files: ImageFiles
    notes: tuple[str, ...]


def matches(path: Path) -> bool:
    """Whether a folder looks like this layout."""
    listed = _first_file(path, _COLOR_LISTS) is not None and (path / "depth.txt").is_file()
    return listed or _first_file(path, _ASSOCIATIONS) is not None


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a folder. Raises InputError."""
    options = with_camera_file(options, path)
    associations = _first_file(path, _ASSOCIATIONS)
    # Pairs that somebody has chosen go before those that are nearest in time
    listing = read_associations(associations) if associations else read_lists(path)
    calibration, camera_notes = _calibration(path, options)
    truth = _first_file(path, _GROUND_TRUTH)
    poses, truth_notes = _poses(truth, listing.timestamps) if truth else (None, ())
    times, time_notes = _seconds(listing.timestamps, options.fps or DEFAULT_FPS)
    return image_sequence(
        name=path.name,
        layout=LAYOUT,
        source=listing.files,
        timestamps=times,
        T_world_cam=poses,
        calibration=calibration,
        depth_scale=options.depth_scale or DEPTH_SCALE,
        input=options.input,
        notes=listing.notes + camera_notes + time_notes + truth_notes,
    )


def read_lists(path: Path) -> Listing:
    """Pairs from `rgb.txt` and `depth.txt`, nearest in time. Raises InputError."""
    rgb_times, rgb_files, rgb_notes = _read_list(_first_file(path, _COLOR_LISTS) or path / _COLOR_LISTS[0])
    depth_times, depth_files, depth_notes = _read_list(path / "depth.txt")
    try:
        rgb, depth = associate(rgb_times, depth_times)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    notes = rgb_notes + depth_notes
    if len(depth) < len(depth_files) or len(rgb) < len(rgb_files):
        counts = f"{len(rgb_files)} colour and {len(depth_files)} depth images"
        notes += (f"{len(depth)} pairs of {counts}; the others have no partner in time",)
    files = ImageFiles(tuple(rgb_files[i] for i in rgb), tuple(depth_files[i] for i in depth))
    # A frame is of the moment of its depth, which the map is made of
    return Listing(depth_times[depth], files, notes)


def read_associations(path: Path) -> Listing:
    """Pairs from lines `time file time file`, colour or depth first. Raises InputError."""
    rows = [_association(line, number, path) for number, line in content_lines(path)]
    if not rows:
        raise InputError(f"{path}: lists no images")
    times = np.array([row[:2] for row in rows])
    first, second = [path.parent / row[2] for row in rows], [path.parent / row[3] for row in rows]
    depth_first = _is_depth(first, second)
    color, depth = (second, first) if depth_first else (first, second)
    order = "depth first" if depth_first else "colour first"
    notes = (f"pairs taken from {path.name} ({order})",)
    return Listing(times[:, 0 if depth_first else 1], ImageFiles(tuple(color), tuple(depth)), notes)


def camera_from_name(path: Path) -> Calibration | None:
    """The camera named in a path, such as `freiburg2` or `fr2`; the innermost folder decides."""
    parts = reversed(path.parts)
    found = (re.findall(_CAMERA_NAME, part) for part in parts)
    return next((CAMERAS[digits[0]] for digits in found if digits), None)


def _calibration(path: Path, options: Options) -> tuple[Calibration, tuple[str, ...]]:
    if options.intrinsics is not None:
        return options.intrinsics, ()
    camera = camera_from_name(path)
    if camera is None:
        raise InputError(
            f"{path}: intrinsics unknown; pass --intrinsics FX FY CX CY or put camera.json there (only the "
            "cameras freiburg1, 2 and 3 are known, by the name of the folder)"
        )
    undistorted = ", images undistorted" if any(camera.distortion) else ""
    return camera, (f"intrinsics of {camera.source} from the name of the folder{undistorted}",)


def _poses(
    truth: Path, timestamps: Float64[np.ndarray, "N"]
) -> tuple[Float64[np.ndarray, "N 4 4"], tuple[str, ...]]:
    trajectory, remarks = read_true_tum(truth)
    poses = poses_at(timestamps, trajectory)
    known = int(known_poses(poses).sum())
    if known == len(poses):
        return poses, remarks
    return poses, (*remarks, f"{truth.name}: true pose known for {known} of {len(poses)} frames")


def _seconds(
    timestamps: Float64[np.ndarray, "N"], fps: float
) -> tuple[Float64[np.ndarray, "N"], tuple[str, ...]]:
    """Timestamps that are frame numbers, as in ICL-NUIM, become seconds."""
    steps = np.diff(np.sort(timestamps))
    if len(steps) and np.all(timestamps == np.round(timestamps)) and np.median(steps) == 1.0:
        return timestamps / fps, (f"timestamps are frame numbers: frames taken to be 1/{fps:g} s apart",)
    return timestamps, ()


def _read_list(path: Path) -> tuple[Float64[np.ndarray, "N"], list[Path], tuple[str, ...]]:
    """Times and files of a list `time file`, in the order of time."""
    times, files = [], []
    for number, line in content_lines(path):
        words = line.split(maxsplit=1)
        if len(words) != 2:
            raise InputError(f"{path}, line {number}: a time and a file name expected")
        times.append(_time(words[0], path, number))
        files.append(path.parent / words[1])
    if not files:
        raise InputError(f"{path}: lists no images")
    stamps = np.array(times)
    order, notes = sort_stamps(stamps, path.name)
    if len(order) < LEAST_OF_ITS_TIME * len(stamps):
        raise InputError(
            f"{path}: {len(stamps) - len(order)} of {len(stamps)} images have the time of another: write times with "
            "fractions of a second"
        )
    return stamps[order], [files[place] for place in order], notes


def _association(line: str, number: int, path: Path) -> tuple[float, float, str, str]:
    words = line.split()
    if len(words) != _ASSOCIATION_WORDS:
        raise InputError(f"{path}, line {number}: time, file, time, file expected")
    return _time(words[0], path, number), _time(words[2], path, number), words[1], words[3]


def _time(word: str, path: Path, number: int) -> float:
    time = parse_number(word, path, number)
    if not np.isfinite(time):
        raise InputError(f"{path}, line {number}: {word!r} is not a time")
    return time


def _is_depth(first: list[Path], second: list[Path]) -> bool:
    """Whether the first files are the depth images: by their type, or else by their folder's name."""
    for one, other in zip(first, second, strict=True):
        headers = read_header(one), read_header(other)
        if headers[0] and headers[1]:
            return headers[0].bits == DEPTH_BITS and headers[0].channels == 1
    return "depth" in first[0].parent.name.lower()


def _first_file(path: Path, names: tuple[str, ...]) -> Path | None:
    return next((path / name for name in names if (path / name).is_file()), None)
