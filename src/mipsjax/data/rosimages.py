"""Messages of ROS as images and intrinsics: `sensor_msgs/Image`, `CompressedImage` and `CameraInfo`.

Messages have the same fields in ROS 1 and 2, but for upper and lower case in `CameraInfo`.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Num, UInt8, UInt16

from mipsjax.data.calibration import Calibration
from mipsjax.data.images import (
    DEPTH_BITS,
    MOST_PIXELS,
    ImageHeader,
    decoded,
    depth_type_message,
    find_damage,
    parse_header,
)
from mipsjax.errors import InputError

RAW, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
TYPES = (RAW, COMPRESSED)
MM_PER_M = 1000.0


class Pixels(NamedTuple):
    """How the pixels of an encoding are stored."""

    type: str
    """NumPy's, without the order of bytes."""
    channels: int
    to_rgb: int | None = None
    """OpenCV's conversion; None where it is RGB, or no colour."""


_DEPTHS = {"16UC1": Pixels("u2", 1), "32FC1": Pixels("f4", 1), "mono16": Pixels("u2", 1)}
_COLORS = {
    "rgb8": Pixels("u1", 3),
    "bgr8": Pixels("u1", 3, cv2.COLOR_BGR2RGB),
    "8UC3": Pixels("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": Pixels("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": Pixels("u1", 4, cv2.COLOR_BGRA2RGB),
    "yuv422_yuy2": Pixels("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": Pixels("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuv422": Pixels("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": Pixels("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    # OpenCV names the pattern by its second row
    "bayer_rggb8": Pixels("u1", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": Pixels("u1", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": Pixels("u1", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": Pixels("u1", 1, cv2.COLOR_BayerGB2RGB),
    "mono8": Pixels("u1", 1, cv2.COLOR_GRAY2RGB),
}
_DEPTH_PNG, _DEPTH_FILE, _COLOR_FILE = "compressedDepth", "16UC1 PNG", "compressed"
COLORED = frozenset(_COLORS) - {"mono8"} | {_COLOR_FILE}
"""Encodings of what is no infrared image."""
# Before the PNG of a compressed depth image: its kind, and what whole numbers stand for if they are of floats
_DEPTH_PNG_HEADER = struct.Struct("<iff")
# OpenCV's own models of distortion, and how many numbers they have
_MODELS, _COEFFICIENTS = ("plumb_bob", "rational_polynomial", ""), (4, 5, 8, 12, 14)


def encoding(message: Any) -> str:
    """How the pixels of an image are stored; empty for no message."""
    if message is None:
        return ""
    if hasattr(message, "encoding"):
        return message.encoding
    if _DEPTH_PNG in message.format:
        return _DEPTH_PNG
    return _DEPTH_FILE if message.format.startswith("16UC1") else _COLOR_FILE


def is_depth(encoding: str, topic: str) -> bool:
    """Whether images are depth. 16 bits of grey may be infrared too: then the name of the topic decides."""
    if encoding == "mono16":
        return "depth" in topic.lower()
    return encoding in (*_DEPTHS, _DEPTH_PNG, _DEPTH_FILE)


def header(message: Any) -> ImageHeader | None:
    """Size and type; None where they are not known."""
    stored = encoding(message)
    if stored == _DEPTH_PNG:
        return parse_header(bytes(message.data[_DEPTH_PNG_HEADER.size :]))
    if stored in (_DEPTH_FILE, _COLOR_FILE):
        return parse_header(bytes(message.data))
    if not 0 < message.width * message.height <= MOST_PIXELS:
        return None
    if stored in _DEPTHS:
        return ImageHeader(message.width, message.height, DEPTH_BITS, 1)
    channels = _COLORS[stored].channels if stored in _COLORS else 0
    return ImageHeader(message.width, message.height, 8, channels)


def color(message: Any) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
    """RGB pixels, or None and why not."""
    stored = encoding(message)
    if stored == _COLOR_FILE:
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        return decoded(bytes(message.data), flags, "color", "message")
    if stored not in _COLORS:
        return None, f"unreadable_color: encoding {stored!r} is not one of {', '.join(_COLORS)}"
    pixels, problem = _pixels(message, _COLORS[stored])
    if pixels is None:
        return None, f"unreadable_color: {problem}"
    conversion = _COLORS[stored].to_rgb
    try:
        return np.ascontiguousarray(pixels) if conversion is None else cv2.cvtColor(pixels, conversion), ""
    except cv2.error:  # such as an odd width where two pixels share a colour
        return None, f"unreadable_color: {message.width} x {message.height} pixels are no {stored}"


def depth(message: Any, name: Path) -> tuple[Num[np.ndarray, "H W"] | None, str]:
    """Depth in millimetres, or None and why not. Raises InputError for an intact image that is no depth."""
    stored = encoding(message)
    if stored == _DEPTH_PNG:
        return _depth_of_png(message)
    if stored == _DEPTH_FILE:
        return _as_depth(*decoded(bytes(message.data), cv2.IMREAD_UNCHANGED, "depth", "message"))
    if stored not in _DEPTHS:
        found = header(message)
        raise InputError(depth_type_message(name, found.bits if found else 8, (3,)))
    pixels, problem = _pixels(message, _DEPTHS[stored])
    if pixels is None:
        return None, f"unreadable_depth: {problem}"
    return (MM_PER_M * pixels if pixels.dtype.kind == "f" else pixels.astype(np.uint16)), ""


def calibration(info: Any, info_topic: str, depth_topic: str) -> tuple[Calibration, tuple[str, ...]]:
    """Intrinsics by a camera info, of the rectified image where the name of the depth topic says that it is one, and
    remarks.

    Raises InputError where it was never calibrated.
    """
    # Upper case in ROS 1
    K, D, P = (np.ravel(getattr(info, name, getattr(info, name.lower(), ()))) for name in "KDP")
    image = depth_topic.removesuffix("/compressedDepth").removesuffix("/compressed").rsplit("/", 1)[-1]
    rectified = "rect" in image and len(P) == 12 and P[0] > 0
    fx, cx, fy, cy = (P[[0, 2, 5, 6]] if rectified else K[[0, 2, 4, 5]]).tolist()
    if not (np.isfinite([fx, fy, cx, cy]).all() and fx > 0 and fy > 0):
        raise InputError(f"{info_topic}: the camera was not calibrated; pass --intrinsics FX FY CX CY")
    distortion, notes = (), ()
    if not rectified and np.any(D):
        if info.distortion_model in _MODELS and len(D) in _COEFFICIENTS and np.isfinite(D).all():
            distortion = tuple(map(float, D))
        else:
            notes = (
                f"{info_topic}: distortion by {info.distortion_model!r} is not undone: rectify the images",
            )
    size = int(info.width), int(info.height)
    return Calibration(fx, fy, cx, cy, size, info_topic, distortion), notes


def _depth_of_png(message: Any) -> tuple[UInt16[np.ndarray, "H W"] | Float32[np.ndarray, "H W"] | None, str]:
    """Depth in millimetres from the PNG of `compressed_depth_image_transport`."""
    data = bytes(message.data)
    if len(data) < _DEPTH_PNG_HEADER.size:
        return None, "unreadable_depth: cut short"
    _, a, b = _DEPTH_PNG_HEADER.unpack_from(data)
    png = data[_DEPTH_PNG_HEADER.size :]
    if find_damage(png) == "" and parse_header(png) is None:
        return None, f"unreadable_depth: {message.format!r} is no PNG"
    pixels, problem = _as_depth(*decoded(png, cv2.IMREAD_UNCHANGED, "depth", "message"))
    if pixels is None or not message.format.startswith("32FC1"):
        return pixels, problem
    # Floats are stored as whole numbers of the inverse depth; 0 is none
    inverse = pixels.astype(np.float32) - np.float32(b)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(pixels > 0, MM_PER_M * np.float32(a) / inverse, np.float32(0)), ""


def _as_depth(pixels: np.ndarray | None, problem: str) -> tuple[UInt16[np.ndarray, "H W"] | None, str]:
    """What was decoded, if it is one channel of 16 bits."""
    if pixels is not None and (pixels.ndim != 2 or pixels.dtype != np.uint16):
        return None, f"unreadable_depth: {pixels.dtype} pixels of shape {pixels.shape[1::-1]} are no depth"
    return pixels, problem


def _pixels(message: Any, stored: Pixels) -> tuple[np.ndarray | None, str]:
    """The array of an image, in the order of bytes of this machine; or None and why not."""
    dtype = np.dtype(stored.type).newbyteorder(">" if message.is_bigendian else "<")
    width, height, row = message.width, message.height, message.step
    used = width * stored.channels * dtype.itemsize
    if not 0 < width * height <= MOST_PIXELS:
        return None, f"{width} x {height} pixels, 1 to {MOST_PIXELS} are read"
    if row < used or len(message.data) < row * height:
        return None, f"{len(message.data)} bytes do not hold {width} x {height} pixels"
    rows = np.asarray(message.data, np.uint8)[: row * height].reshape(height, row)[:, :used]
    pixels = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="))
    return pixels.reshape((height, width) if stored.channels == 1 else (height, width, stored.channels)), ""
