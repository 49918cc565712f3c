"""Several submaps in the host loop: begun, left, entered again, found again after the camera was lost."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import maps
from compilations import compilations
from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import Config, InputConfig
from mipsjax.config.submaps import LoopConfig, VolumeConfig
from mipsjax.config.tracking import GuardConfig
from mipsjax.core import mapping
from mipsjax.core.rigid import distance, transform
from mipsjax.data.sequence import Frame
from mipsjax.data.synth import open_synth
from mipsjax.images.features import detect
from mipsjax.loops.factors import PointToPlane
from mipsjax.loops.posegraph import solve
from mipsjax.mesh.reconstruct import reconstruct
from mipsjax.slam import finish as finishing
from mipsjax.slam import recovery
from mipsjax.slam import step as slam
from mipsjax.slam.finish import finish
from mipsjax.slam.policy import decide
from mipsjax.submaps import closure, proposals, schedule
from mipsjax.submaps.bundle import make_keyframe
from mipsjax.submaps.dormant import packed, unpacked
from mipsjax.submaps.links import Link, joined, linked_pairs, links
from mipsjax.submaps.proposals import Sighting
from mipsjax.submaps.state import SlamState, Status, Submap, pose_of, trajectory, world_pose
from mipsjax.submaps.surfaces import Pair, pair_of, plane_factor, pose_factor
from mipsjax.submaps.switching import NEW, activated, begin, enter

pytestmark = pytest.mark.slow

CFG = replace(
    PRESETS["tiny"],
    # Views cut short and boxes so small that two metres of motion need a second one
    volume=VolumeConfig(max_side=2.0, far=1.2, overlap=0.8, hysteresis=0.05, support=2),
    # Of a map that has learned little, whose frames are turned by a degree; and lost frames are given up soon
    loop=LoopConfig(overlap=0.3, inliers=0.6, sigma_rotation=0.02, fewest_points=50, patience=2),
    map=replace(PRESETS["tiny"].map, steps=10, steps_slow=10),
)
FRAMES = 40  # 3.3 m


@pytest.fixture(scope="module")
def sequence():
    return open_synth("room-fast", slice(FRAMES), InputConfig(working_width=80))


@pytest.fixture(scope="module")
def frames(sequence) -> list[Frame]:
    """There and back again."""
    there = [sequence[i] for i in range(FRAMES)]
    both = there + there[-2::-1]
    return [frame._replace(number=i, timestamp=i / 30) for i, frame in enumerate(both)]


@pytest.fixture(scope="module")
def truth(sequence) -> np.ndarray:
    """Camera poses as seen from the first."""
    poses = np.concatenate([sequence.T_world_cam, sequence.T_world_cam[-2::-1]])
    return np.linalg.inv(poses[0]) @ poses


def run(
    frames: list[Frame], camera, cfg: Config = CFG, executor: schedule.Executor = schedule.INLINE
) -> list[SlamState]:
    """The state after each frame."""
    states = [slam.start(frames[0], camera, cfg)[0]]
    for frame in frames[1:]:
        states.append(slam.step(states[-1], frame, cfg, executor)[0])
    return states


def same_submaps(one: SlamState, other: SlamState) -> bool:
    leaves = zip(*(jax.tree.leaves(state.submaps) for state in (one, other)), strict=True)
    return all(np.array_equal(a, b) for a, b in leaves)


@pytest.fixture(scope="module")
def states(frames, sequence) -> list[SlamState]:
    return run(frames, sequence.intrinsics)


@pytest.fixture(scope="module")
def meeting(sequence) -> Pair:
    """Two submaps that learned the same few frames at their true poses, neither begun from the other."""
    camera, T = sequence.intrinsics, sequence.T_world_cam

    def learned(numbers: list[int]) -> Submap:
        anchor = numbers[0]
        anchored, *support = (
            make_keyframe(sequence[n], n, np.linalg.inv(T[anchor]) @ T[n], CFG, camera) for n in numbers
        )
        made, ok = begin(anchored, support, T[anchor], 200, camera, CFG)
        assert ok
        return made

    numbers = list(range(0, 20, 3))
    return pair_of([learned(numbers), learned(numbers[::-1])], (0, 1), CFG)


def test_a_second_submap_begins_and_the_first_takes_over_again(states):
    active = [state.active for state in states]
    assert len(states[-1].submaps) == 2
    assert active[0] == 0 and 1 in active and active[-1] == 0
    changes = sum(a != b for a, b in pairwise(active))
    assert changes == 2, "no taking turns at the border"
    assert states[-1].submaps[1].parent == 0


def test_a_new_submap_counts_from_its_anchor(states):
    """Its support is older, though it comes after it in the list."""
    begun = next(state for state in states if len(state.submaps) == 2)
    numbers = [keyframe.id for keyframe in begun.submap.keyframes]
    assert len(numbers) == 1 + CFG.volume.support and begun.submap.newest is begun.submap.anchor
    assert max(numbers) == numbers[0] == len(begun.records) - 1
    following = states[len(begun.records)].records[-1]
    assert following.keyframe == numbers[0] and not following.is_keyframe


def test_support_is_what_was_seen_last():
    """Also where the submap before has few keyframes of its own yet, behind the support that it was begun with."""
    cfg = replace(PRESETS["tiny"], volume=VolumeConfig(support=3))
    numbers = (50, 40, 30, 20, 51, 60)
    keyframes = (maps.keyframe(n, maps.pose(translation=(n / 100 - 0.5, 0.0, 0.0))) for n in numbers)
    old = maps.submap(*keyframes, learned=mapping.create(jax.random.key(0), cfg))
    after, problem = enter(maps.state(old), NEW, cfg)
    begun = after.submap
    assert not problem
    assert [keyframe.id for keyframe in begun.keyframes] == [60, 51, 50, 40]
    shifts = [keyframe.T_sub_cam[0, 3] for keyframe in begun.keyframes]
    np.testing.assert_allclose(shifts, [0.0, -0.09, -0.1, -0.2], atol=1e-9)


def test_no_pose_jumps_where_the_submap_changes(states, truth):
    poses = np.stack([world_pose(state, state.records[-1]) for state in states])
    error = poses[:, :3, 3] - truth[:, :3, 3]
    # A tiny map is good to centimetres; where the submap changes it is no worse than elsewhere
    assert np.linalg.norm(error, axis=1).max() < 0.06
    jumps = np.linalg.norm(np.diff(error, axis=0), axis=1)
    active = np.array([state.active for state in states])
    # A pose of this map is good to 1 to 2 cm, so that a step between two may be 3
    assert jumps[active[1:] != active[:-1]].max() < max(0.03, np.quantile(jumps, 0.9))


def test_submaps_share_frames_that_measure_how_they_lie(states):
    state = states[-1]
    assert linked_pairs(state) == [(0, 1)]
    shared = links(*state.submaps)
    T_first_second = np.linalg.inv(state.submaps[0].T_world_sub) @ state.submaps[1].T_world_sub
    for link in shared:
        metres, radians = distance(link.T_first_second, T_first_second)
        assert metres < 0.05 and radians < 0.05
    assert not state.loops, "two neighbours are no loop"


def test_the_last_frame_is_always_in_the_active_submap(states):
    for state in states:
        assert state.records[-1].submap == state.active


def test_what_a_submap_learned_by_rests_where_the_camera_is_not(states):
    """Less than half the bytes of Adam's averages, which bfloat16 alone takes, and the same but for rounding."""
    for state in states:
        for place, submap in enumerate(state.submaps):
            assert rests(submap) is (place != state.active)
    learned = states[-1].submap.learned
    resting = packed(learned)
    assert nbytes(resting.optimizer) < 0.45 * nbytes(learned.optimizer)
    again = unpacked(resting)
    for before, after in zip(*map(jax.tree.leaves, (learned.optimizer, again.optimizer)), strict=True):
        assert after.shape == before.shape and after.dtype == before.dtype
        np.testing.assert_allclose(after, before, rtol=2**-8)
    for before, after in zip(*map(jax.tree.leaves, (learned.field, again.field)), strict=True):
        assert after is before


