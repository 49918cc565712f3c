"""How far hand-made submaps may be from the first: what was loose stays loose behind it, until a loop is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from maps import keyframe, pose, state, submap
from mipsjax.config.sections import Config
from mipsjax.submaps import closure
from mipsjax.submaps.astray import deviations_from_first, with_covariances
from mipsjax.submaps.closure import Judgement
from mipsjax.submaps.ids import RecordId, SubmapId
from mipsjax.submaps.state import How, Loop, SlamState
from mipsjax.uncertainty.held import NONE, OPEN, Matrix, carried

CFG = Config()
STEP = pose((0.0, 90.0, 0.0), (0.0, 0.0, 4.0))
LOOSE = np.diag([0.0, 0.0, 0.0, 0.0, 0.05, 0.0]) ** 2
"""A turn of 3 degrees about the vertical that nothing has held, about the camera."""
FAR = pose(translation=(10.0, 0.0, 0.0))


def chain(*covariances: Matrix, origin: np.ndarray | None = None) -> SlamState:
    """Submaps begun from each other, each at a frame of the one before with such a covariance about its camera."""
    T, made = np.eye(4) if origin is None else origin, []
    for place in range(len(covariances) + 1):
        keyframes = [keyframe(place)]
        if place < len(covariances):
            keyframes.append(keyframe(place + 1, STEP)._replace(covariance=carried(covariances[place], STEP)))
        made.append(submap(*keyframes, T_world_sub=T)._replace(parent=place - 1 if place else None))
        T = T @ STEP
    return with_covariances(state(*made, active=len(covariances)), CFG)


def test_behind_a_turn_that_nothing_held_all_is_as_far_off_as_it_leads():
    given = chain(NONE, LOOSE, NONE)
    metres, radians = deviations_from_first(given, 1, NONE, np.eye(4))
    assert metres < 1e-3 and radians < 1e-3
    for submap_id, arm in ((2, 0.0), (3, 4.0)):
        metres, radians = deviations_from_first(given, submap_id, NONE, np.eye(4))
        assert metres == pytest.approx(0.05 * arm, abs=2e-3) and radians == pytest.approx(0.05, rel=1e-2)
    # Held as firmly as can be in its submap, and yet half a metre off
    assert deviations_from_first(given, 2, NONE, FAR)[0] == pytest.approx(0.5, rel=1e-2)


def test_what_a_frame_is_off_by_in_its_submap_is_added():
    given, own = chain(LOOSE), np.diag([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]) ** 2
    metres, _ = deviations_from_first(given, 1, own, FAR)
    assert metres == pytest.approx(np.hypot(0.5, 0.3), rel=1e-2)
    assert deviations_from_first(given, 0, own, FAR)[0] == pytest.approx(0.3, rel=1e-2)


def test_where_the_world_begins_changes_nothing():
    given = chain(LOOSE, LOOSE)
    moved = chain(LOOSE, LOOSE, origin=pose((10.0, 20.0, 30.0), (4e5, -5e6, 300.0)))
    expected = deviations_from_first(given, 2, LOOSE, FAR)
    assert deviations_from_first(moved, 2, LOOSE, FAR) == pytest.approx(expected, rel=1e-4)


def closed(given: SlamState, j: int, k: int, number: int = 9) -> SlamState:
    """With one more frame, that two submaps share where they lie; the camera of the second is at its anchor."""
    T_j_cam = np.linalg.inv(given.submaps[j].T_world_sub) @ given.submaps[k].T_world_sub
    for place, T in ((j, T_j_cam), (k, np.eye(4))):
        given = given.with_submap(place, keyframes=(*given.submaps[place].keyframes, keyframe(number, T)))
    return given


def off(given: SlamState, submap_id: int) -> float:
    """Metres by which the anchor of a submap may be off."""
    return deviations_from_first(given, SubmapId(submap_id), NONE, np.eye(4))[0]


REGISTERED = 1.01 * CFG.loop.sigma * np.sqrt(3)


def test_a_loop_takes_it_back_to_what_registration_may_be_off_by():
    given = chain(LOOSE, NONE, NONE, NONE)
    after = with_covariances(closed(given, 0, 4), CFG)
    assert off(given, 4) > 0.2 and off(given, 3) > 0.2
    assert off(after, 4) < REGISTERED
    # And the other way round from there
    assert off(after, 3) < off(after, 4) + 0.005 * 4 + 1e-3 < off(given, 3)


def test_what_submaps_have_in_common_does_not_shrink_with_their_number():
    """A stretch of the first submap that nothing held, behind which each of the others was found again."""
    given = chain(LOOSE, NONE, NONE, NONE)
    behind = given.submaps[0].keyframes[-1].covariance
    for k in (2, 3, 4):
        given = closed(given, 0, k, number=10 + k)
        *known, found = given.submaps[0].keyframes
        given = given.with_submap(0, keyframes=(*known, found._replace(covariance=behind)))
    after = with_covariances(given, CFG)
    for k in (2, 3, 4):
        assert off(after, k) >= 0.999 * off(chain(LOOSE, NONE, NONE, NONE), k)


@pytest.mark.parametrize("why", ["rejected", "no loops wanted", "taken apart"])
def test_a_loop_that_moved_nothing_takes_nothing_back(why):
    given, cfg = closed(chain(LOOSE, NONE, NONE, NONE), 0, 4), CFG
    kept = Loop(RecordId(9), SubmapId(4), SubmapId(0), How.BOX, 0.9, 0.0, 0.0, weight=1.0)
    assert off(with_covariances(given._replace(loops=(kept._replace(weight=0.0), kept)), cfg), 4) < REGISTERED
    if why == "rejected":
        given = given._replace(loops=(kept, kept._replace(weight=0.0)))
    elif why == "no loops wanted":
        cfg = replace(CFG, loop=replace(CFG.loop, enabled=False))
    else:
        known = with_covariances(given, cfg)
        poses = tuple(one.T_world_sub for one in known.submaps)
        judgement = Judgement((), ((SubmapId(0), RecordId(9)),), poses, ())
        given = closure.commit(known, judgement, cfg)
        assert off(given, 4) > 0.2
    assert off(with_covariances(given, cfg), 4) > 0.2


def test_a_submap_that_hangs_on_nothing_may_be_anywhere():
    given = with_covariances(state(submap(keyframe(0)), submap(keyframe(5)), submap(keyframe(7))), CFG)
    assert off(given, 1) >= OPEN and off(given, 2) >= OPEN


def test_numbers_of_any_size_are_borne():
    huge = 1e16 * np.ones((6, 6))
    assert off(chain(huge, LOOSE), 2) > 1e6
    nonsense = chain(np.full((6, 6), np.nan), LOOSE)
    assert not off(nonsense, 2) <= CFG.track.held.unsure
