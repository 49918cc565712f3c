"""Which inactive submap is refined when."""

from __future__ import annotations

from dataclasses import replace

from mipsjax.background import job
from mipsjax.config import BackgroundConfig, Config

CFG = replace(Config(), background=BackgroundConfig(every_frames=4, steps=10))


def test_every_inactive_submap_has_its_turn():
    turns = [job(frame, 1, 4, CFG) for frame in range(0, 24, 4)]
    assert turns == [0, 2, 3, 0, 2, 3]
    assert all(job(frame, 1, 4, CFG) is None for frame in range(24) if frame % 4)


def test_nothing_to_refine():
    assert job(4, 0, 1, CFG) is None, "the active one alone"
    off = replace(CFG, background=BackgroundConfig(every_frames=0))
    assert job(4, 0, 3, off) is None
    assert job(4, 0, 3, replace(CFG, background=BackgroundConfig(steps=0))) is None
