"""Intrinsics and depth scale of a sequence, and where they come from."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from mipsjax.config import InputConfig
from mipsjax.core.camera import Intrinsics
from mipsjax.data.textfile import read_number_block, read_text
from mipsjax.errors import ConfigError, InputError

DEFAULT_FPS = 30.0
"""Used where a layout has no times; the rate of nearly every RGB-D camera."""

MILLIMETRES = 1000.0
"""Depth units per metre of most sensors."""

ASPECT_TOLERANCE = 0.01
"""How far sizes of one view may differ in aspect: ScanNet's 1296 x 968 and 640 x 480 do by 0.004."""

Size = tuple[int, int]
"""Width and height in pixels."""


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
    """What the user says about a sequence; None for what the layout knows."""

    intrinsics: Calibration | None = None
    depth_scale: float | None = None
    """Depth units per metre."""
    input: InputConfig = InputConfig()


class CameraFile(NamedTuple):
    """Content of `camera.json`."""

    calibration: Calibration
    depth_scale: float | None
    """Depth units per metre."""
    fps: float | None


def declared_intrinsics(numbers: Sequence[float | int]) -> Calibration:
    """Intrinsics from the option: fx fy cx cy in pixels of the depth image, or followed by width and height.

    Raises ConfigError for any other count.
    """
    if len(numbers) not in (4, 6):
        raise ConfigError(f"--intrinsics takes FX FY CX CY [W H], got {len(numbers)} numbers")
    size = (int(numbers[4]), int(numbers[5])) if len(numbers) == 6 else "depth"
    fx, fy, cx, cy = (float(number) for number in numbers[:4])
    return Calibration(fx, fy, cx, cy, size, "--intrinsics", declared=True)


def read_camera_json(path: Path) -> CameraFile:
    """Our own `camera.json`: fx, fy, cx, cy and optionally width, height, depth_scale, fps.

    Raises InputError if a value is missing or no number.
    """
    content = read_json(path)
    fx, fy, cx, cy = (json_number(content, name, path) for name in ("fx", "fy", "cx", "cy"))
    size = "depth"
    if "width" in content or "height" in content:
        size = (int(json_number(content, "width", path)), int(json_number(content, "height", path)))
    calibration = Calibration(fx, fy, cx, cy, size, path.name)
    optional = (
        json_number(content, name, path) if name in content else None for name in ("depth_scale", "fps")
    )
    depth_scale, fps = optional
    if fps is not None and not fps > 0:
        raise InputError(f"{path}: fps must be positive, got {fps:g}")
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
    if isinstance(value, bool) or not isinstance(value, int | float) or not _is_finite(value):
        raise InputError(f"{path}: {name} must be a number, got {value!r}")
    return float(value)


def read_matrix_intrinsics(path: Path, rows: int, size: Size | Literal["color", "depth"]) -> Calibration:
    """Intrinsics from a text file with a square matrix of `rows` rows. Raises InputError."""
    matrix = read_number_block(path, rows, rows)
    fx, fy, cx, cy = (float(value) for value in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]))
    return Calibration(fx, fy, cx, cy, size, path.name)


def require_scale(depth_scale: float | None, default: float) -> float:
    """Depth units per metre: the given ones or the layout's. Raises InputError if they are not positive."""
    scale = default if depth_scale is None else depth_scale
    if not (scale > 0 and math.isfinite(scale)):
        raise InputError(f"the depth scale must be a positive number of units per metre, got {scale:g}")
    return scale


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
    if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        raise InputError(f"the principal point is outside the image: {values}; the order is FX FY CX CY")
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
