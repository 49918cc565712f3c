"""Intrinsics and depth scale of a sequence, and where they come from."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mipsjax.config.sections import InputConfig
from mipsjax.core.camera import Intrinsics
from mipsjax.data.textfile import read_number_block, read_text
from mipsjax.errors import ConfigError, InputError

CAMERA_FILE = "camera.json"

DEFAULT_FPS = 30.0
"""Used where a layout has no times; the rate of nearly every RGB-D camera."""

ASPECT_TOLERANCE = 0.01
"""How far sizes of one view may differ in aspect: ScanNet's 1296 x 968 and 640 x 480 do by 0.004."""

LARGEST_SIDE = 1 << 14
"""Pixels along a side of an image; more than any depth camera has, and what says so is damaged or something else."""

FOCAL_RATIOS = (0.1, 30.0)
"""Focal length over the width of the image: a view of 157 degrees and one of 2 degrees. No depth camera is beyond."""

DEPTH_UNITS = (1e-3, 1e9)
"""Depth units per metre, from kilometres to nanometres."""

FRAME_RATES = (1e-3, 1e5)
"""Frames a second."""

Size = tuple[int, int]
"""Width and height in pixels."""


class DepthScale(NamedTuple):
    """What a depth of one metre is in a file."""

    units_per_metre: float
    source: str
    """Where it comes from, for the user."""

    def __str__(self) -> str:
        return f"{self.units_per_metre:g} units per metre (from {self.source})"


MILLIMETRES = DepthScale(1000.0, "the layout")
"""Of most sensors."""


@dataclass(frozen=True)
class Calibration:
    """Intrinsics as given, before the sizes of the images are known."""

    fx: float
    fy: float
    cx: float
    cy: float
    size: Size | Literal["color", "depth"]
    """The image size they belong to, or the image whose size that is."""
    source: str
    """Where they come from, for the user."""
    distortion: tuple[float, ...] = ()
    """OpenCV's k1 k2 p1 p2 k3 of colour and of the depth registered to it; empty for none."""
    declared: bool = False
    """Given by the user as an option, so a negative focal length is meant."""


class Options(NamedTuple):
    """What the user says about a sequence, the first three also in `camera.json`; None for what the layout knows."""

    intrinsics: Calibration | None = None
    depth_scale: DepthScale | None = None
    fps: float | None = None
    """Of a layout without times."""
    input: InputConfig = InputConfig()
    depth_topic: str | None = None
    """Of a bag that has several."""
    color_topic: str | None = None


class CameraFile(NamedTuple):
    """Content of `camera.json`."""

    calibration: Calibration
    depth_scale: DepthScale | None
    fps: float | None


def declared_intrinsics(numbers: Sequence[float | int]) -> Calibration:
    """Intrinsics from the option: fx fy cx cy in pixels of the depth image, or followed by width and height.

    Raises ConfigError for any other count.
    """
    if len(numbers) not in (4, 6):
        raise ConfigError(f"--intrinsics takes FX FY CX CY [W H], 4 or 6 of them, got {len(numbers)} numbers")
    if not all(_is_finite(number) for number in numbers):
        raise ConfigError("--intrinsics takes FX FY CX CY [W H] in pixels: one of them is not finite")
    if not all(0 < side <= LARGEST_SIDE for side in numbers[4:]):
        raise ConfigError(f"--intrinsics: W and H must be from 1 to {LARGEST_SIDE}, the size of an image")
    size = (int(numbers[4]), int(numbers[5])) if len(numbers) == 6 else "depth"
    fx, fy, cx, cy = (float(number) for number in numbers[:4])
    return Calibration(fx, fy, cx, cy, size, "--intrinsics", declared=True)


def with_camera_file(options: Options, folder: Path) -> Options:
    """Options that take from the folder's `camera.json`, if there is one, what they leave open.

    Every layout begins with it, so that the order is always: option, `camera.json`, the layout's own.
    Raises InputError if the file is malformed.
    """
    path = folder / CAMERA_FILE
    if not path.is_file():
        return options
    camera = read_camera_json(path)
    return options._replace(
        intrinsics=options.intrinsics or camera.calibration,
        depth_scale=options.depth_scale or camera.depth_scale,
        fps=options.fps or camera.fps,
    )


def frame_rate(options: Options) -> tuple[float, tuple[str, ...]]:
    """Frames per second of a layout without times, and a remark if they are assumed."""
    if options.fps is not None:
        return options.fps, ()
    return DEFAULT_FPS, (f"no times known: frames taken to be 1/{DEFAULT_FPS:g} s apart",)


def read_camera_json(path: Path) -> CameraFile:
    """Our own `camera.json`: fx, fy, cx, cy and optionally width, height, depth_scale, fps.

    Raises InputError if a value is missing, no number, or not positive where it has to be.
    """
    content = read_json(path)
    fx, fy, cx, cy = (json_number(content, name, path) for name in ("fx", "fy", "cx", "cy"))
    size = "depth"
    if "width" in content or "height" in content:
        size = (json_side(content, "width", path), json_side(content, "height", path))
    calibration = Calibration(fx, fy, cx, cy, size, path.name)
    depth_scale = json_depth_scale(content, "depth_scale", path) if "depth_scale" in content else None
    fps = json_within(content, "fps", FRAME_RATES, path) if "fps" in content else None
    return CameraFile(calibration, depth_scale, fps)