def test_boxes_keep_to_their_limit_and_anchors_to_the_origin(states):
    for submap in states[-1].submaps:
        assert (submap.box.hi - submap.box.lo <= CFG.volume.max_side + 1e-9).all()
        np.testing.assert_array_equal(submap.keyframes[0].T_sub_cam, np.eye(4))


def test_the_mesh_covers_both_submaps(states):
    state = finish(states[-1], CFG)
    assert len(trajectory(state)) == len(states)
    both = reconstruct(state, CFG)
    alone = [reconstruct(state._replace(submaps=(submap,)), CFG) for submap in state.submaps]
    assert len(both.faces) > 0 and both.area > max(mesh.area for mesh in alone)


def test_a_second_run_gives_the_same_bits_and_compiles_nothing(states, frames, sequence):
    with compilations() as compiled:
        again = run(frames, sequence.intrinsics)[-1]
    assert not compiled, "a new submap and a switch compile nothing"
    np.testing.assert_array_equal(trajectory(again), trajectory(states[-1]))
    assert same_submaps(again, states[-1])


def test_nothing_compiles_after_the_first_frames(frames, sequence, meeting):
    """Not when a submap begins or is entered again, nor when the graph is solved, here with every keyframe."""
    cfg = replace(CFG, loop=replace(CFG.loop, tolerance=1e-6))
    # JAX keeps programs apart by this setting: under a value of our own none is found that another test compiled
    with jax.numpy_rank_promotion("warn"):
        state, _ = slam.start(frames[0], sequence.intrinsics, cfg)
        for frame in frames[1:4]:
            state, _ = slam.step(state, frame, cfg)
        with compilations() as compiled:
            for frame in frames[4:]:
                state, _ = slam.step(state, frame, cfg)
            factor = plane_factor(meeting, True, state.camera, cfg)
    assert len(state.submaps) == 2 and state.submaps[0].keyframes[-1].id > FRAMES
    assert factor is not None and not compiled


