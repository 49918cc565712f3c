"""Synthetic sequences: frames rendered when asked for, with exact poses."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from mipsjax.core.camera import Intrinsics
from mipsjax.data.sequence import Frame
from mipsjax.data.synth.catalog import Spec
from mipsjax.data.synth.render import render
from mipsjax.data.synth.scene import Scene
from mipsjax.data.synth.sensor import SensorModel, measured_color, measured_depth

# Frames kept after rendering: a keyframe test or a viewer asks for recent ones again
_CACHED_FRAMES = 8
# The shutter is open for this long (seconds) around the timestamp, and so many views approximate it; odd, so
# that the middle one is at the timestamp
_EXPOSURE_S, _EXPOSURE_VIEWS = 1.0 / 60.0, 7
# First word of every frame's seed, so that other uses of the frame number draw other numbers
_SENSOR_SEED = 20231


class Degradations(NamedTuple):
    """What is done to the exact images."""

    noise: bool = False
    """Errors of a depth sensor, and colour noise."""
    blur: bool = False
    """Motion blur in colour; depth stays that of the timestamp."""


class SynthSequence:
    """Frames of a synthetic sequence, rendered on access, the same bits every time; a `Sequence`."""

    layout = "synth"

    def __init__(
        self,
        name: str,
        spec: Spec,
        degradations: Degradations,
        indices: range,
        intrinsics: Intrinsics,
        depth_range: tuple[float, float],
    ) -> None:
        """Frames `indices` of `spec`; depth in metres outside `depth_range` becomes 0."""
        self.name = name
        self.intrinsics = intrinsics
        self.fps = spec.fps
        self.notes: tuple[str, ...] = ()
        self.timestamps: Float64[np.ndarray, "N"] = np.array(indices, np.float64) / spec.fps
        self.T_world_cam: Float64[np.ndarray, "N 4 4"] | None = spec.path().poses(self.timestamps)
        self._spec, self._degradations, self._indices = spec, degradations, indices
        self._depth_range = depth_range
        self._cache: OrderedDict[int, Frame] = OrderedDict()

    @property
    def scene(self) -> Scene:
        """The exact geometry, in the world frame of the poses."""
        return self._spec.scene()

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, position: int) -> Frame:
        """The frame at a position from 0, or from the end if negative; IndexError beyond."""
        index = self._indices[position]
        if index not in self._cache:
            self._cache[index] = self._frame(index)
            if len(self._cache) > _CACHED_FRAMES:
                self._cache.popitem(last=False)
        self._cache.move_to_end(index)
        return self._cache[index]

    def _frame(self, index: int) -> Frame:
        time = index / self.fps
        image = render(self.scene, self.intrinsics, self._spec.path().poses(self._shutter(time)))
        color, depth = image.color, image.depth
        if self._degradations.noise:
            color, depth = self._measured(index, color, depth)
        low, high = self._depth_range
        usable = (depth >= low) & (depth <= high) & ~image.glass
        depth = np.where(usable, depth, np.float32(0.0))
        return Frame(number=index, timestamp=time, color=color, depth=depth)

    def _shutter(self, time: float) -> Float64[np.ndarray, "K"]:
        """Times in seconds at which light is gathered for one frame."""
        if not self._degradations.blur:
            return np.array([time])
        return time + _EXPOSURE_S * np.linspace(-0.5, 0.5, _EXPOSURE_VIEWS)

    def _measured(
        self, index: int, color: UInt8[np.ndarray, "H W 3"], depth: Float32[np.ndarray, "H W"]
    ) -> tuple[UInt8[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
        # By the frame's own number: the same noise whichever frames are chosen, in any order
        rng, model = np.random.default_rng([_SENSOR_SEED, index]), SensorModel()
        return measured_color(model, color, rng), measured_depth(model, depth, self.intrinsics, rng)
