"""Colour and depth images from files, with damage found before decoding.

What is wrong with one image is a reason, not an exception: `name: details` where the name is an event
such as `unreadable_depth`. OpenCV returns grey pixels for a truncated JPEG and libpng writes to stderr for
a damaged PNG, so both are checked here on the bytes first.
"""

from __future__ import annotations

import os
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Num, UInt8, UInt16

from mipsjax.errors import InputError
from mipsjax.files import read_regular

SATURATED = 65535
"""The value of a 16-bit depth image that means out of range; 0 means nothing seen."""

DEPTH_BITS = 16
MOST_PIXELS = 1 << 25
"""Of an image: more than any camera of depth has, and 100 MB of colour."""
LARGEST_FILE_BYTES = 1 << 28
"""Of an image file."""
_HEADER_BYTES = 65536
"""Enough for nearly all headers; some JPEGs carry more of thumbnails and profiles before their size."""

_STDERR = 2  # where libraries print
_ONE_AT_A_TIME = threading.Lock()  # who leads it elsewhere

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_PNG_PIXELS = frozenset({b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"})
_PNG_AROUND = 12
"""Bytes of a chunk beside its content: length, name and checksum."""
_JPEG_SIGNATURE = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_JPEG_START_OF_SCAN = 0xDA
# Among the starts of frames, C4, C8 and CC mark tables and extensions, which have no size
_JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


class ImageHeader(NamedTuple):
    """What an image file says about itself before any pixel."""

    width: int
    height: int
    bits: int
    """Bits a channel."""
    channels: int


def parse_header(data: bytes) -> ImageHeader | None:
    """Size and type from the first bytes of a PNG or JPEG; None for anything else or anything damaged."""
    header = None
    if data.startswith(_PNG_SIGNATURE):
        header = _png_header(data)
    elif data.startswith(_JPEG_SIGNATURE):
        header = _jpeg_layout(data)[0]
    return header if header and header.width > 0 and header.height > 0 else None


def read_header(path: Path) -> ImageHeader | None:
    """Size and type of an image file; None if it is missing, unreadable or neither PNG nor JPEG."""
    try:
        if not path.is_file():  # a pipe would block
            return None
        with path.open("rb") as file:
            start = file.read(_HEADER_BYTES)
            return parse_header(start) or parse_header(start + file.read(LARGEST_FILE_BYTES))
    except (OSError, ValueError):  # the name may hold a NUL
        return None


def read_color(path: Path) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
    """RGB pixels as stored, any orientation tag ignored since depth has none; or None and the reason."""
    pixels, reason = _decode(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION, "color")
    return pixels, reason


def read_raw_depth(path: Path) -> tuple[UInt16[np.ndarray, "H W"] | None, str]:
    """Depth in the units of the file, or None and the reason.

    Raises InputError for an intact image of another type: that is a wrong folder, not a damaged frame.
    """
    pixels, reason = _decode(path, cv2.IMREAD_UNCHANGED, "depth")
    if pixels is not None and (pixels.ndim != 2 or pixels.dtype != np.uint16):
        raise InputError(depth_type_message(path, pixels.dtype.itemsize * 8, pixels.shape[2:]))
    return pixels, reason


def depth_type_message(path: Path, bits: int, channels: tuple[int, ...]) -> str:
    """The message for a depth image of a wrong type; `channels` is empty for one channel."""
    found = f"{bits}-bit with {channels[0] if channels else 1} channel(s)"
    return f"{path}: depth must be 16-bit single channel, this is {found}"


def depth_to_metres(
    raw: Num[np.ndarray, "H W"], units_per_metre: float, depth_min: float, depth_max: float
) -> Float32[np.ndarray, "H W"]:
    """z-depth in metres; 0 where there is no measurement.

    The sensor's invalid codes, NaN, inf, negative values and anything outside [depth_min, depth_max]
    (metres) become 0. `units_per_metre` is the depth scale, 1 for an array in metres.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        metres = raw.astype(np.float32) / np.float32(units_per_metre)
        valid = (metres > 0) & (metres >= depth_min) & (metres <= depth_max) & (metres < np.inf)
    if np.issubdtype(raw.dtype, np.integer):
        valid &= raw != SATURATED
    return np.where(valid, metres, np.float32(0))


def _decode(path: Path, flags: int, kind: str) -> tuple[np.ndarray | None, str]:
    """Pixels, or None with `missing_<kind>: ...` or `unreadable_<kind>: ...`."""
    try:
        data = read_regular(path, LARGEST_FILE_BYTES)
    except FileNotFoundError:
        return None, f"missing_{kind}: {path.name}"
    except OSError as error:
        return None, f"unreadable_{kind}: {path.name}: {error.strerror or error}"
    return decoded(data, flags, kind, path.name)


def decoded(data: bytes, flags: int, kind: str, name: str) -> tuple[np.ndarray | None, str]:
    """Pixels of an image of `kind`, by OpenCV's `flags`, or None and `unreadable_<kind>: <name>: ...`."""
    damage = find_damage(data) or _beyond(data)
    if damage:
        return None, f"unreadable_{kind}: {name}: {damage}"
    try:
        with _silent_decoders():
            pixels = cv2.imdecode(np.frombuffer(_pixels_only(data), np.uint8), flags)
    except cv2.error:
        pixels = None
    return pixels, "" if pixels is not None else f"unreadable_{kind}: {name}: cannot be decoded"


@contextmanager
def _silent_decoders() -> Iterator[None]:
    """Leads what libjpeg prints of damaged data, past Python, to nowhere: a frame's problem is said by us."""
    with _ONE_AT_A_TIME, ExitStack() as opened:
        try:
            before = os.dup(_STDERR)
            opened.callback(os.close, before)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            opened.callback(os.close, nowhere)
        except OSError:  # closed, or no file can be opened any more: then it prints
            yield
            return
        os.dup2(nowhere, _STDERR)
        opened.callback(os.dup2, before, _STDERR)
        yield


def _beyond(data: bytes) -> str:
    """Why an image is not decoded at all: its size is known before a byte of memory is taken for its pixels."""
    header = parse_header(data)
    if header is None:
        return "neither PNG nor JPEG"
    if header.width * header.height > MOST_PIXELS:
        return f"{header.width} x {header.height} pixels, at most {MOST_PIXELS} are read"
    return ""


def find_damage(data: bytes) -> str:
    """What is visibly wrong with the bytes of an image file; empty if nothing is."""
    if not data:
        return "empty file"
    if data.startswith(_PNG_SIGNATURE):
        return _png_damage(data)
    if data.startswith(_JPEG_SIGNATURE):
        scan = _jpeg_layout(data)[1]
        # A thumbnail in the header has an end marker of its own, so only the scan is searched; inside
        # a scan the byte FF is always followed by 00 or a restart marker.
        return "" if scan and data.find(_JPEG_END, scan) >= 0 else "truncated JPEG"
    return ""


def _pixels_only(data: bytes) -> bytes:
    """A whole PNG without what is no pixel, such as colour profiles, of which libpng complains on stderr; any other
    image as it is."""
    if not data.startswith(_PNG_SIGNATURE):
        return data
    kept, at = [_PNG_SIGNATURE], len(_PNG_SIGNATURE)
    while at + _PNG_AROUND <= len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        end = at + _PNG_AROUND + length
        if data[at + 4 : at + 8] in _PNG_PIXELS:
            kept.append(data[at:end])
        at = end
    return b"".join(kept)


def _png_header(data: bytes) -> ImageHeader | None:
    if len(data) < 26 or data[12:16] != b"IHDR":
        return None
    # The first chunk: length, `IHDR`, then its content
    width, height, bits, color_type = struct.unpack(">IIBB", data[16:26])
    return ImageHeader(width, height, bits, _PNG_CHANNELS.get(color_type, 0))


def _png_damage(data: bytes) -> str:
    """Walks the chunks and compares their checksums."""
    at, end = len(_PNG_SIGNATURE), len(data)
    while at + 12 <= end:
        (length,) = struct.unpack(">I", data[at : at + 4])
        body_end = at + 8 + length
        if body_end + 4 > end:
            break
        (checksum,) = struct.unpack(">I", data[body_end : body_end + 4])
        # Of a chunk's name and content, not of its length
        if zlib.crc32(data[at + 4 : body_end]) != checksum:
            return "damaged PNG (checksum)"
        if data[at + 4 : at + 8] == b"IEND":
            return ""
        at = body_end + 4
    return "truncated PNG"


def _jpeg_layout(data: bytes) -> tuple[ImageHeader | None, int]:
    """The header of a JPEG, and where its scan begins (0 if it has none)."""
    header, at = None, len(_JPEG_SIGNATURE)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        # With its own two bytes, without those of the marker
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        if marker == _JPEG_START_OF_SCAN:
            return header, at + 2 + length
        if marker in _JPEG_SIZE_MARKERS and at + 10 <= len(data):
            bits, height, width, channels = struct.unpack(">BHHB", data[at + 4 : at + 10])
            header = ImageHeader(width, height, bits, channels)
        at += 2 + length
    return header, 0