def test_finish_closes_loops_and_moves_keyframes_before_it_learns_and_aligns(states, monkeypatch):
    before, moved_to, given, firm = states[-1], maps.pose(translation=(1.0, 0.0, 0.0)), [], []
    real = finishing.tracking.align

    def closed_again(state: SlamState, cfg: Config) -> SlamState:
        given.append(state)
        return state.with_submap(1, T_world_sub=moved_to)

    def straightened(state: SlamState, cfg: Config) -> tuple[SlamState, float]:
        given.append(state)
        return state, 0.25

    def align(field, depth, T, colour, *others):
        firm.append(colour)
        return real(field, depth, T, colour, *others)

    monkeypatch.setattr(finishing, "closed_again", closed_again)
    monkeypatch.setattr(finishing, "straightened", straightened)
    monkeypatch.setattr(finishing.tracking, "align", align)
    after = finish(before, CFG)
    first, second = given
    for old, still, new in zip(first.submaps, second.submaps, after.submaps, strict=True):
        assert old.learned.field is still.learned.field is not new.learned.field
    np.testing.assert_array_equal(first.submaps[1].T_world_sub, before.submaps[1].T_world_sub)
    for state in (second, after):
        np.testing.assert_array_equal(state.submaps[1].T_world_sub, moved_to)
    poses = [np.stack([r.T_keyframe_cam for r in state.records]) for state in (before, second, after)]
    np.testing.assert_array_equal(poses[1], poses[0])
    assert (poses[2] != poses[0]).any()
    # Colour holds a frame there as far as it was found right
    held = np.stack([r.colour for r in before.records if r.submap == 0 and r.depth is not None])
    assert held.any()
    np.testing.assert_allclose(firm[0][: len(held)], 0.25 * held[: len(firm[0])], rtol=1e-6)


def test_keyframes_stay_where_nothing_is_learned_there(states, monkeypatch):
    monkeypatch.setattr(finishing, "straightened", None)
    finish(states[-1], replace(CFG, map=replace(CFG.map, final_steps=0)))


def test_surfaces_of_two_submaps_measure_how_they_lie(meeting, sequence):
    """Across the surface, which here is hardly more than a table top; also from a shared frame that is 4 cm off."""
    camera, pair = sequence.intrinsics, meeting
    # As firmly as shared frames hold good maps
    cfg = replace(CFG, loop=replace(CFG.loop, sigma_rotation=LoopConfig().sigma_rotation))
    factor = plane_factor(pair, True, camera, cfg)
    assert factor is not None and len(factor.p_first) >= cfg.loop.fewest_points
    assert (factor.first, factor.second, factor.trusted) == (0, 1, True)
    # A tiny map is good to centimetres, and bends its walls by less than 0.3 rad
    on, above = (to_scene(sequence, factor.p_first + by * factor.n_first) for by in (0.0, 0.05))
    assert np.abs(on).max() < 0.03 and np.median(above - on) > 0.05 * np.cos(0.3)
    np.testing.assert_allclose(np.linalg.norm(factor.n_first, axis=1), 1, atol=1e-5)  # in single precision

    up = np.mean(factor.n_first, axis=0)
    for off in (0.0, 0.04):
        linked = moved(pair, off * up)
        T_linked = linked.link.T_first_second
        found = plane_factor(linked, True, camera, cfg)
        assert found is not None and abs(across(found, T_linked) - off) < cfg.loop.points_sigma
        assert len(found.p_first) > 0.9 * len(factor.p_first), "at the first pose fewer meet than at the last"
        T = solve(np.stack([np.eye(4), T_linked]), [pose_factor(linked, True, cfg), found]).T_world_sub[1]
        assert across(found, T) < cfg.loop.points_sigma
        # The shared frame was right: the surfaces agree with it, or take it back
        assert abs(up @ (T - pair.link.T_first_second)[:3, 3]) < cfg.loop.points_sigma
    # Of those that could meet, a quarter does: too few to believe, though enough to align the two
    assert plane_factor(moved(pair, 0.07 * up), True, camera, cfg) is None


