"""Which submap takes over, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

import maps
from mipsjax.config.presets import PRESETS
from mipsjax.core import mapping
from mipsjax.images.features import Features
from mipsjax.loops.registration import MIN_INLIERS
from mipsjax.slam import recovery
from mipsjax.submaps import switching
from mipsjax.submaps.astray import deviations_from_first
from mipsjax.submaps.proposals import Sighting, proposed, with_links
from mipsjax.submaps.state import How, SlamState
from mipsjax.submaps.switching import FULL, NEW, NOT_FINITE, STAY, enter, govern
from mipsjax.uncertainty.held import OPEN

CFG = PRESETS["tiny"]
NEWEST = maps.pose(translation=(0.5, 0.0, 0.0))


@pytest.fixture(scope="module")
def state() -> SlamState:
    """Two submaps; the newest keyframe of the second, which is active, has not been looked for in the first."""
    learned = mapping.create(jax.random.key(0), CFG)
    old = maps.submap(maps.keyframe(0), learned=learned)
    new = maps.submap(maps.keyframe(3), maps.keyframe(9, NEWEST), learned=learned)
    return maps.state(old, new._replace(parent=0), active=1)


def fits_not(monkeypatch, module) -> None:
    """Every first fit ends in numbers that are not finite."""
    real = module.begin
    short = replace(CFG, map=replace(CFG.map, submap_steps=1))

    def begin(anchor, support, T_world_sub, steps, camera, cfg):
        submap, _ = real(anchor, support, T_world_sub, 1, camera, short)
        return submap, False

    monkeypatch.setattr(module, "begin", begin)


def test_a_submap_takes_over_only_if_the_frame_was_found_in_it(state):
    """Whatever its box holds."""
    newest = state.submap.keyframes[-1]
    narrow = state.submap.box._replace(hi=np.full(3, -2.9))
    state = state.with_submap(1, box=narrow)
    found = proposed(state, 1, newest, Sighting(0, NEWEST, 0.9), How.BOX)
    assert govern(state, [found], CFG) == 0
    assert govern(state, [], CFG) == govern(with_links(state, [found]), [], CFG) == NEW
    assert govern(state.with_submap(1, box=state.submaps[0].box), [found], CFG) == STAY


def test_a_new_submap_that_is_not_finite_is_not_entered(state, monkeypatch):
    fits_not(monkeypatch, switching)
    after, problem = enter(state, NEW, CFG)
    assert after is state and problem == NOT_FINITE


LOOSE = np.diag([0.0, 0.0, 0.0, 0.0, 0.05, 0.0]) ** 2
SEEN = Features(np.zeros((MIN_INLIERS, 64), np.uint8), np.zeros((MIN_INLIERS, 3), np.float32), maps.DEPTH)
SHORT = replace(CFG, map=replace(CFG.map, submap_steps=1))


def test_a_new_submap_is_as_far_off_as_the_frame_that_it_is_begun_at(state):
    *before, newest = state.submap.keyframes
    loose = state.with_submap(1, keyframes=(*before, newest._replace(covariance=LOOSE)), covariance=LOOSE)
    after, problem = enter(loose, NEW, SHORT)
    assert not problem and after.submap.parent == 1
    np.testing.assert_allclose(after.submap.covariance, 2 * LOOSE, atol=1e-12)


def test_a_submap_of_a_lost_camera_may_be_anywhere(state):
    found, problem = recovery.start_anew(state, maps.keyframe(10)._replace(features=SEEN), SHORT)
    assert found is not None and not problem
    metres, _ = deviations_from_first(found.state, found.submap, found.covariance, found.T_sub_cam)
    assert metres >= OPEN


def test_a_lost_camera_begins_no_submap_that_nothing_could_join(state):
    bare = maps.keyframe(10)
    few = SEEN._replace(p_cam=SEEN.p_cam[: MIN_INLIERS - 1])
    for keyframe in (bare, bare._replace(features=few)):
        assert recovery.start_anew(state, keyframe, SHORT) == (None, recovery.BLANK)


def test_a_lost_camera_begins_no_submap_that_is_not_finite(state, monkeypatch):
    fits_not(monkeypatch, recovery)
    assert recovery.start_anew(state, maps.keyframe(10)._replace(features=SEEN), CFG) == (None, NOT_FINITE)


@pytest.mark.fault(50)
def test_no_more_submaps_begin_than_may(state):
    many = replace(CFG, volume=replace(CFG.volume, max_submaps=len(state.submaps) + 1))
    full = replace(CFG, volume=replace(CFG.volume, max_submaps=len(state.submaps)))
    short = replace(SHORT, volume=full.volume)
    assert not switching.full(state, CFG) and not switching.full(state, many)
    after, problem = enter(state, NEW, short)
    assert after is state and problem == FULL
    assert recovery.start_anew(state, maps.keyframe(10)._replace(features=SEEN), short) == (None, FULL)


def test_steps_on_the_shared_frame_that_are_not_finite_are_reported(state, monkeypatch):
    """The old submap is entered as it was."""
    newest = state.submap.keyframes[-1]
    linked = with_links(state, [proposed(state, 1, newest, Sighting(0, NEWEST, 0.9), How.BOX)])
    monkeypatch.setattr(switching, "adjust_submap", lambda submap, *_: (submap, False))
    after, problem = enter(linked, 0, CFG)
    assert after.active == 0 and problem == switching.REVISIT_NOT_FINITE
    assert after.submap.keyframes == linked.submaps[0].keyframes
    assert after.records[-1].submap == 0 and after.records[-1].keyframe == newest.id