def read_json(path: Path) -> dict[str, Any]:
    """A file with one object. Raises InputError."""
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: an object with the camera's values is expected")
    return content


def json_number(content: dict[str, Any], name: str, path: Path) -> float:
    """One finite number. Raises InputError naming file and value."""
    value = content.get(name)
    # In Python true is a number
    if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
        raise InputError(f"{path}: {name} must be a number, got {value!r}")
    return float(value)


def json_within(content: dict[str, Any], name: str, bounds: tuple[float, float], path: Path) -> float:
    """One positive number within bounds. Raises InputError naming file and value."""
    value = json_number(content, name, path)
    if not value > 0:
        raise InputError(f"{path}: {name} must be positive, got {value:g}")
    if not bounds[0] <= value <= bounds[1]:
        raise InputError(f"{path}: {name} must be between {bounds[0]:g} and {bounds[1]:g}, got {value:g}")
    return value


def json_side(content: dict[str, Any], name: str, path: Path) -> int:
    """Width or height of an image in pixels. Raises InputError naming file and value."""
    return int(json_within(content, name, (1, LARGEST_SIDE), path))


def json_depth_scale(content: dict[str, Any], name: str, path: Path) -> DepthScale:
    """Depth units per metre. Raises InputError naming file and value."""
    return DepthScale(json_within(content, name, DEPTH_UNITS, path), path.name)


def read_matrix_intrinsics(path: Path, rows: int, size: Size | Literal["color", "depth"]) -> Calibration:
    """Intrinsics from a text file with a square matrix of `rows` rows. Raises InputError."""
    matrix = read_number_block(path, rows, rows)
    fx, fy, cx, cy = (float(value) for value in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    return Calibration(fx, fy, cx, cy, size, path.name)


def resolve_intrinsics(
    given: Calibration, color_size: Size, depth_size: Size
) -> tuple[Intrinsics, tuple[str, ...]]:
    """Intrinsics of the depth image and remarks.

    Raises InputError if they belong to another view, or are no intrinsics of such an image: a focal length
    not positive (unless declared), a principal point outside.
    """
    sizes = {"color": color_size, "depth": depth_size}
    size = sizes[given.size] if isinstance(given.size, str) else given.size
    remarks = []
    if min(size) <= 0 or not same_aspect(size, depth_size):
        raise InputError(
            f"intrinsics of {given.source} are for {_text(size)} images, depth images are "
            f"{_text(depth_size)}: pass --intrinsics FX FY CX CY for the depth images"
        )
    intrinsics = Intrinsics(given.fx, given.fy, given.cx, given.cy, *size)
    # At the size they were written for, with the numbers that the user knows
    remarks += check_intrinsics(intrinsics, given)
    if size != depth_size:
        remarks.append(f"intrinsics of {given.source} rescaled from {_text(size)} to {_text(depth_size)}")
        intrinsics = intrinsics.resized(*depth_size)
    elif given.size == "depth" and color_size != depth_size:
        remarks.append(
            f"intrinsics of {given.source} taken to belong to the depth image, {_text(depth_size)}"
        )
    return intrinsics, tuple(remarks)


def check_intrinsics(intrinsics: Intrinsics, given: Calibration) -> list[str]:
    """Remarks on odd intrinsics. Raises InputError on impossible ones, with the values and the remedy."""
    fx, fy, cx, cy, width, height = intrinsics
    values = f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} for {width} x {height}, from {given.source}"
    if not all(math.isfinite(value) for value in (fx, fy, cx, cy)) or fx == 0 or fy == 0:
        raise InputError(f"unusable intrinsics: {values}")
    # Centres of pixels are at whole numbers: the image reaches half a pixel farther
    if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        raise InputError(f"the principal point is outside the image: {values}; the order is FX FY CX CY")
    ratios = abs(fx) / width, abs(fy) / height
    if not all(FOCAL_RATIOS[0] <= ratio <= FOCAL_RATIOS[1] for ratio in ratios):
        raise InputError(
            f"no camera has such a focal length: {values}; pass --intrinsics FX FY CX CY in pixels"
        )
    if fx > 0 and fy > 0:
        return []
    if not given.declared:
        raise InputError(f"a focal length is negative: {values}; if that is meant, pass --intrinsics")
    return [f"a focal length is negative, as declared: {values}"]


def same_aspect(first: Size, second: Size) -> bool:
    """Whether two sizes can be of the same view."""
    return abs(first[0] * second[1] / (first[1] * second[0]) - 1) <= ASPECT_TOLERANCE


def _is_finite(value: float | int) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer beyond the range of floats
        return False


def _text(size: Size) -> str:
    return f"{size[0]} x {size[1]}"