def test_surfaces_say_nothing_along_the_chain(states):
    state = states[-1]
    assert plane_factor(pair_of(state.submaps, (0, 1), CFG), True, state.camera, CFG) is None


def to_scene(sequence, p_first: np.ndarray) -> np.ndarray:
    """True distances to the room of points in the first submap."""
    p_world = transform(sequence.T_world_cam[0], p_first)
    return np.asarray(sequence.scene.distance(jnp.asarray(p_world, jnp.float32)))


def moved(pair: Pair, metres: np.ndarray) -> Pair:
    """With a shared frame that puts the second submap elsewhere in the first."""
    first, second = pair.link
    T_first_cam = maps.pose(translation=metres) @ first.T_sub_cam
    return pair._replace(link=Link(first._replace(T_sub_cam=T_first_cam), second))


def across(factor: PointToPlane, T_first_second: np.ndarray) -> float:
    """Median distance between matched points across the surface, metres."""
    error = factor.p_first - transform(T_first_second, factor.q_second)
    return float(np.median(np.abs(np.sum(error * factor.n_first, axis=1))))


def test_refinement_in_a_thread_gives_the_same_bits(states, frames, sequence):
    with schedule.executor("thread") as beside:
        again = run(frames, sequence.intrinsics, CFG, beside)[-1]
        finished = finish(again, CFG, beside)
    np.testing.assert_array_equal(trajectory(again), trajectory(states[-1]))
    assert same_submaps(again, states[-1])
    assert again.refinement is not None and finished.refinement is None
    assert same_submaps(finished, finish(states[-1], CFG))


def test_a_refinement_is_taken_over_before_its_submap_is_entered(states):
    """And one that is under way leaves its submap as it was."""
    for before, after in pairwise(states):
        if after.refinement is not None:
            assert after.active not in after.refinement.places
        if before.refinement is not None and before.refinement is after.refinement:
            for place in before.refinement.places:
                assert after.submaps[place].learned is before.submaps[place].learned


def test_without_loops_submaps_stay_where_they_were_begun(frames, sequence):
    cfg = replace(CFG, loop=replace(CFG.loop, enabled=False))
    states = run(frames, sequence.intrinsics, cfg)
    begun = next(state for state in states if len(state.submaps) == 2)
    for one, other in zip(begun.submaps, states[-1].submaps, strict=True):
        np.testing.assert_array_equal(one.T_world_sub, other.T_world_sub)


def test_a_frame_of_nowhere_is_lost(states, frames):
    """A wall 30 cm away, and what no surface looks like, all in one colour."""
    shape, color = frames[0].depth.shape, np.full_like(frames[0].color, 90)
    noise = np.random.default_rng(0).uniform(0.3, 3, shape).astype(np.float32)
    other = frames[-1]._replace(color=color, number=99, timestamp=99.0)
    wall, nothing = (other._replace(depth=depth) for depth in (np.full(shape, 0.3, np.float32), noise))
    for frame, cfg in (wall, CFG), (wall, replace(CFG, guard=GuardConfig())), (nothing, CFG):
        after, _ = slam.step(states[-1], frame, cfg)
        assert after.records[-1].status is Status.LOST
        assert len(after.submaps) == len(states[-1].submaps)


@pytest.mark.parametrize("kept", [True, False], ids=["keyframe", "between"])
def test_a_frame_is_recognised_in_a_submap_by_its_image(states, frames, kept):
    state = states[-1]
    keyframes = {keyframe.id for keyframe in state.submaps[1].keyframes}
    assert state.active == 0
    # On the way there, among those of the second submap; which are keyframes depends on rounding
    number = next(n for n in range(34, FRAMES) if state.records[n].submap == 1 and (n in keyframes) is kept)
    frame, camera = frames[number], state.camera
    image = make_keyframe(frame, len(state.records), np.eye(4), CFG, camera)
    image = image._replace(features=detect(frame.color, frame.depth, camera))
    found = closure.recognise(state, image, [0, 1], CFG)
    assert found is not None and found.submap == 1 and found.inliers > 0.8
    # As far off as neighbouring frames of so small images are
    metres, radians = distance(found.T_sub_cam, pose_of(state, state.records[number]))
    assert metres < 0.03 and radians < 0.02
    assert closure.recognise(state, image._replace(features=None), [0, 1], CFG) is None


