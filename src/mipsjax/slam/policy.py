"""The decisions of the host loop: a few numbers of a frame in, what to do with it out. Plain Python."""

from __future__ import annotations

from math import log
from typing import NamedTuple

from mipsjax.config.sections import Config
from mipsjax.submaps.state import Status


class FrameStats(NamedTuple):
    """What is known of a tracked frame."""

    finite: bool
    measured: float
    """Share of pixels with depth, 0..1."""
    known: float
    """Share of measured pixels within KeyframeConfig.error of the mapped surface, 0..1."""
    confirmed: float
    """The same where the map is certain."""
    open: float
    """Standard deviation, metres or rad, along the direction that measurements hold least."""
    astray: float
    """Metres, standard deviation of where the camera is relative to where the map began, after all that led there."""
    residual: float
    """Metres."""
    least_residual: float
    """Of late; 0 for the first tracked frame."""
    unsure: bool
    """The frame before was lost or skipped."""
    lost: int
    """Frames before it that were lost, in a row but for skipped ones; `guard.lost_frames` where they were more."""
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

    @property
    def said(self) -> str:
        """In words, how a lost frame fits the map."""
        residual_mm = 1e3 * self.residual
        return f"known {self.known:.2f}, confirmed {self.confirmed:.2f}, residual {residual_mm:.0f} mm"


class Decision(NamedTuple):
    """What is done with it."""

    status: Status
    keyframe: bool
    map_steps: int
    pose_rate: float
    """Share of the pose learning rate in local bundle adjustment."""
    in_trouble: bool
    """The frame was lost, or is hardly held or known: the next search is to be wider."""
    informative: bool
    """Its motion and residual say something about the frames to come."""


def decide(stats: FrameStats, cfg: Config) -> Decision:
    """Status, keyframe and mapping effort of one tracked frame."""
    # The next search is wider for what this frame shows, not for how far the camera may be astray
    status, in_trouble = _status(stats, cfg), _is_weak(stats, cfg)
    if status is Status.LOST or _is_sparse(stats, cfg):
        return Decision(
            status, keyframe=False, map_steps=0, pose_rate=0.0, in_trouble=True, informative=False
        )
    share = _motion_share(stats, cfg)
    return Decision(
        status,
        keyframe=_is_keyframe(stats, cfg),
        map_steps=round(_between(cfg.map.steps_slow, cfg.map.steps, share)),
        pose_rate=_between(cfg.map.pose_rate_slow, 1.0, share),
        in_trouble=in_trouble,
        informative=True,
    )


def widening(frames_in_trouble: int, cfg: Config) -> float:
    """Factor on the radii of the search after so many frames in a row that were lost or hardly held or known."""
    factor, limit = cfg.track.ro.widening, cfg.track.ro.widening_limit
    # By logarithms: the power itself would overflow over a long blind stretch
    overflows = frames_in_trouble * log(factor) >= log(limit)
    return limit if overflows else factor**frames_in_trouble


def converged(residual: float, cfg: Config) -> float:
    """Metres; the residual above which RO is needed, where the least of trusted frames is `residual`."""
    ro = cfg.track.ro
    return min(max(ro.residual, ro.residual_margin * residual), 2 * ro.residual)


def _status(stats: FrameStats, cfg: Config) -> Status:
    guard = cfg.guard
    unknown = stats.known < guard.lost or stats.confirmed < guard.confirmed
    limit = max(_allowed(stats, cfg), guard.noise * stats.least_residual)
    # As long as there is no least residual nobody knows the sensor's noise
    misfit = stats.residual > limit and stats.least_residual > 0
    if not stats.finite or unknown or misfit:
        return Status.LOST
    near = stats.astray <= cfg.track.held.unsure  # not so either where it is not finite
    return Status.OK if near and not _is_weak(stats, cfg) else Status.WEAK


def _is_weak(stats: FrameStats, cfg: Config) -> bool:
    """Whether this frame by itself is."""
    held = stats.open <= cfg.track.held.weak
    return stats.known < cfg.guard.weak or not held or _is_sparse(stats, cfg)


def _allowed(stats: FrameStats, cfg: Config) -> float:
    """Metres of residual: what fits somewhere after a loss may be another place, even more so after a long one."""
    if cfg.loop.relocalise and stats.lost >= cfg.guard.lost_frames:
        return cfg.guard.residual_lost
    return cfg.guard.residual_unsure if stats.unsure else cfg.guard.residual


def _is_sparse(stats: FrameStats, cfg: Config) -> bool:
    return stats.measured < cfg.guard.measured


def _is_keyframe(stats: FrameStats, cfg: Config) -> bool:
    if stats.since_keyframe < cfg.keyframe.every_frames:
        return False
    moved = stats.translation > cfg.keyframe.translation or stats.rotation > cfg.keyframe.rotation
    # By what is known as in the paper, by motion beside it
    return moved or stats.known < cfg.keyframe.known


def _motion_share(stats: FrameStats, cfg: Config) -> float:
    """How fast the camera moves, 0 for a still one to 1 for one that deserves all effort."""
    return min(1.0, max(stats.step_translation, stats.step_rotation) / cfg.map.motion)


def _between(slow: float, fast: float, share: float) -> float:
    return slow + share * (fast - slow)
