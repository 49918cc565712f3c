"""Where the images of a sequence come from, and how files of one frame are found by their names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, Num, UInt8, UInt16

from mipsjax.data import images
from mipsjax.data.images import ImageHeader
from mipsjax.errors import InputError

COLOR_SUFFIXES = (".jpg", ".jpeg", ".png")
DEPTH_SUFFIXES = (".png",)

SPARSEST_NUMBERING = 1000
"""Names whose numbers are sparser than one in this many are stamps or identifiers, not frame numbers."""

FrameKey = tuple[tuple[int, int, str], ...]
"""A name split into numbers and words, so that 2 comes before 10 and `1` equals `000001`."""


@runtime_checkable
class FrameSource(Protocol):
    """Raw images by position; None and a reason where one is missing or broken."""

    def __len__(self) -> int: ...

    def color(self, position: int) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]: ...

    def raw_depth(self, position: int) -> tuple[Num[np.ndarray, "H W"] | None, str]: ...

    def color_header(self, position: int) -> ImageHeader | None: ...

    def depth_header(self, position: int) -> ImageHeader | None: ...

    def depth_name(self, position: int) -> Path: ...

    def files(self, position: int) -> tuple[Path, ...]: ...


@dataclass(frozen=True)
class ImageFiles:
    """One colour and one depth file a frame, read when asked for; None where a frame has no such file."""

    color_paths: tuple[Path | None, ...]
    depth_paths: tuple[Path | None, ...]

    def __len__(self) -> int:
        return len(self.depth_paths)

    def color(self, position: int) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
        """RGB pixels."""
        path = self.color_paths[position]
        return images.read_color(path) if path else (None, "missing_color: no file")

    def raw_depth(self, position: int) -> tuple[UInt16[np.ndarray, "H W"] | None, str]:
        """Depth in the units of the file. Raises InputError if it is not 16-bit with one channel."""
        path = self.depth_paths[position]
        return images.read_raw_depth(path) if path else (None, "missing_depth: no file")

    def color_header(self, position: int) -> ImageHeader | None:
        """Size and type without decoding."""
        path = self.color_paths[position]
        return images.read_header(path) if path else None

    def depth_header(self, position: int) -> ImageHeader | None:
        """Size and type without decoding."""
        path = self.depth_paths[position]
        return images.read_header(path) if path else None

    def depth_name(self, position: int) -> Path:
        """The depth file, for messages."""
        return self.depth_paths[position] or Path("no depth file")

    def files(self, position: int) -> tuple[Path, ...]:
        """All that there are of a frame."""
        both = self.color_paths[position], self.depth_paths[position]
        return tuple(path for path in both if path is not None)


def frame_key(name: str) -> FrameKey:
    """The sorting and pairing key of a name."""
    parts = re.findall(r"[0-9]+|[^0-9]+", name)
    return tuple((0, int(part), "") if part[0] in "0123456789" else (1, 0, part) for part in parts)


def list_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Files of a folder with one of the suffixes in any case, hidden ones left out; empty if no folder."""
    if not folder.is_dir():
        return []
    # Hidden ones are of the system, as macOS leaves `._1.png` beside `1.png`
    files = (path for path in folder.iterdir() if not path.name.startswith("."))
    return sorted(path for path in files if path.suffix.lower() in suffixes)


def pair_by_name(
    colors: Iterable[Path], depths: Iterable[Path], name_of: Callable[[Path], str]
) -> tuple[list[FrameKey], ImageFiles]:
    """Frames in numeric order from files of one name; a frame with only one of the two is kept."""
    color = {frame_key(name_of(path)): path for path in colors}
    depth = {frame_key(name_of(path)): path for path in depths}
    keys = sorted(color.keys() | depth.keys())
    files = ImageFiles(tuple(color.get(key) for key in keys), tuple(depth.get(key) for key in keys))
    return keys, files


def require_images(files: ImageFiles, folder: Path, depth_pattern: str) -> None:
    """Raises InputError if there is no depth image at all, or none that goes with a colour image."""
    if not any(files.depth_paths):
        raise InputError(f"{folder}: no depth images ({depth_pattern})")
    places = list(zip(files.color_paths, files.depth_paths, strict=True))
    if any(files.color_paths) and not any(color and depth for color, depth in places):
        color, depth = (
            next(path for path in paths if path) for paths in (files.color_paths, files.depth_paths)
        )
        raise InputError(
            f"{folder}: no colour image has the number of a depth image, the first are {color.name} and "
            f"{depth.name}; rename them, so that those of one moment have the same"
        )


def frame_numbers(keys: list[FrameKey]) -> list[int] | None:
    """Numbers in the names, one a frame, increasing; None if names are not numbers of frames."""
    if not keys:
        return None
    found = [[number for kind, number, _ in key if kind == 0] for key in keys]
    if any(len(numbers) != 1 for numbers in found):
        return None
    numbers = [single for (single,) in found]
    increasing = all(later > earlier for earlier, later in pairwise(numbers))
    dense = numbers[-1] - numbers[0] <= SPARSEST_NUMBERING * len(numbers)
    return numbers if increasing and dense else None


def numbered_times(keys: list[FrameKey], fps: float) -> Float64[np.ndarray, "N"]:
    """Seconds from the first frame; a number left out in the names is time that passed."""
    numbers = frame_numbers(keys) or list(range(len(keys)))
    # Whole numbers are subtracted: floats of twenty digits would all be one
    return np.array([number - numbers[0] for number in numbers], dtype=np.float64) / fps


def rows_for_frames(
    rows: Float64[np.ndarray, "R 4 4"], keys: list[FrameKey], source: str
) -> tuple[Float64[np.ndarray, "N 4 4"], tuple[str, ...]]:
    """Poses listed a row a frame, matched to the frames; unknown rows are NaN, remarked on.

    With as many rows as frames the order decides, otherwise the number in the name of the frame.
    """
    if len(rows) == len(keys):
        return rows, ()
    numbers = frame_numbers(keys) or list(range(len(keys)))
    poses = np.full((len(keys), 4, 4), np.nan)
    # Lists of truth have a row for each frame of the recording, those that were left out among them
    found = [(place, number) for place, number in enumerate(numbers) if number < len(rows)]
    if found:
        places, row_numbers = zip(*found, strict=True)
        poses[list(places)] = rows[list(row_numbers)]
    remark = (
        f"{source}: {len(rows)} rows for {len(keys)} frames, matched by number; {len(found)} frames have one"
    )
    return poses, (remark,)
