"""What a sequence is: frames by number, with intrinsics and, where known, true poses."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from mipsjax.core.camera import Intrinsics


class Frame(NamedTuple):
    """One RGB-D frame as the rest of the program sees it."""

    number: int
    """Number of the frame in the sequence on disk, before any selection of frames."""
    timestamp: float
    """Seconds."""
    color: UInt8[np.ndarray, "H W 3"] | None
    """RGB; None where the colour image is missing or broken."""
    depth: Float32[np.ndarray, "H W"] | None
    """z-depth in metres, 0 for no measurement; None where the depth image is missing or broken."""
    problem: str = ""
    """Why colour or depth is None, in one line; empty for a whole frame."""

    def cleaned(self) -> Frame:
        """With 0 where the depth is no distance: NaN, infinite or negative."""
        if self.depth is None:
            return self
        return self._replace(depth=np.where(np.isfinite(self.depth) & (self.depth > 0), self.depth, 0))


@runtime_checkable
class Sequence(Protocol):
    """Frames in the order of time. Colour and depth have the size of `intrinsics`."""

    name: str
    """Short name for reports, such as the folder's name."""
    layout: str
    """Name of the layout it was read from, such as `tum`."""
    intrinsics: Intrinsics
    timestamps: Float64[np.ndarray, "N"]
    """Seconds, strictly increasing."""
    T_world_cam: Float64[np.ndarray, "N 4 4"] | None
    """Ground truth, camera-to-world; rows of NaN where a pose is missing; None where there is none."""
    notes: tuple[str, ...]
    """One-line remarks for the user, such as a notice that intrinsics were rescaled."""

    def __len__(self) -> int: ...

    def __getitem__(self, position: int) -> Frame: ...
