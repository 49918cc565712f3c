"""The one implementation of `Sequence` behind all readers: lazy images, sizes, undistortion, decimation."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int, Num, UInt8

from mipsjax.config.sections import InputConfig
from mipsjax.core.camera import Intrinsics
from mipsjax.data.association import sort_stamps
from mipsjax.data.calibration import Calibration, DepthScale, Size, resolve_intrinsics, same_aspect
from mipsjax.data.framefiles import FrameSource
from mipsjax.data.images import DEPTH_BITS, ImageHeader, depth_to_metres, depth_type_message
from mipsjax.data.sequence import Frame
from mipsjax.data.suspicion import suspicions_of_view
from mipsjax.errors import InputError

PROBES = 15
"""Images whose headers are read on opening; odd, so that two sizes cannot tie."""


class Maps(NamedTuple):
    """Where each pixel of the undistorted image is found in the original one."""

    x: Float32[np.ndarray, "H W"]
    y: Float32[np.ndarray, "H W"]


class Shape(NamedTuple):
    """How raw images become the images of the sequence."""

    color_size: Size
    """Size of the colour images on disk."""
    depth_size: Size
    """Size of the depth images on disk; colour is resampled to it."""
    maps: Maps | None
    """Undistortion at the depth size; None where there is nothing to undo."""
    every_px: int
    """Decimation: the sequence has every such pixel of the depth image."""


@dataclass(eq=False)
class ImageSequence:
    """A sequence of image files (or of one binary file), read frame by frame when asked for.

    It implements `Sequence`. A frame that cannot be read comes with None and a `problem`; reading a frame
    raises IndexError only.
    """

    name: str
    layout: str
    intrinsics: Intrinsics
    """Of the images that frames contain, after decimation."""
    timestamps: Float64[np.ndarray, "N"]
    """Seconds, strictly increasing."""
    T_world_cam: Float64[np.ndarray, "N 4 4"] | None
    """Ground truth, camera-to-world; rows of NaN where a pose is missing; None where there is none."""
    notes: tuple[str, ...]
    """One-line remarks for the user."""
    source: FrameSource = field(repr=False)
    """Raw images by place."""
    positions: Int[np.ndarray, "N"] = field(repr=False)
    """Place of each frame in the source."""
    numbers: Int[np.ndarray, "N"] = field(repr=False)
    """Number of each frame before any selection of frames."""
    shape: Shape = field(repr=False)
    calibration: Calibration
    """Intrinsics as they were given."""
    depth_scale: DepthScale
    input: InputConfig
    """Range of depth and working width."""

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, position: int) -> Frame:
        place = int(self.positions[position])
        color, color_problem = self._color(place)
        raw, depth_problem = self._raw_depth(place)
        depth = None
        if raw is not None:
            units = self.depth_scale.units_per_metre
            depth = depth_to_metres(raw, units, self.input.depth_min, self.input.depth_max)
        problem = "; ".join(filter(None, (color_problem, depth_problem)))
        return Frame(int(self.numbers[position]), float(self.timestamps[position]), color, depth, problem)

    def unclipped_depth(self, position: int) -> Float32[np.ndarray, "H W"] | None:
        """Depth in metres without the range of the config, to judge the depth scale; None if unreadable."""
        raw, _ = self._raw_depth(int(self.positions[position]))
        units = self.depth_scale.units_per_metre
        return None if raw is None else depth_to_metres(raw, units, 0.0, float("inf"))

    def files(self, position: int) -> tuple[Path, ...]:
        """Those that a frame is read from."""
        return self.source.files(int(self.positions[position]))

    def select(self, frames: slice) -> ImageSequence:
        """The frames of a slice; they keep their numbers. Nothing is read."""
        poses = None if self.T_world_cam is None else self.T_world_cam[frames]
        return replace(
            self,
            timestamps=self.timestamps[frames],
            T_world_cam=poses,
            positions=self.positions[frames],
            numbers=self.numbers[frames],
        )

    def with_notes(self, notes: tuple[str, ...]) -> ImageSequence:
        """The same sequence with more remarks."""
        return replace(self, notes=self.notes + notes)

    def _color(self, place: int) -> tuple[UInt8[np.ndarray, "H W 3"] | None, str]:
        color, problem = self.source.color(place)
        if color is None:
            return None, problem
        if _size(color) != self.shape.color_size:
            return None, _wrong_size("color", _size(color), self.shape.color_size)
        return shape_color(color, self.shape), ""

    def _raw_depth(self, place: int) -> tuple[Num[np.ndarray, "H W"] | None, str]:
        try:
            depth, problem = self.source.raw_depth(place)
        except InputError as error:
            # A single frame of another type is a bad frame; where most are, opening was refused
            return None, f"unreadable_depth: {error}"
        if depth is None:
            return None, problem
        if _size(depth) != self.shape.depth_size:
            return None, _wrong_size("depth", _size(depth), self.shape.depth_size)
        return shape_depth(depth, self.shape), ""


def image_sequence(
    *,
    name: str,
    layout: str,
    source: FrameSource,
    timestamps: Float64[np.ndarray, "N"],
    T_world_cam: Float64[np.ndarray, "N 4 4"] | None,
    calibration: Calibration,
    depth_scale: DepthScale,
    input: InputConfig,
    notes: tuple[str, ...] = (),
) -> ImageSequence:
    """Puts a sequence together from what a reader found.

    `T_world_cam` without a single known pose counts as none. Raises InputError if no depth image is
    readable, depth is not 16-bit with one channel, or sizes and intrinsics cannot belong together.
    """
    order, order_notes = sort_stamps(timestamps, name)
    depth_size = _depth_size(source)
    color_size, size_notes = _color_size(source, depth_size)
    native, intrinsics_notes = resolve_intrinsics(calibration, color_size, depth_size)
    view_notes = suspicions_of_view(native, calibration.source)
    every_px = max(1, round(depth_size[0] / input.working_width))
    if T_world_cam is not None and not np.isfinite(T_world_cam).any():
        T_world_cam = None
    return ImageSequence(
        name=name,
        layout=layout,
        intrinsics=native.decimated(every_px),
        timestamps=timestamps[order],
        T_world_cam=None if T_world_cam is None else T_world_cam[order],
        notes=notes + order_notes + size_notes + intrinsics_notes + view_notes,
        source=source,
        positions=order,
        # Counted in the order of time, before any selection
        numbers=np.arange(len(order)),
        shape=Shape(color_size, depth_size, undistortion_maps(native, calibration.distortion), every_px),
        calibration=calibration,
        depth_scale=depth_scale,
        input=input,
    )


def undistortion_maps(intrinsics: Intrinsics, distortion: tuple[float, ...]) -> Maps | None:
    """Maps to an image with the same intrinsics and no distortion; None if there is none to undo."""
    if not any(distortion):
        return None
    fx, fy, cx, cy, width, height = intrinsics
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    maps = cv2.initUndistortRectifyMap(
        matrix, np.array(distortion), np.eye(3), matrix, (width, height), cv2.CV_32FC1
    )
    return Maps(np.asarray(maps[0], np.float32), np.asarray(maps[1], np.float32))


def shape_color(color: UInt8[np.ndarray, "H W 3"], shape: Shape) -> UInt8[np.ndarray, "h w 3"]:
    """Resampled to the depth size, undistorted, decimated; consistent with the intrinsics to sub-pixels."""
    # First, since maps and decimation are for the size of the depth
    if shape.color_size != shape.depth_size:
        # Means of areas where it shrinks, against aliasing
        shrinks = shape.depth_size[0] < shape.color_size[0]
        color = cv2.resize(
            color, shape.depth_size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        )
    if shape.maps is not None:
        color = cv2.remap(color, shape.maps.x, shape.maps.y, cv2.INTER_LINEAR)
    return decimate_color(color, shape.every_px)


def shape_depth(depth: Num[np.ndarray, "H W"], shape: Shape) -> Num[np.ndarray, "h w"]:
    """Undistorted and decimated by choosing pixels: a mean over an edge would be a point in the air."""
    if shape.maps is not None:
        depth = cv2.remap(depth, shape.maps.x, shape.maps.y, cv2.INTER_NEAREST)
    return np.ascontiguousarray(depth[:: shape.every_px, :: shape.every_px])


def decimate_color(color: UInt8[np.ndarray, "H W 3"], every_px: int) -> UInt8[np.ndarray, "h w 3"]:
    """Every pixel of that step after a blur against aliasing, centred on the pixel that stays.

    A mean of `every_px` x `every_px` blocks would lie (every_px - 1) / 2 pixels off `Intrinsics.decimated`.
    The tent of width 2 every_px - 1, which is that mean applied twice, is symmetric about the pixel.
    """
    if every_px == 1:
        return color
    box = np.full(every_px, 1 / every_px)
    tent = np.convolve(box, box)
    blurred = cv2.sepFilter2D(color, -1, tent, tent, borderType=cv2.BORDER_REFLECT_101)
    return np.ascontiguousarray(blurred[::every_px, ::every_px])


def _depth_size(source: FrameSource) -> Size:
    """The usual size of depth images, from a few headers. Raises InputError."""
    if not len(source):
        raise InputError("the sequence has no frames")
    headers = _probe(source.depth_header, len(source))
    if not headers:
        raise InputError(f"no depth image can be read; the first is {source.depth_name(0)}")
    wrong = {place: head for place, head in headers.items() if (head.bits, head.channels) != (DEPTH_BITS, 1)}
    if len(wrong) > len(headers) / 2:
        place, head = next(iter(wrong.items()))
        raise InputError(depth_type_message(source.depth_name(place), head.bits, (head.channels,)))
    return _usual_size([head for place, head in headers.items() if place not in wrong])


def _color_size(source: FrameSource, depth_size: Size) -> tuple[Size, tuple[str, ...]]:
    """The usual size of colour images and a remark where it differs. Raises InputError on another aspect."""
    headers = _probe(source.color_header, len(source))
    if not headers:
        return depth_size, ("no colour image can be read: depth only",)
    size = _usual_size(list(headers.values()))
    if size == depth_size:
        return size, ()
    texts = f"{size[0]} x {size[1]}", f"{depth_size[0]} x {depth_size[1]}"
    if not same_aspect(size, depth_size):
        raise InputError(f"colour is {texts[0]} and depth {texts[1]}: not the same view, register them first")
    return size, (f"colour resampled from {texts[0]} to the depth's {texts[1]}",)


def _probe(header_of: Callable[[int], ImageHeader | None], count: int) -> dict[int, ImageHeader]:
    """Headers of a few frames over the whole sequence, or else of the first frame that has one."""
    spread = sorted({int(place) for place in np.linspace(0, count - 1, min(PROBES, count))})
    found = {place: head for place in spread if (head := header_of(place)) is not None}
    if found:
        return found
    anywhere = ((place, header_of(place)) for place in range(count))
    return next(({place: head} for place, head in anywhere if head is not None), {})


def _usual_size(headers: list[ImageHeader]) -> Size:
    sizes = Counter((head.width, head.height) for head in headers)
    return sizes.most_common(1)[0][0]


def _size(image: np.ndarray) -> Size:
    return image.shape[1], image.shape[0]


def _wrong_size(kind: str, found: Size, expected: Size) -> str:
    return f"wrong_size: {kind} is {found[0]} x {found[1]}, the sequence {expected[0]} x {expected[1]}"