@pytest.mark.fault(29)
def test_a_camera_carried_elsewhere_is_found_in_the_submap_that_knows_the_place(states, frames, truth):
    after, info = slam.step(states[-1], frames[37]._replace(number=99, timestamp=99.0), CFG)
    last = after.records[-1]
    assert (last.status, info.found, last.submap, after.active) == (Status.WEAK, "again", 1, 1)
    assert distance(world_pose(after, last), truth[37])[0] < 0.06  # as the poses of the whole run
    assert len(after.submaps) == 2 and after.motion is None


@pytest.fixture(scope="module")
def another_room(frames) -> list[Frame]:
    """The same one in a mirror and upside down, after the camera was at the end of its way."""
    return [
        frame._replace(
            depth=frame.depth[::-1].copy(),
            color=frame.color[::-1].copy(),
            number=100 + i,
            timestamp=9 + i / 30,
        )
        for i, frame in enumerate(frames[20:34])
    ]


@pytest.mark.fault(29)
def test_a_camera_lost_for_long_begins_a_submap_that_hangs_on_nothing(
    states, another_room, monkeypatch, caplog
):
    # Boxes mean nothing there, even if what they hold should fit
    monkeypatch.setattr(
        proposals, "sight", lambda _, place, k, expected, cfg: Sighting(place, expected.T_sub_cam, 1.0)
    )
    lost_before = []
    monkeypatch.setattr(
        slam, "decide", lambda stats, cfg: lost_before.append(stats.lost) or decide(stats, cfg)
    )
    one, two, three, four, *rest = another_room
    sparse, dark = np.zeros_like(three.depth), np.zeros_like(four.depth)
    sparse[20:40, 30:48] = three.depth[20:40, 30:48]
    before = lost = states[-1]
    # One with hardly any depth is no anchor, and a skipped frame ends no row of lost ones
    for frame in (one, two, three._replace(depth=sparse), four._replace(depth=dark)):
        lost, _ = slam.step(lost, frame, CFG)
    statuses = [record.status for record in lost.records[-4:]]
    assert statuses == [Status.LOST, Status.LOST, Status.LOST, Status.SKIPPED]
    assert lost_before == [0, 1, 2]
    assert len(lost.submaps) == 2 and lost.active == 0
    after, infos = lost, []
    for frame in rest:
        after, info = slam.step(after, frame, CFG)
        infos.append(info)
    first, *others = after.records[len(lost.records) :]
    assert (first.status, infos[0].found, first.is_keyframe) == (Status.WEAK, "nowhere", True)
    assert {r.status for r in others} == {Status.OK} and not any(info.found for info in infos[1:])
    assert sum(r.is_keyframe for r in others) > 1, "these are offered to other submaps"
    assert len(after.submaps) == 3 and after.active == 2 and after.submap.parent is None
    np.testing.assert_allclose(after.submap.T_world_sub, world_pose(before, before.records[-1]), atol=1e-9)
    assert joined(after, 2) == {2} and joined(after, 0) == {0, 1} and after.loops == ()
    go = replace(CFG.track.go, final_steps=0)
    idle = replace(CFG, map=replace(CFG.map, final_steps=0), track=replace(CFG.track, go=go))
    finish(before, idle)
    assert not caplog.records
    finish(after, idle)
    (warning,) = caplog.messages
    assert "submaps [2]" in warning and "guess" in warning


@pytest.mark.parametrize("place", [0, 1])
def test_a_camera_found_again_goes_on_in_that_submap(states, monkeypatch, place):
    state = states[-1]
    pose = state.submaps[place].keyframes[1].T_sub_cam
    monkeypatch.setattr(recovery, "recognise", lambda *_: Sighting(place, pose, 0.9))
    found = recovery.find_again(state, state.submap.keyframes[-1], CFG)
    assert found is not None
    assert found.submap == place and found.keyframe is state.submaps[place].keyframes[1]
    entered = activated(found.state, place)
    assert entered.active == place
    kept = [
        after.learned is before.learned for before, after in zip(state.submaps, entered.submaps, strict=True)
    ]
    assert kept == [place == state.active] * 2
    assert rests(entered.submaps[1 - place]) and not rests(entered.submap)


def rests(submap: Submap) -> bool:
    return any(leaf.dtype == jnp.bfloat16 for leaf in jax.tree.leaves(submap.learned))


def nbytes(tree) -> int:
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))
