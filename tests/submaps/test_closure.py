"""The pose graph of hand-made submaps, whose networks know nothing: shared frames alone."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import numpy as np
import pytest

from maps import keyframe, pose, state, submap
from mipsjax.app.outputs import loops_content
from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import Config
from mipsjax.core import mapping
from mipsjax.core.rigid import distance
from mipsjax.images.features import Features
from mipsjax.submaps import closure
from mipsjax.submaps.closure import Judgement, rejected_keyframes, solve
from mipsjax.submaps.proposals import Sighting, proposed
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import How, Loop, SlamState

CFG = PRESETS["tiny"]
COUNT = 6
STEP = pose((0.0, 360.0 / COUNT, 0.0), (2.0, 0.0, 1.0))
"""From one submap of a ring to the next."""
DRIFT = pose((0.5, -0.5, 0.5), (0.03, 0.02, -0.02))
T_LAST_CAM = pose((0.0, 5.0, 0.0), (0.1, 0.0, 0.1))
"""Where frame 100, which closes the ring, is in the last submap."""
ELSEWHERE = pose((0.0, 80.0, 10.0), (2.0, 1.0, -1.0))


@pytest.fixture(scope="module")
def chain() -> tuple[SlamState, list[np.ndarray]]:
    """Six submaps, each tied to the next, that drift at every step, and the true poses; the first is the world."""
    learned = mapping.create(jax.random.key(0), CFG)
    truth, drifted = [np.eye(4)], [np.eye(4)]
    for _ in range(COUNT - 1):
        truth.append(truth[-1] @ STEP)
        drifted.append(drifted[-1] @ STEP @ DRIFT)
    made = []
    for place in range(COUNT):
        shared = [keyframe(place + 1, STEP @ DRIFT)] if place < COUNT - 1 else []
        new = submap(keyframe(place), *shared, T_world_sub=drifted[place], learned=learned)
        made.append(new._replace(parent=place - 1 if place else None))
    return state(*made, active=COUNT - 1), truth


@pytest.fixture(scope="module")
def ring(chain) -> tuple[SlamState, list[np.ndarray]]:
    """The chain, and frame 100 that closes it exactly."""
    given, truth = chain
    return closing(given, 0, COUNT - 1, 100, truth[-1] @ T_LAST_CAM, T_LAST_CAM), truth


def closing(given: SlamState, j: int, k: int, number: int, T_j_cam, T_k_cam) -> SlamState:
    """With one more frame that two submaps share."""
    for place, T in ((j, T_j_cam), (k, T_k_cam)):
        keyframes = (*given.submaps[place].keyframes, keyframe(number, T))
        given = given.with_submap(place, keyframes=keyframes)
    return given


def without_rejected(given: SlamState, weights) -> SlamState:
    """Without the keyframes of rejected pairs, all else as it is."""
    poses = tuple(s.T_world_sub for s in given.submaps)
    dropped = tuple(rejected_keyframes(given, weights))
    return closure.commit(given, Judgement((), dropped, poses, given.loops), CFG)


def close(given: SlamState, sightings: list[Sighting], cfg: Config = CFG) -> SlamState:
    """After the newest keyframe was found in submaps by their boxes."""
    newest = given.submap.keyframes[-1]
    proposals = [proposed(given, given.active, newest, sighting, How.BOX) for sighting in sightings]
    return closure.commit(given, closure.judge(given, proposals, cfg), cfg)


def off(given: SlamState, truth: list[np.ndarray]) -> float:
    """Metres by which the last submap is away from its true place."""
    return distance(given.submaps[-1].T_world_sub, truth[-1])[0]


def test_a_loop_takes_the_drift_away(ring):
    given, truth = ring
    before = off(given, truth)
    assert before > 0.1
    solved, weights = solve(given, CFG)
    assert weights[0, COUNT - 1] == 1
    assert off(solved, truth) < 0.1 * before  # the rest is what the loop's own sigma leaves to the chain
    np.testing.assert_array_equal(solved.submaps[0].T_world_sub, np.eye(4))
    for old, new in zip(given.submaps, solved.submaps, strict=True):
        assert old.learned is new.learned and old.keyframes is new.keyframes, "submaps move as a whole"


def test_a_false_loop_is_rejected_and_the_true_one_kept(ring):
    given, truth = ring
    wrong = closing(given, 1, 4, 200, ELSEWHERE, np.eye(4))
    solved, weights = solve(wrong, CFG)
    assert weights[0, COUNT - 1] == 1 and weights[1, 4] == 0
    assert off(solved, truth) < 0.1 * off(given, truth)


def test_shared_frames_of_a_rejected_pair_are_dropped_where_they_were_not_tracked(ring):
    given, _ = ring
    wrong = closing(given, 1, 4, 200, ELSEWHERE, np.eye(4))
    tracked = [given.records[0]._replace(submap=4 if number == 200 else COUNT - 1) for number in range(201)]
    solved, weights = solve(wrong._replace(records=Records.of(tracked)), CFG)
    kept = [[k.id for k in submap.keyframes] for submap in without_rejected(solved, weights).submaps]
    before = [[k.id for k in submap.keyframes] for submap in given.submaps]
    before[4].append(200)
    assert kept == before


def test_a_frame_that_began_a_submap_stays_where_it_was_tracked(ring):
    """It hangs on the new submap since, and ties it to the one before."""
    given, _ = ring
    number = given.submaps[4].keyframes[0].id
    wrong = given.with_submap(
        1, keyframes=(*given.submaps[1].keyframes, keyframe(number, pose((0.0, 80.0, 0.0))))
    )
    after = without_rejected(tracked_in(wrong, 3, 4, since=number), {(1, 3): 0.0, (1, 4): 0.0})
    assert [s.keyframes for s in after.submaps] == [s.keyframes for s in given.submaps]


def test_a_frame_with_which_an_old_submap_took_over_stays_where_it_was_tracked(ring):
    given, _ = ring
    tied = closing(given, 3, 5, 200, np.eye(4), np.eye(4))
    wrong = tied.with_submap(1, keyframes=(*tied.submaps[1].keyframes, keyframe(200, pose((0.0, 80.0, 0.0)))))
    after = without_rejected(tracked_in(wrong, 5, 3, since=200), {(1, 3): 0.0, (1, 5): 0.0})
    assert [s.keyframes for s in after.submaps] == [s.keyframes for s in tied.submaps]


def tracked_in(given: SlamState, before: int, after: int, since: int) -> SlamState:
    """With 201 frames, which hang on one submap, and since one of them on another."""
    records = (given.records[0]._replace(submap=after if n >= since else before) for n in range(201))
    return given._replace(records=Records.of(records))


def test_a_proposal_that_closes_a_false_loop_is_not_accepted(ring):
    """The frame stays a keyframe where it was tracked, and the loop is written down as rejected."""
    given, _ = ring
    before = given.with_submap(4, keyframes=(*given.submaps[4].keyframes, keyframe(200)))
    before = tracked_in(before._replace(active=4), 4, 4, since=0)
    (wrong,) = [proposed(before, 4, keyframe(200), Sighting(1, ELSEWHERE, 0.9), How.BOX)]
    judgement = closure.judge(before, [wrong], CFG)
    assert judgement.accepted == () and judgement.dropped == ()
    after = closure.commit(before, judgement, CFG)
    assert [s.keyframes for s in after.submaps] == [s.keyframes for s in before.submaps]
    assert [(loop.record, loop.first, loop.second, loop.weight) for loop in after.loops] == [(200, 4, 1, 0)]


def test_a_loop_that_was_not_judged_is_forgotten(ring, monkeypatch):
    given, _ = ring
    found = keyframe(200, given.submap.keyframes[0].T_sub_cam)
    before = given.with_submap(COUNT - 1, keyframes=(*given.submap.keyframes, found))
    alone = before.with_submap(0, keyframes=before.submaps[0].keyframes[:-1])
    monkeypatch.setattr(closure, "solve", lambda state, *_: (state, {}))
    after = close(alone, [Sighting(0, pose(), 0.9)])
    assert after.loops == ()
    assert [s.keyframes for s in after.submaps] == [s.keyframes for s in alone.submaps]


@pytest.mark.parametrize("how", How)
def test_a_loop_is_closed_and_written_down(chain, monkeypatch, how):
    given, truth = chain
    before, asked = arrived(given), []
    newest = before.submap.keyframes[-1]
    found = Sighting(0, truth[-1] @ T_LAST_CAM, 0.9)

    def recognise(state, keyframe, places, cfg) -> Sighting | None:
        asked.append(places)
        return found if how is How.FEATURES else None

    monkeypatch.setattr(closure, "recognise", recognise)
    boxes = [proposed(before, before.active, newest, found, How.BOX)] if how is How.BOX else []
    monkeypatch.setattr(closure, "by_box", lambda *_: list(boxes))
    kept = [s.keyframes for s in before.submaps]
    proposals = closure.propose(before, CFG)
    judgement = closure.judge(before, proposals, CFG)
    assert all(s.keyframes is old for s, old in zip(before.submaps, kept, strict=True))
    assert judgement.accepted == tuple(proposals) and len(proposals) == 1
    after = closure.commit(before, judgement, CFG)
    assert after.submaps[0].keyframes == (*kept[0], proposals[0].link.second)
    assert asked == [[1, 2] if how is How.BOX else [0, 1, 2]], "where a first link would be a loop"
    metres, radians = distance(given.submap.T_world_sub @ T_LAST_CAM, found.T_sub_cam)
    (loop,) = after.loops
    assert loop[:5] == (100, COUNT - 1, 0, how, 0.9) and loop.weight == 1
    # A tenth of the drift is what the loop's own sigma leaves to the chain
    assert (loop.correction_m, loop.correction_rad) == pytest.approx((metres, radians), rel=0.1)
    assert off(after, truth) < 0.1 * off(given, truth)
    (row,) = json.loads(json.dumps(loops_content(after)))["loops"]
    assert row.pop("correction_cm") == pytest.approx(100 * metres, rel=0.1)
    assert row.pop("correction_deg") == pytest.approx(np.degrees(radians), rel=0.1)
    assert row == {
        "index": 200,
        "timestamp": 10.0,
        "submaps": [COUNT - 1, 0],
        "how": str(how),
        "inliers": 0.9,
        "weight": 1,
    }


def test_older_loops_are_judged_again(chain):
    """One that was kept can turn out false. One that was rejected stays so, and one without frames what it was."""
    given, truth = chain
    wrong = closing(given, 1, 4, 50, ELSEWHERE, np.eye(4))
    # Also in the next submap, where tracking would vouch for it, had it not made a loop
    wrong = wrong.with_submap(3, keyframes=(*wrong.submaps[3].keyframes, keyframe(50, STEP @ DRIFT)))
    kept = Loop(50, 4, 1, How.BOX, 0.9, 0.0, 0.0, weight=1.0)
    rejected = kept._replace(first=COUNT - 1, second=0, weight=0.0)
    bare = kept._replace(first=COUNT - 1, second=2)
    before = arrived(wrong._replace(loops=(kept, rejected, bare)))
    found = Sighting(0, truth[-1] @ T_LAST_CAM, 0.9)
    after = close(before, [found])
    assert [row["weight"] for row in loops_content(after)["loops"]] == [0, 0, 1, 1]
    assert [loop.record for loop in after.loops] == [50, 50, 50, 100]
    assert off(after, truth) < 0.1 * off(given, truth)
    assert 50 not in {k.id for k in after.submaps[1].keyframes}


def test_after_the_last_frame_the_graph_is_solved_by_all_that_submaps_share(ring):
    """Also without a frame that disagrees: here the first that closed the ring was found 30 cm off."""
    given, truth = ring
    wrong = closing(given, 0, COUNT - 1, 99, truth[-1] @ pose(translation=(0.3, 0.0, 0.0)), np.eye(4))
    late = closing(wrong, 0, COUNT - 1, 101, truth[-1], np.eye(4))
    loop = Loop(99, COUNT - 1, 0, How.BOX, 0.9, 0.0, 0.0, weight=1.0)
    after = closure.closed_again(late._replace(loops=(loop,)), CFG)
    assert off(after, truth) < 0.1 * off(given, truth)
    assert after.loops == (loop,)


def test_where_nothing_was_judged_after_the_last_frame_all_stays(ring, monkeypatch):
    given, _ = ring
    loop = Loop(100, COUNT - 1, 0, How.BOX, 0.9, 0.0, 0.0, weight=1.0)
    monkeypatch.setattr(closure, "solve", lambda state, cfg: (state, {}))
    assert closure.closed_again(given._replace(loops=(loop,)), CFG) == given._replace(loops=(loop,))


def test_after_the_last_frame_a_false_loop_is_rejected_too(ring):
    given, truth = ring
    wrong = closing(given, 1, 4, 50, ELSEWHERE, np.eye(4))
    kept = Loop(50, 4, 1, How.BOX, 0.9, 0.0, 0.0, weight=1.0)
    tracked = [given.records[0]._replace(submap=4) for _ in range(51)]
    after = closure.closed_again(wrong._replace(records=Records.of(tracked), loops=(kept,)), CFG)
    assert [loop.weight for loop in after.loops] == [0]
    assert 50 not in {k.id for k in after.submaps[1].keyframes}
    assert off(after, truth) < 0.1 * off(given, truth)


@pytest.mark.parametrize("why", ["a chain", "no loops wanted"])
def test_after_the_last_frame_nothing_moves(chain, ring, why):
    """Where each submap is held by the one that it was begun from alone, or no loop is to be closed."""
    given = (chain if why == "a chain" else ring)[0]
    cfg = CFG if why == "a chain" else replace(CFG, loop=replace(CFG.loop, enabled=False))
    assert closure.closed_again(given, cfg) == given


def arrived(given: SlamState) -> SlamState:
    """With frame 100 as the newest keyframe of the last submap; of every second frame of a sequence at 20 Hz."""
    keyframes = (*given.submap.keyframes, keyframe(100, T_LAST_CAM))
    hung = given.records[0]._replace(submap=given.active)
    records = [hung._replace(frame=2 * n, timestamp=n / 10) for n in range(101)]
    records[-1] = records[-1]._replace(keyframe=100)
    return given.with_submap(given.active, keyframes=keyframes)._replace(records=Records.of(records))


def test_after_the_last_frame_all_keyframes_are_looked_up_once_more(chain, monkeypatch):
    """A loop that nobody saw while the camera moved is closed then, by a few keyframes and not by all."""
    given, truth = chain
    given = arrived(given)
    *before, last = given.submap.keyframes
    none = Features(np.zeros((0, 64), np.uint8), np.zeros((0, 3), np.float32), np.zeros((1, 1), np.float32))
    seen = [last._replace(id=n, features=none) for n in range(90, 101)]
    given = given.with_submap(given.active, keyframes=(*before, *seen))
    asked, known = [], {k.id for k in given.submaps[0].keyframes}

    def recognise(state, keyframe, places, cfg):
        asked.append(places)
        # Neighbours look alike: one that was linked a moment ago would vouch for the next
        assert {k.id for k in state.submaps[0].keyframes} == known
        return Sighting(0, truth[-1] @ T_LAST_CAM, 0.9) if 0 in places else None

    monkeypatch.setattr(closure, "recognise", recognise)
    after = closure.closed_again(given, CFG)
    assert off(after, truth) < 0.1 * off(given, truth)
    assert [(loop.record, loop.first, loop.second, loop.how) for loop in after.loops] == [
        (number, COUNT - 1, 0, How.FEATURES) for number in (90, 91, 92)
    ]
    assert all(loop.weight == 1 for loop in after.loops)
    assert 0 not in asked[-1] and COUNT - 2 not in asked[0], "neighbours are no loops"


def test_neighbours_along_the_chain_are_never_rejected(ring):
    """However wrong: tracking had brought the camera there."""
    given, _ = ring
    wrong = closing(given, 1, 3, 200, ELSEWHERE, np.eye(4))
    _, weights = solve(wrong, CFG)
    assert weights[1, 3] == 1


@pytest.mark.parametrize("later", [200, 201])
def test_a_false_loop_is_no_neighbour_of_a_neighbour(ring, later):
    """Its frames are in the next submap too, which is near the one that they were wrongly found in, whichever frame
    holds that pair."""
    given, truth = ring
    wrong = given
    for number in {200, later}:
        wrong = closing(wrong, 1, 4, number, ELSEWHERE, np.eye(4))
        also = (*wrong.submaps[3].keyframes, keyframe(number, STEP @ DRIFT))
        wrong = wrong.with_submap(3, keyframes=also)
    solved, weights = solve(wrong, CFG)
    assert weights[1, 4] == 0 and weights[1, 3] == 0 and weights[0, COUNT - 1] == 1
    assert off(solved, truth) < 0.1 * off(given, truth)


def test_what_would_come_of_a_false_neighbour(ring):
    """Had it no frame in common with the loop: tracking would vouch for it."""
    given, truth = ring
    wrong = closing(closing(given, 1, 4, 200, ELSEWHERE, np.eye(4)), 1, 3, 201, ELSEWHERE, STEP @ DRIFT)
    trusted, weights = solve(wrong, CFG)
    assert weights[1, 3] == 1 and off(trusted, truth) > off(given, truth)


def test_a_submap_that_hangs_on_nothing_stays(ring):
    given, _ = ring
    alone = submap(keyframe(300), T_world_sub=pose(translation=(9.0, 0.0, 0.0)), learned=given.submap.learned)
    solved, _ = solve(given._replace(submaps=(*given.submaps, alone)), CFG)
    np.testing.assert_array_equal(solved.submaps[-1].T_world_sub, alone.T_world_sub)
