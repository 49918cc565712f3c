"""FastCaMo: folders of the synthetic part, and the binary `.seq` files of the real part.

A folder is ScanNet-like with PNG colour and no intrinsics. A `.seq` file is little-endian: int32 number of
frames, height, width; then for each frame height x width uint16 depth in millimetres and BGR bytes.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16

from mipsjax.data.calibration import (
    CAMERA_FILE,
    MILLIMETRES,
    Calibration,
    Options,
    frame_rate,
    with_camera_file,
)
from mipsjax.data.images import DEPTH_BITS, ImageHeader
from mipsjax.data.imagesequence import ImageSequence, image_sequence
from mipsjax.data.scannet import find_root, has_png_color, read_frames
from mipsjax.errors import InputError

LAYOUT = "fastcamo"
MARKERS = "color/N.png, depth/N.png, pose/N.txt without intrinsic/; or a file *.seq"

SYNTHETIC = Calibration(320.0, 320.0, 319.5, 239.5, (640, 480), "FastCaMo-Synth")

_SUFFIX = ".seq"
_HEADER = np.dtype("<i4")
_HEADER_FIELDS = 3
_LARGEST_SIDE = 1 << 14
"""A larger image side means that the file is something else."""


@dataclass(frozen=True)
class SeqFile:
    """Frames of a `.seq` file, read from the mapped file when asked for."""

    path: Path
    frames: np.memmap
    """Records with `depth` and `color`, one a frame."""

    def __len__(self) -> int:
        return len(self.frames)

    def color(self, position: int) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
        """RGB pixels."""
        return np.ascontiguousarray(self.frames[position]["color"][..., ::-1]), ""

    def raw_depth(self, position: int) -> tuple[UInt16[np.ndarray, "H W"] | None, str]:
        """Depth in millimetres."""
        return np.array(self.frames[position]["depth"], dtype=np.uint16), ""

    def color_header(self, position: int) -> ImageHeader | None:
        """Size and type."""
        height, width = self.frames.dtype["depth"].shape
        return ImageHeader(width, height, 8, 3)

    def depth_header(self, position: int) -> ImageHeader | None:
        """Size and type."""
        height, width = self.frames.dtype["depth"].shape
        return ImageHeader(width, height, DEPTH_BITS, 1)

    def depth_name(self, position: int) -> Path:
        """The file, for messages."""
        return self.path


def matches(path: Path) -> bool:
    """Whether a path looks like this layout."""
    if path.suffix.lower() == _SUFFIX:
        return path.is_file()
    root = find_root(path)
    if root is None or not has_png_color(root):
        return False
    return not any((folder / "intrinsic").is_dir() for folder in (path, root))


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a folder or a `.seq` file. Raises InputError."""
    if path.is_file():
        return _read_seq(path, with_camera_file(options, path.parent))
    options = with_camera_file(options, path)
    notes = () if options.intrinsics else (f"intrinsics of {SYNTHETIC.source} assumed",)
    return read_frames(path, LAYOUT, options.intrinsics or SYNTHETIC, options, notes)


def open_seq(path: Path) -> tuple[SeqFile, tuple[str, ...]]:
    """Maps a `.seq` file, and remarks if it is cut short. Raises InputError if it is no such file."""
    try:
        header = np.fromfile(path, _HEADER, _HEADER_FIELDS)
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    count, height, width = (int(value) for value in header) if len(header) == _HEADER_FIELDS else (0, 0, 0)
    if count <= 0 or not (0 < height <= _LARGEST_SIDE and 0 < width <= _LARGEST_SIDE):
        raise InputError(f"{path}: not a .seq file (frames {count}, height {height}, width {width})")
    record = np.dtype([("depth", "<u2", (height, width)), ("color", "u1", (height, width, 3))])
    offset = _HEADER.itemsize * _HEADER_FIELDS
    whole = min(count, (size - offset) // record.itemsize)
    if whole < 1:
        raise InputError(f"{path}: {count} frames announced, not one is complete")
    notes = (f"{path.name}: {count} frames announced, {whole} are complete",) if whole < count else ()
    return SeqFile(path, np.memmap(path, record, mode="r", offset=offset, shape=(whole,))), notes


def _read_seq(path: Path, options: Options) -> ImageSequence:
    source, notes = open_seq(path)
    if options.intrinsics is None:
        raise InputError(
            f"{path}: a .seq file holds no intrinsics; pass --intrinsics FX FY CX CY or put {CAMERA_FILE} "
            "beside it"
        )
    fps, rate_notes = frame_rate(options)
    return image_sequence(
        name=path.stem,
        layout=LAYOUT,
        source=source,
        timestamps=np.arange(len(source)) / fps,
        T_world_cam=None,
        calibration=options.intrinsics,
        depth_scale=options.depth_scale or MILLIMETRES,
        input=options.input,
        notes=notes + rate_notes,
    )
