"""Configuration: frozen dataclasses, presets, overrides and validation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class InputConfig:
    """What is taken from the sensor."""

    depth_min: float = 0.1
    """Metres; nearer measurements count as none."""
    depth_max: float = 8.0
    """Metres; farther measurements count as none."""
    working_width: int = 320
    """Pixels; wider images are decimated by a whole factor to about this width before anything else."""
    max_bad_frames: int = 100
    """Number of unusable frames after which a run stops with exit code 3."""
