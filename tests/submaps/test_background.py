"""Which inactive submap is refined when, and several in one call."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import maps
from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import Config
from mipsjax.config.submaps import BackgroundConfig
from mipsjax.core import mapping
from mipsjax.submaps.background import refined, turn
from mipsjax.submaps.state import Refinement, Submap

pytestmark = pytest.mark.slow

CFG = replace(Config(), background=BackgroundConfig(every_frames=4, steps=10))


def test_every_inactive_submap_has_its_turn():
    turns = [turn(frame, 1, 4, CFG) for frame in range(0, 24, 4)]
    assert turns == [(0,), (2,), (3,), (0,), (2,), (3,)]
    assert all(turn(frame, 1, 4, CFG) == () for frame in range(24) if frame % 4)


def test_several_in_one_call_as_soon_as_there_are_so_many():
    both = replace(CFG, background=replace(CFG.background, together=2))
    assert turn(4, 0, 2, both) == (1,)
    assert [turn(frame, 1, 4, both) for frame in (4, 8, 12)] == [(3, 0), (2, 3), (0, 2)]


def test_nothing_to_refine():
    assert turn(4, 0, 1, CFG) == (), "the active one alone"
    off = replace(CFG, background=BackgroundConfig(every_frames=0))
    assert turn(4, 0, 3, off) == ()
    assert turn(4, 0, 3, replace(CFG, background=BackgroundConfig(steps=0))) == ()


def test_several_in_one_call_become_what_they_become_one_by_one():
    cfg = replace(PRESETS["tiny"], background=BackgroundConfig(steps=5, pose_rate=1.0))
    submaps = tuple(tilted(seed) for seed in (1, 2))
    together = refined(Refinement((3, 5), submaps, 40), maps.CAMERA, cfg)
    alone = [
        refined(Refinement((place,), (submap,), 40), maps.CAMERA, cfg)[0]
        for submap, place in zip(submaps, (3, 5), strict=True)
    ]
    for before, one, other in zip(submaps, together, alone, strict=True):
        for a, b in zip(jax.tree.leaves(one.learned), jax.tree.leaves(other.learned), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
        poses = [np.stack([k.T_sub_cam for k in submap.keyframes]) for submap in (before, one, other)]
        np.testing.assert_array_equal(poses[1], poses[2])
        np.testing.assert_array_equal(poses[1][0], np.eye(4))
        assert np.abs(poses[1][1:] - poses[0][1:]).max() > 1e-4, "nothing moved"


@pytest.mark.parametrize("count", [1, 2])
def test_at_no_rate_nothing_is_learned(count: int):
    cfg = replace(PRESETS["tiny"], background=BackgroundConfig(steps=5, rate=0.0))
    submaps = tuple(tilted(seed) for seed in range(1, 1 + count))
    refinement = Refinement(tuple(range(count)), submaps, 40)
    for before, after in zip(submaps, refined(refinement, maps.CAMERA, cfg), strict=True):
        for a, b in zip(*(jax.tree.leaves(s.learned.field) for s in (before, after)), strict=True):
            np.testing.assert_array_equal(a, b)


def tilted(seed: int) -> Submap:
    """A submap that knows nothing, with views of a wall that is not parallel to the image."""
    slope = np.linspace(0, seed, maps.DEPTH.shape[1], dtype=np.float32)
    views = [maps.keyframe(i, maps.pose((0, i, 0)))._replace(depth=maps.DEPTH + slope) for i in range(3)]
    return maps.submap(*views, learned=mapping.create(jax.random.key(seed), PRESETS["tiny"]))
