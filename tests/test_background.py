"""Which inactive submap is refined when."""

from __future__ import annotations

from dataclasses import replace

from mipsjax.background import turn
from mipsjax.config import Config
from mipsjax.config_submaps import BackgroundConfig

CFG = replace(Config(), background=BackgroundConfig(every_frames=4, steps=10))


def test_every_inactive_submap_has_its_turn():
    turns = [turn(frame, 1, 4, CFG) for frame in range(0, 24, 4)]
    assert turns == [(0,), (2,), (3,), (0,), (2,), (3,)]
    assert all(turn(frame, 1, 4, CFG) == () for frame in range(24) if frame % 4)


def test_several_at_once_as_soon_as_there_are_so_many():
    both = replace(CFG, background=replace(CFG.background, together=2))
    assert turn(4, 0, 2, both) == (1,)
    assert [turn(frame, 1, 4, both) for frame in (4, 8, 12)] == [(3, 0), (2, 3), (0, 2)]


def test_nothing_to_refine():
    assert turn(4, 0, 1, CFG) == (), "the active one alone"
    off = replace(CFG, background=BackgroundConfig(every_frames=0))
    assert turn(4, 0, 3, off) == ()
    assert turn(4, 0, 3, replace(CFG, background=BackgroundConfig(steps=0))) == ()
