"""A frame is offered to other submaps: where it should lie there, and what is not believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import maps
from mipsjax.config.presets import PRESETS
from mipsjax.core import tracking
from mipsjax.core.rigid import inverse
from mipsjax.core.tracking import Registration
from mipsjax.submaps.proposals import Expected, by_box, expect, sight, with_links
from mipsjax.submaps.state import SlamState

CFG = PRESETS["tiny"]
LOOP = CFG.loop
T_OLD_NEW = maps.pose((0.0, 30.0, 0.0), (1.0, 0.0, 0.5))
BENT = maps.pose((0.0, 1.0, 0.0), (0.03, 0.0, 0.0))
"""What the old submap makes of the place where the shared frame 7 is."""


@pytest.fixture
def neighbours() -> SlamState:
    """A submap begun from another at frame 3, three frames that both share, and frame 9, which only the new one has."""
    ways = {3: 0.0, 7: 0.4, 8: 0.8, 9: 0.5}
    new = [maps.keyframe(n, maps.pose(translation=(x, 0.0, 0.0))) for n, x in ways.items()]
    old = [maps.keyframe(0), *(k._replace(T_sub_cam=T_OLD_NEW @ k.T_sub_cam) for k in new[:3])]
    old[2] = new[1]._replace(T_sub_cam=T_OLD_NEW @ BENT @ new[1].T_sub_cam)
    begun = maps.submap(*new, T_world_sub=T_OLD_NEW)._replace(parent=0)
    return maps.state(maps.submap(*old), begun, active=1)


def test_the_nearest_shared_frame_says_where_one_lies_in_a_neighbour(neighbours):
    """Wherever the pose graph has put the two."""
    for T_world_old in (np.eye(4), maps.pose(translation=(0.1, 0.0, 0.0))):
        said = expect(neighbours.with_submap(0, T_world_sub=T_world_old), 0, CFG)
        newest = neighbours.submap.keyframes[-1].T_sub_cam
        np.testing.assert_allclose(said.T_sub_cam, T_OLD_NEW @ BENT @ newest, atol=1e-12)
        assert said.metres == pytest.approx(LOOP.sigma + 0.1 * LOOP.drift)
        assert said.radians == pytest.approx(LOOP.sigma_rotation + 0.1 * LOOP.drift_rotation)


@pytest.mark.parametrize("parent", [0, None])
def test_across_a_loop_the_poses_of_the_submaps_say_it_and_may_be_off_by_anything(neighbours, parent):
    """Also of a submap that was begun after the camera had been lost."""
    cfg = replace(CFG, loop=replace(LOOP, apart=1)) if parent == 0 else CFG
    T_world_old = maps.pose(translation=(0.1, 0.0, 0.0))
    state = neighbours.with_submap(0, T_world_sub=T_world_old).with_submap(1, parent=parent)
    said = expect(state, 0, cfg)
    T_world_cam = state.submap.T_world_sub @ state.submap.keyframes[-1].T_sub_cam
    np.testing.assert_allclose(said.T_sub_cam, inverse(T_world_old) @ T_world_cam, atol=1e-12)
    assert said.agrees(maps.pose((90.0, 0.0, 0.0), (9.0, 9.0, 9.0)))


def test_where_none_is_shared_a_frame_may_be_off_by_the_drift_through_the_submaps_between(neighbours):
    """A third submap, 0.6 m from the second and begun from it; what it sees is half a metre from its anchor."""
    begun = maps.pose(translation=(0.6, 0.0, 0.0))
    anchor, newest = maps.keyframe(20), maps.keyframe(21, maps.pose(translation=(0.0, 0.5, 0.0)))
    third = maps.submap(anchor, newest, T_world_sub=T_OLD_NEW @ begun)._replace(parent=1)
    second = neighbours.submap
    second = second._replace(keyframes=(*second.keyframes, anchor._replace(T_sub_cam=begun)))
    said = expect(maps.state(neighbours.submaps[0], second, third, active=2), 0, CFG)
    np.testing.assert_allclose(said.T_sub_cam, T_OLD_NEW @ begun @ newest.T_sub_cam, atol=1e-12)
    metres = 0.5 + 0.6 + np.linalg.norm(T_OLD_NEW[:3, 3])
    assert said.metres == pytest.approx(LOOP.sigma + metres * LOOP.drift)
    assert said.radians == pytest.approx(LOOP.sigma_rotation + metres * LOOP.drift_rotation)


def test_where_a_link_on_the_way_is_missing_a_frame_may_be_anywhere(neighbours):
    state = neighbours.with_submap(0, keyframes=neighbours.submaps[0].keyframes[:1])
    assert expect(state, 0, CFG).metres == expect(state, 0, CFG).radians == float("inf")


def lands(monkeypatch, *ends: np.ndarray, held: float = 1.0) -> list[np.ndarray]:
    """Every frame fits. In turn registration ends here, then always at the last of these; returns where it began."""
    began = []

    def register(field, depth, T, camera, cfg, views):
        began.append(np.asarray(T))
        return Registration(ends[min(len(began), len(ends)) - 1], np.ones(()), np.ones(()), np.float32(held))

    monkeypatch.setattr(tracking, "register", register)
    return began


@pytest.mark.parametrize(("share", "linked"), [(0.9, True), (1.1, False)])
@pytest.mark.parametrize("how", ["shifted", "turned"])
def test_a_frame_found_elsewhere_in_a_neighbour_is_not_linked(neighbours, monkeypatch, how, share, linked):
    said = expect(neighbours, 0, CFG)
    turn, shift = (share * said.radians, 0.0) if how == "turned" else (0.0, share * said.metres)
    lands(monkeypatch, said.T_sub_cam @ maps.pose((0.0, np.degrees(turn), 0.0), (shift, 0.0, 0.0)))
    proposals = by_box(neighbours, CFG)
    assert [proposal.second for proposal in proposals] == [0] * linked
    assert [k.id for k in neighbours.submaps[0].keyframes] == [0, 3, 7, 8], (
        "proposals leave the state as it was"
    )
    after = with_links(neighbours, proposals)
    assert [k.id for k in after.submaps[0].keyframes] == [0, 3, 7, 8] + [9] * linked


def test_both_parts_of_a_pose_must_agree_with_what_is_expected():
    said = Expected(T_OLD_NEW, 0.02, 0.01)
    assert said.agrees(T_OLD_NEW @ maps.pose((0.0, np.degrees(0.009), 0.0), (0.019, 0.0, 0.0)))
    assert not said.agrees(T_OLD_NEW @ maps.pose(translation=(0.021, 0.0, 0.0)))
    assert not said.agrees(T_OLD_NEW @ maps.pose((0.0, np.degrees(0.011), 0.0)))


@pytest.mark.parametrize(("held", "linked"), [(2.0, True), (0.5, False)])
def test_surfaces_must_hold_a_frame_in_every_direction(neighbours, monkeypatch, held, linked):
    lands(monkeypatch, expect(neighbours, 0, CFG).T_sub_cam, held=held * LOOP.held)
    assert bool(by_box(neighbours, CFG)) is linked


@pytest.mark.parametrize(
    ("moves", "calls"), [((0.002,), 1), ((0.1, 0.104), 2), ((0.1, 0.2, 0.3, 0.4, 0.5), 4)]
)
def test_a_frame_is_registered_again_while_that_moves_it(neighbours, monkeypatch, moves, calls):
    """Across a loop the guess may be decimetres off; the rounds have an end."""
    guess = maps.pose((0.0, 30.0, 0.0), (1.0, 0.0, 0.0))
    ends = [guess @ maps.pose(translation=(x, 0.0, 0.0)) for x in moves]
    began = lands(monkeypatch, *ends)
    found = sight(neighbours, 0, neighbours.submap.keyframes[-1], Expected(guess), CFG)
    assert len(began) == calls
    for start, where in zip(began, [guess, *ends], strict=False):
        np.testing.assert_allclose(start, where, atol=1e-6)
    assert found is not None
    np.testing.assert_allclose(found.T_sub_cam, ends[calls - 1], atol=1e-6)


def test_a_frame_that_is_turned_is_registered_again_too(neighbours, monkeypatch):
    guess = maps.pose((0.0, 30.0, 0.0), (1.0, 0.0, 0.0))
    turned = guess @ maps.pose((0.0, 1.0, 0.0))
    began = lands(monkeypatch, turned)
    assert sight(neighbours, 0, neighbours.submap.keyframes[-1], Expected(guess), CFG) is not None
    np.testing.assert_allclose(began, [guess, turned], atol=1e-6)


def test_a_pose_that_is_not_finite_is_no_sighting(neighbours, monkeypatch):
    lands(monkeypatch, np.full((4, 4), np.nan))
    assert sight(neighbours, 0, neighbours.submap.keyframes[-1], Expected(np.eye(4)), CFG) is None
