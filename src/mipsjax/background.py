"""Refinement of the submaps that the camera is not in, one after the other (Section 3.5 of the paper)."""

from __future__ import annotations

from mipsjax.bundle import BACKGROUND, choose, refine
from mipsjax.config import Config
from mipsjax.state import SlamState


def job(frame: int, active: int, submaps: int, cfg: Config) -> int | None:
    """The submap that is refined after a frame, if any: each inactive one in turn."""
    every = cfg.background.every_frames
    inactive = [place for place in range(submaps) if place != active]
    if not every or not cfg.background.steps or not inactive or frame % every:
        return None
    return inactive[frame // every % len(inactive)]


def refine_inactive(state: SlamState, cfg: Config) -> SlamState:
    """Local bundle adjustment of one inactive submap on its anchor and random keyframes, if it is time for it."""
    number = len(state.records)
    place = job(number, state.active, len(state.submaps), cfg)
    if place is None:
        return state
    submap, work = state.submaps[place], cfg.background
    chosen = choose(submap, cfg.map.frames - 1, (cfg.seed, BACKGROUND, number))
    submap, _ = refine(submap, chosen, work.pose_rate, work.steps, number, state.camera, cfg)
    return state.with_submap(place, **submap._asdict())
