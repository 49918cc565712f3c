"""Shared frames of hand-made submaps: what they measure, and which submaps they connect."""

from __future__ import annotations

import numpy as np
import pytest

from maps import keyframe, pose, state, submap
from mipsjax.config.sections import Config
from mipsjax.core.rigid import inverse
from mipsjax.submaps import links
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import Submap, world_pose

CFG = Config()
INF = float("inf")


def test_a_shared_frame_measures_one_submap_in_the_other():
    T_first_second = pose((5.0, -20.0, 3.0), (1.0, 0.2, -0.5))
    T_second_cam = pose((0.0, 40.0, 0.0), (0.3, 0.0, 2.0))
    first = submap(keyframe(0), keyframe(7, T_first_second @ T_second_cam))
    second = submap(keyframe(7, T_second_cam), keyframe(9))
    (found,) = links.links(first, second)
    np.testing.assert_allclose(found.T_first_second, T_first_second, atol=1e-12)
    (back,) = links.links(second, first)
    np.testing.assert_allclose(back.T_first_second, np.linalg.inv(T_first_second), atol=1e-12)


def test_along_the_chain_the_best_link_is_nearest_to_both_anchors():
    near, far = pose(translation=(0.5, 0.0, 0.0)), pose(translation=(0.0, 0.0, 4.0))
    first = submap(keyframe(0), keyframe(1, far), keyframe(2, near), keyframe(3, near))
    second = submap(keyframe(1, near), keyframe(2, far), keyframe(3, near))
    best = links.best_link(first, second, True, CFG)
    assert best is not None and best.first.id == 3
    assert best.reach == pytest.approx(np.hypot(0.5, 0.5))
    assert links.best_link(first, submap(keyframe(8)), True, CFG) is None
    assert links.best_link(first, submap(keyframe(8)), False, CFG) is None


def meeting(*off: np.ndarray) -> tuple[Submap, Submap]:
    """Frames of a straight way that two submaps share, each registered this far off in the first."""
    T_first_second, count = pose((5.0, -20.0, 3.0), (1.0, 0.2, -0.5)), len(off)
    second = [keyframe(n, pose(translation=(0.2 * n, 0.0, 0.0))) for n in range(count)]
    first = [
        k._replace(T_sub_cam=T_first_second @ k.T_sub_cam @ by) for k, by in zip(second, off, strict=True)
    ]
    return submap(*first), submap(*second)


def test_elsewhere_the_best_link_is_the_one_that_the_others_agree_with():
    """The first of a loop was found 8 cm and a degree off; the one nearest to both anchors is that one."""
    bad, slight = pose((0.0, 1.0, 0.0), (0.08, 0.0, 0.0)), pose(translation=(0.004, 0.0, 0.0))
    pair = meeting(bad, slight, np.eye(4), inverse(slight))
    best = links.best_link(*pair, False, CFG)
    assert best is not None and best.first.id == 2
    bad_first, *agreeing = links.disagreement(links.links(*pair), CFG)
    assert bad_first > 5 and max(agreeing) < 1


@pytest.mark.parametrize("bad", [pose(translation=(0.3, 0.0, 0.0)), pose((0.0, 1.0, 0.0), (0.0, 0.0, 0.08))])
def test_of_two_links_the_newer_is_the_best(bad):
    """Neither speaks for the other. Wherever it stands: a submap's first keyframes are stored newest first."""
    first, second = meeting(bad, np.eye(4))
    for keyframes in (first.keyframes, first.keyframes[::-1]):
        best = links.best_link(first._replace(keyframes=keyframes), second, False, CFG)
        assert best is not None and best.first.id == 1


def test_disagreement_is_in_standard_deviations_at_the_frames():
    """A link that is turned puts frames wrong by the more the farther they are from its own."""
    turned = pose((0.0, np.degrees(CFG.loop.sigma_rotation), 0.0))
    off = links.disagreement(links.links(*meeting(turned, np.eye(4), np.eye(4))), CFG)
    shift = 2 * 0.2 * np.sin(CFG.loop.sigma_rotation / 2) / CFG.loop.sigma
    assert off[0] == pytest.approx(np.hypot(1, shift), rel=1e-3)
    np.testing.assert_allclose(off[1:], 0, atol=1e-5)  # an angle from its cosine is good to 1e-8 rad at best


def test_pairs_that_share_a_frame():
    given = state(submap(keyframe(0), keyframe(1), keyframe(20)), submap(keyframe(1)), submap(keyframe(20)))
    assert links.linked_pairs(given) == [(0, 1), (0, 2)]


