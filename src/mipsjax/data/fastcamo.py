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
    LARGEST_SIDE,
    MILLIMETRES,
    Calibration,
    Options,
    frame_rate,
    with_camera_file,
)
from mipsjax.data.images import DEPTH_BITS, MOST_PIXELS, ImageHeader
from mipsjax.data.imagesequence import ImageSequence, image_sequence
from mipsjax.data.scannet import find_root, has_png_color, read_frames
from mipsjax.errors import InputError

LAYOUT = "fastcamo"
MARKERS = "color/N.png, depth/N.png, pose/N.txt without intrinsic/; or a file *.seq"

SYNTHETIC = Calibration(320.0, 320.0, 319.5, 239.5, (640, 480), "FastCaMo-Synth")

_SUFFIX = ".seq"
_HEADER = np.dtype("<i4")
_HEADER_FIELDS = 3
_OFFSET = _HEADER.itemsize * _HEADER_FIELDS
_DEPTH, _COLOR = np.dtype("<u2"), np.dtype(("u1", 3))
"""Of one pixel, in this order in the file."""


@dataclass(frozen=True)
class SeqFile:
    """Frames of a `.seq` file, read when asked for. Not mapped into memory: where a mapped file is cut meanwhile, the
    system ends the process."""

    path: Path
    frames: int
    height: int
    width: int

    def __len__(self) -> int:
        return self.frames

    def color(self, position: int) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
        """RGB pixels."""
        bgr, problem = self._pixels(position, _COLOR, "color")
        return (None, problem) if bgr is None else (np.ascontiguousarray(bgr[..., ::-1]), "")

    def raw_depth(self, position: int) -> tuple[UInt16[np.ndarray, "H W"] | None, str]:
        """Depth in millimetres."""
        depth, problem = self._pixels(position, _DEPTH, "depth")
        # In the byte order of the machine, whatever that of the file
        return (None, problem) if depth is None else (depth.astype(np.uint16), "")

    def color_header(self, position: int) -> ImageHeader | None:
        """Size and type."""
        return ImageHeader(self.width, self.height, 8, 3)

    def depth_header(self, position: int) -> ImageHeader | None:
        """Size and type."""
        return ImageHeader(self.width, self.height, DEPTH_BITS, 1)

    def depth_name(self, position: int) -> Path:
        """The file, for messages."""
        return self.path

    def files(self, position: int) -> tuple[Path, ...]:
        """The one of all frames."""
        return (self.path,)

    def _pixels(self, position: int, kind: np.dtype, name: str) -> tuple[np.ndarray | None, str]:
        """One of the two images of a frame, or None and why not."""
        record = _record(self.height, self.width)
        offset = 0 if name == "depth" else self.height * self.width * _DEPTH.itemsize
        shape = (self.height, self.width, *kind.shape)
        try:
            with self.path.open("rb") as file:
                file.seek(_OFFSET + position * record.itemsize + offset)
                data = file.read(self.height * self.width * kind.itemsize)
        except OSError as error:
            return None, f"unreadable_{name}: {self.path.name}: {error.strerror or error}"
        if len(data) < self.height * self.width * kind.itemsize:
            return None, f"unreadable_{name}: {self.path.name}: cut short"
        return np.frombuffer(data, kind.base).reshape(shape), ""


def _record(height: int, width: int) -> np.dtype:
    return np.dtype([("depth", _DEPTH, (height, width)), ("color", _COLOR, (height, width))])


def matches(path: Path) -> bool:
    """Whether a path looks like this layout."""
    if path.suffix.lower() == _SUFFIX:
        return path.is_file()
    root = find_root(path)
    if root is None or not has_png_color(root):
        return False
    # With intrinsics it is ScanNet, which has the same folders
    return not any((folder / "intrinsic").is_dir() for folder in (path, root))


def read(path: Path, options: Options) -> ImageSequence:
    """Opens a folder or a `.seq` file. Raises InputError."""
    if path.is_file():
        return _read_seq(path, with_camera_file(options, path.parent))
    options = with_camera_file(options, path)
    notes = () if options.intrinsics else (f"intrinsics of {SYNTHETIC.source} assumed",)
    return read_frames(path, LAYOUT, options.intrinsics or SYNTHETIC, options, notes)


def open_seq(path: Path) -> tuple[SeqFile, tuple[str, ...]]:
    """Frames of a `.seq` file, and remarks if it is cut short. Raises InputError if it is no such file."""
    try:
        header = np.fromfile(path, _HEADER, _HEADER_FIELDS)
        size = path.stat().st_size
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    count, height, width = (int(value) for value in header) if len(header) == _HEADER_FIELDS else (0, 0, 0)
    if count <= 0 or not (0 < height <= LARGEST_SIDE and 0 < width <= LARGEST_SIDE):
        raise InputError(f"{path}: not a .seq file (frames {count}, height {height}, width {width})")
    if height * width > MOST_PIXELS:
        raise InputError(f"{path}: images of {width} x {height} pixels, at most {MOST_PIXELS} are read")
    # A recording that was cut short is read as far as it goes
    whole = min(count, (size - _OFFSET) // _record(height, width).itemsize)
    if whole < 1:
        raise InputError(f"{path}: {count} frames announced, not one is complete")
    notes = (f"{path.name}: {count} frames announced, {whole} are complete",) if whole < count else ()
    return SeqFile(path, whole, height, width), notes


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
