"""The decisions of the host loop: a few numbers of a frame in, what to do with it out. Plain Python."""

from __future__ import annotations

from enum import StrEnum
from math import log
from typing import NamedTuple

from mipsjax.config import Config


class Status(StrEnum):
    """How far a frame's pose can be trusted."""

    OK = "ok"
    WEAK = "weak"
    """Mapped, but the next search is wider."""
    LOST = "lost"
    """Not mapped; its pose is the motion prior's."""
    SKIPPED = "skipped"
    """No usable image; its pose is the motion prior's."""


class FrameStats(NamedTuple):
    """What is known of a tracked frame."""

    finite: bool
    known: float
    """Share of measured pixels within KeyframeConfig.error of the mapped surface, 0..1."""
    since_keyframe: int
    """Processed frames since the last keyframe."""
    translation: float
    """Metres from the last keyframe."""
    rotation: float
    """Radians from the last keyframe."""
    step_translation: float
    """Metres from the last frame."""
    step_rotation: float
    """Radians from the last frame."""


class Decision(NamedTuple):
    """What is done with it."""

    status: Status
    keyframe: bool
    map_steps: int


def decide(stats: FrameStats, cfg: Config) -> Decision:
    """Status, keyframe and mapping effort of one tracked frame."""
    status = _status(stats, cfg)
    if status is Status.LOST:
        return Decision(status, keyframe=False, map_steps=0)
    return Decision(status, _is_keyframe(stats, cfg), _map_steps(stats, cfg))


def widening(trouble: int, cfg: Config) -> float:
    """Factor on the radii of the search after `trouble` weak or lost frames in a row."""
    factor, limit = cfg.track.ro.widening, cfg.track.ro.widening_limit
    # By logarithms: the power itself would overflow over a long blind stretch.
    return limit if trouble * log(factor) >= log(limit) else factor**trouble


def _status(stats: FrameStats, cfg: Config) -> Status:
    if not stats.finite or stats.known < cfg.guard.lost:
        return Status.LOST
    return Status.WEAK if stats.known < cfg.guard.weak else Status.OK


def _is_keyframe(stats: FrameStats, cfg: Config) -> bool:
    if stats.since_keyframe < cfg.keyframe.every_frames:
        return False
    moved = stats.translation > cfg.keyframe.translation or stats.rotation > cfg.keyframe.rotation
    return moved or stats.known < cfg.keyframe.known


def _map_steps(stats: FrameStats, cfg: Config) -> int:
    share = min(1.0, max(stats.step_translation, stats.step_rotation) / cfg.map.motion)
    return round(cfg.map.steps_slow + share * (cfg.map.steps - cfg.map.steps_slow))
