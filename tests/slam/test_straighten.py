"""Keyframes measured against each other: drift within submaps goes, and what hangs together stays together."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest

from mipsjax.config.sections import Config, PairConfig
from mipsjax.config.tracking import BrightnessConfig, CornerConfig, TrackConfig
from mipsjax.core.mapping import Learned
from mipsjax.core.rigid import distance, inverse
from mipsjax.core.volume import Box
from mipsjax.data.sequence import Frame
from mipsjax.slam import straighten
from mipsjax.slam.landmarks import corners_of
from mipsjax.slam.straighten import straightened
from mipsjax.submaps.bundle import make_keyframe
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import (
    Keyframe,
    Pose,
    Record,
    SlamState,
    Status,
    Submap,
    world_pose,
)
from mipsjax.uncertainty.trust import ALLOWED_TRACKED, Differing, trusted
from painted import CAMERA, painting, pose, wall

CFG = replace(Config(), pairs=PairConfig(pixels=2304))
COUNT = 7
PATH = [pose((0, 1.5 * i, 0), (0.06 * i, 0.01 * i, 0)) for i in range(COUNT)]
"""True poses in the world, which is the frame of the painted wall."""
DRIFT = pose((0, 0.25, 0.1), (0.01, -0.005, 0.004))
"""Of each keyframe against the one before."""
CHANGE = 4
"""The keyframe with which the second submap was begun."""
EXACT_M, EXACT_RAD = 0.002, 0.001
"""A tenth of a pixel is 0.7 mm, as in tests/host/test_corners.py; of a chain of six."""


def drifted() -> list[Pose]:
    out = [PATH[0]]
    for before, after in pairwise(PATH):
        out.append(out[-1] @ inverse(before) @ after @ DRIFT)
    return out


def keyframe(number: int, T_sub_cam: Pose, corners: bool = True) -> Keyframe:
    grey, depth = wall(PATH[number], PAINTED)
    frame = Frame(number, number / 30, np.repeat(grey[..., None], 3, axis=2), depth)
    made = make_keyframe(frame, number, T_sub_cam, CFG, CAMERA)
    return made._replace(corners=corners_of(frame, number, CAMERA, CFG)) if corners else made


PAINTED = painting()


def submap(numbers: list[int], world: list[Pose], corners: bool, parent: int | None) -> Submap:
    T_world_sub = world[numbers[0]]
    keyframes = tuple(keyframe(n, inverse(T_world_sub) @ world[n], corners) for n in numbers)
    nothing = Learned((), ())  # pyright: ignore[reportArgumentType]
    return Submap(nothing, Box(np.full(3, -3.0), np.full(3, 3.0)), keyframes, T_world_sub, parent)


def travelled(world: list[Pose], corners: bool = True) -> SlamState:
    """Two submaps that share the keyframe `CHANGE` and the one before it."""
    first = submap(list(range(CHANGE + 1)), world, corners, None)
    second = submap([CHANGE, CHANGE - 1, *range(CHANGE + 1, COUNT)], world, corners, 0)
    records = []
    for number in range(COUNT):
        place = int(number >= CHANGE)
        records.append(Record(number, number / 30, place, number, np.eye(4), Status.OK))
    return SlamState((first, second), 1, Records.of(records), CAMERA, 0)


def worst(state: SlamState) -> tuple[float, float]:
    """Metres and radians by which a frame is off in the world."""
    off = [distance(T, world_pose(state, record)) for T, record in zip(PATH, state.records, strict=True)]
    return max(metres for metres, _ in off), max(radians for _, radians in off)


@pytest.fixture(scope="module")
def found() -> tuple[SlamState, float]:
    return straightened(travelled(drifted()), CFG)


def test_drift_goes_also_from_one_submap_to_the_next(found):
    state, trust = found
    before = worst(travelled(drifted()))
    assert before[0] > 0.05 and before[1] > 0.02
    metres, radians = worst(state)
    assert metres < EXACT_M and radians < EXACT_RAD
    assert trust == 1.0


def test_a_keyframe_of_two_submaps_is_at_one_place(found):
    state, _ = found
    first, second = state.submaps
    for number in (CHANGE - 1, CHANGE):
        one, other = (
            s.T_world_sub @ next(k.T_sub_cam for k in s.keyframes if k.id == number) for s in (first, second)
        )
        np.testing.assert_allclose(one, other, atol=1e-12)
    for s in state.submaps:
        np.testing.assert_allclose(s.keyframes[0].T_sub_cam, np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(first.T_world_sub, PATH[0])


def test_true_poses_stay():
    state, _ = straightened(travelled(PATH), CFG)
    metres, radians = worst(state)
    assert metres < EXACT_M and radians < EXACT_RAD


def test_without_colour_surfaces_say_what_they_can():
    """A wall holds the distance to it and two turns; the rest stays as it was."""
    none = replace(
        CFG, track=TrackConfig(corners=CornerConfig(count=0), brightness=BrightnessConfig(weight=0.0))
    )
    drift, (state, trust) = drifted(), straightened(travelled(drifted(), corners=False), none)
    assert trust == 1.0
    off = np.array([world_pose(state, r)[2, 3] - T[2, 3] for r, T in zip(state.records, PATH, strict=True)])
    before = np.array([T[2, 3] - true[2, 3] for T, true in zip(drift, PATH, strict=True)])
    assert np.abs(before).max() > 5 * EXACT_M and np.abs(off).max() < EXACT_M
    along = [world_pose(state, r)[0, 3] - T[0, 3] for r, T in zip(state.records, drift, strict=True)]
    # Turns that are taken back move what lies beside them, by at most the drift's 0.03 rad of the way walked
    assert np.abs(along).max() < 0.02


def test_one_pair_that_is_wrong_is_outvoted(monkeypatch):
    from mipsjax.slam import straighten

    real = straighten._measured

    def spoiled(*arguments):
        said = real(*arguments)
        T = np.array(said.T_first_second)
        T[3] = T[3] @ pose((5, 0, 0), (0.5, 0, 0))
        return said._replace(T_first_second=T)

    monkeypatch.setattr(straighten, "_measured", spoiled)
    metres, _ = worst(straightened(travelled(drifted()), CFG)[0])
    # Of half a metre: by the Cauchy weight it pulls as much as six deviations of one pair would
    assert metres < 3 * EXACT_M


def test_a_loop_stays_closed_where_its_keyframes_are_too_far_apart_for_a_pair():
    """The last keyframe was registered in the first submap; what lies between slid by half a metre in one place."""
    tracked = [*PATH[:CHANGE], *(pose((0, 0, 0), (0.5, 0, 0)) @ T for T in PATH[CHANGE:])]
    state = travelled(tracked, corners=False)
    first, second = state.submaps
    seen = keyframe(COUNT - 1, PATH[COUNT - 1], corners=False)
    state = state._replace(submaps=(first, second._replace(parent=None))).with_submap(
        0, keyframes=(*first.keyframes, seen)
    )
    surfaces = replace(
        CFG,
        pairs=replace(CFG.pairs, before=2, others=1, oldest=0),
        track=TrackConfig(corners=CornerConfig(count=0), brightness=BrightnessConfig(weight=0.0)),
    )
    moved, _ = straightened(state, surfaces)
    metres, _ = distance(PATH[COUNT - 1], world_pose(moved, moved.records[-1]))
    assert distance(PATH[COUNT - 1], tracked[-1])[0] > 0.4 and metres < 0.1


def test_a_submap_that_nothing_joins_stays_and_so_does_a_run_that_wants_no_pairs():
    state = travelled(drifted())
    lonely = submap([5, 6], drifted(), True, None)._replace(T_world_sub=pose((0, 90, 0), (9, 0, 0)))
    apart = state._replace(submaps=(state.submaps[0], lonely))
    moved, _ = straightened(apart, CFG)
    assert moved.submaps[1] is lonely and moved.submaps[0] is not state.submaps[0]
    off = replace(CFG, pairs=PairConfig(before=0, others=0, oldest=0))
    assert straightened(state, off) == (state, 1.0)


def test_keyframes_that_are_measured_once_stay_as_tracked():
    state = travelled(drifted())
    first = state.submaps[0]._replace(keyframes=state.submaps[0].keyframes[:2])
    few = state._replace(submaps=(first,), records=Records.of(state.records[:2]), active=0)
    assert straightened(few, CFG) == (few, 1.0)


def test_pairs_that_say_nothing_of_colour_leave_the_trust_that_tracking_found(monkeypatch):
    monkeypatch.setattr(straighten, "of_pair", lambda *_: None)
    differing = Differing(np.full(6, 100.0), np.ones(6))
    state = travelled(drifted())._replace(doubts=(differing,) * 20)
    assert straightened(state, CFG)[1] == trusted(state.doubts, ALLOWED_TRACKED) < 0.1


@pytest.mark.parametrize("worst", [-1e-4, 0.0, np.nan])
def test_a_pair_that_rounding_leaves_without_a_covariance_is_left_out(worst, monkeypatch):
    real = straighten.relative.measure

    def measure(*arguments):
        found = jax.device_get(real(*arguments))
        surfaces, colour = np.array(found.surfaces), np.zeros_like(found.colour)
        surfaces[0] = np.diag([worst, 1e3, 1e3, 1e3, 1e3, 1e3])
        surfaces[1:] += found.colour[1:]
        return found._replace(surfaces=surfaces, colour=colour)

    monkeypatch.setattr(straighten.relative, "measure", measure)
    moved, _ = straightened(travelled(drifted()), CFG)
    assert all(np.isfinite(world_pose(moved, record)).all() for record in moved.records)


def test_a_keyframe_that_sees_nothing_of_the_others_stays_beside_the_one_before():
    state = travelled(drifted())
    blank = wall(PATH[COUNT - 1], np.full_like(PAINTED, 128))
    frame = Frame(COUNT - 1, 0.2, np.repeat(blank[0][..., None], 3, axis=2), np.zeros_like(blank[1]))
    last = state.submap.keyframes[-1]
    empty = make_keyframe(frame, last.id, last.T_sub_cam, CFG, CAMERA)
    empty = empty._replace(corners=corners_of(frame, last.id, CAMERA, CFG))
    state = state.with_submap(1, keyframes=(*state.submap.keyframes[:-1], empty))
    moved, _ = straightened(state, CFG)
    (one, other), (before, after) = (
        [s.T_world_sub @ k.T_sub_cam for k in s.keyframes[-2:]] for s in (state.submap, moved.submap)
    )
    np.testing.assert_allclose(inverse(before) @ after, inverse(one) @ other, atol=1e-4)
