"""What frames, records and submaps are called by. An id names the same thing for the whole run, whatever is added or
deleted; a position in a list does not."""

from __future__ import annotations

from typing import NewType

FrameId = NewType("FrameId", int)
"""Number of a frame in the sequence on disk. Numbers are left out where only every n-th frame is processed."""

RecordId = NewType("RecordId", int)
"""Index of a processed frame in `SlamState.records`; also the id of the keyframe that was made of the frame."""

SubmapId = NewType("SubmapId", int)
"""Index of a submap in `SlamState.submaps`. Submaps are never deleted."""
