"""What a step says about its frame, beside the state: for a reader, nothing in the loop depends on it."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from mipsjax.slam.tracker import Tracked


class FrameInfo(NamedTuple):
    """Of one frame, for the reader of `status.csv`."""

    residual_before: float = float("nan")
    """Metres."""
    residual_after: float = float("nan")
    known: float = float("nan")
    """Share of measured pixels within 5 cm of the mapped surface, before mapping."""
    confirmed: float = float("nan")
    """The same where the map is certain."""
    moving: float = 0.0
    """Share of the measured pixels that were left out, since they show what moves."""
    surfaces: str = ""
    """Standard deviations of the pose in the six directions that surfaces hold most to least firmly, metres or rad."""
    together: str = ""
    """The same by surfaces, corners of the image and brightness."""
    free: str = ""
    """The motion that these leave most open, (v, omega) in the camera's frame."""
    searched: bool = False
    """RO was run."""
    keyframe: bool = False
    map_steps: int = 0
    submap: int = 0
    """The active one."""
    found: Literal["", "again", "nowhere"] = ""
    """A lost camera was found in the map again, or began a submap that hangs on nothing yet."""
    track_ms: float = 0.0
    map_ms: float = 0.0
    order_ms: float = 0.0
    """Of keeping the submaps in order: boxes, links, loops, a new submap."""
    checkpoint_ms: float = 0.0
    """That the program waited for a checkpoint after it."""
    world_deviation_m: float = 0.0
    """Standard deviation of where the camera was relative to where the map began, as the frame came; after a loop that
    it closed, which its status is not."""
    full: bool = False
    """Another submap would have begun with it, but for `volume.max_submaps`."""
    note: str = ""


def info_of(tracked: Tracked) -> FrameInfo:
    """What tracking alone says of a frame."""
    before, after, together = tracked.info.before, tracked.info.after, tracked.together
    return FrameInfo(
        residual_before=float(before.residual),
        residual_after=float(after.residual),
        known=float(after.known),
        confirmed=float(after.confirmed),
        moving=tracked.moving,
        surfaces=_numbers(tracked.surfaces.deviation),
        together=_numbers(together.deviation),
        free=_numbers(together.twist[-1]),
        searched=bool(tracked.info.searched),
        track_ms=tracked.ms,
    )


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.2g}" for value in values)