def test_the_chain_is_made_of_submaps_begun_from_each_other():
    """0 - 1 - 2 - 3, another 4 from 1, and 5 on its own; a frame that 0 and 3 share is no step."""
    parents = [None, 0, 1, 2, 1, None]
    made = [submap(keyframe(place))._replace(parent=parent) for place, parent in enumerate(parents)]
    made[0], made[3] = (made[i]._replace(keyframes=(keyframe(i), keyframe(20))) for i in (0, 3))
    given = state(*made)
    ways = {
        (0, 3): [0, 1, 2, 3],
        (3, 4): [3, 2, 1, 4],
        (2, 0): [2, 1, 0],
        (2, 2): [2],
        (5, 3): [],
        (3, 5): [],
    }
    for (start, end), way in ways.items():
        assert links.chain(given, start, end) == way
    assert links.chain_distances(given, 0) == [0, 1, 2, 3, 2, INF]
    assert links.chain_distances(given, 3) == [3, 2, 1, 0, 3, INF]
    assert links.chain_distances(given, 5) == [INF] * 5 + [0]


def test_submaps_are_joined_by_shared_frames_also_across_others():
    given = state(
        submap(keyframe(0)), submap(keyframe(5)), submap(keyframe(0), keyframe(7)), submap(keyframe(7))
    )
    assert links.joined(given, 0) == links.joined(given, 3) == {0, 2, 3}
    assert links.joined(given, 1) == {1}


def test_doubt_grows_with_the_way_from_the_anchors():
    cfg = Config()
    at_anchor = links.Link(keyframe(0), keyframe(0))
    turn, shift = links.sigmas(at_anchor, cfg)
    assert (turn, shift) == (cfg.loop.sigma_rotation, cfg.loop.sigma)
    away = links.Link(keyframe(0, pose(translation=(3.0, 0.0, 4.0))), keyframe(0))
    farther = links.sigmas(away, cfg)
    assert farther[1] == pytest.approx(np.hypot(cfg.loop.sigma, 5 * cfg.loop.drift))
    assert farther[0] == pytest.approx(np.hypot(cfg.loop.sigma_rotation, 5 * cfg.loop.drift_rotation))


def test_what_is_loose_in_a_submap_is_loose_in_a_link():
    """A frame that may have slid along x, seen from a second submap that is turned: the slide is along its z."""
    slid = np.diag([0.1, 0, 0, 0, 0, 0.0]) ** 2
    T_first_second = pose((0.0, 90.0, 0.0), (1.0, 0.0, 2.0))
    T_second_cam = pose((0.0, 10.0, 0.0), (0.3, 0.2, 0.1))
    link = links.Link(
        keyframe(0, T_first_second @ T_second_cam)._replace(covariance=slid), keyframe(0, T_second_cam)
    )
    found = links.loose(link)
    expected = np.zeros((6, 6))
    expected[5, 5] = (links.LOOSE * 0.1) ** 2  # rotation first
    np.testing.assert_allclose(found, expected, atol=1e-12)
    # The measurement that is meant: an error of the frame's pose there moves it so
    off = np.eye(4)
    off[0, 3] = 0.1
    wrong = links.Link(link.first._replace(T_sub_cam=off @ link.first.T_sub_cam), link.second)
    moved = np.linalg.inv(link.T_first_second) @ wrong.T_first_second
    np.testing.assert_allclose(np.abs(moved[:3, 3]), [0, 0, 0.1], atol=1e-12)


def test_misfit_is_between_world_poses():
    T_cam = pose((0.0, 10.0, 0.0), (0.1, 0.0, 0.2))
    moved = pose(translation=(0.03, 0.0, 0.0))
    given = state(submap(keyframe(5, T_cam)), submap(keyframe(5), T_world_sub=moved @ T_cam))
    (link,) = links.links(*given.submaps)
    assert links.misfit(given, 0, 1, link) == pytest.approx((0.03, 0), abs=1e-7)
    turned = given.with_submap(1, T_world_sub=T_cam @ pose((0.0, 0.0, 2.0)))
    assert links.misfit(turned, 0, 1, link) == pytest.approx((0, np.radians(2.0)), rel=1e-4)


def test_a_frame_is_unlinked_and_the_others_hang_where_they_hung():
    given = state(
        submap(keyframe(0), keyframe(5), keyframe(9, pose(translation=(1.0, 0.0, 0.0)))), submap(keyframe(5))
    )
    hung = given.records[0]._replace(keyframe=9)
    hanging = (hung, hung._replace(keyframe=0), hung._replace(submap=1, keyframe=5))
    given = given._replace(records=Records.of(hanging))
    without = links.unlinked(given, 0, 5)
    assert [k.id for k in without.submaps[0].keyframes] == [0, 9]
    assert without.records is given.records, "deleting a keyframe renumbers nothing"
    assert [world_pose(without, r).tolist() for r in without.records] == [
        world_pose(given, r).tolist() for r in given.records
    ]


def test_anchors_and_keyframes_that_frames_hang_on_stay():
    given = state(submap(keyframe(0), keyframe(5)))
    assert links.unlinked(given, 0, 0) is given
    assert links.unlinked(given, 0, 7) == given
    hung = given._replace(records=Records.of([given.records[0]._replace(keyframe=5)]))
    assert links.unlinked(hung, 0, 5) is hung
