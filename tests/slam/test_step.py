"""The host loop on a small synthetic sequence: compilations, repetition, what bad frames may not touch."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from compilations import compilations
from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import Config, InputConfig
from mipsjax.config.tracking import HeldConfig
from mipsjax.data.sequence import Frame
from mipsjax.data.synth import open_synth
from mipsjax.slam import step as slam
from mipsjax.slam import tracker
from mipsjax.slam.finish import finish
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import Motion, SlamState, Status, trajectory

pytestmark = pytest.mark.slow

CFG = PRESETS["tiny"]
FRAMES = 6


@pytest.fixture(scope="module")
def sequence():
    return open_synth("tiny", slice(FRAMES), InputConfig())


@pytest.fixture(scope="module")
def frames(sequence) -> list[Frame]:
    return [sequence[i] for i in range(FRAMES)]


def run(frames: list[Frame], camera, cfg: Config = CFG) -> SlamState:
    return told(frames, camera, cfg)[0]


def told(frames: list[Frame], camera, cfg: Config = CFG) -> tuple[SlamState, list[FrameInfo]]:
    """The state after all frames, and what was said about each."""
    state, info = slam.start(frames[0], camera, cfg)
    infos = [info]
    for frame in frames[1:]:
        state, info = slam.step(state, frame, cfg)
        infos.append(info)
    return state, infos


@pytest.fixture(scope="module")
def finished(frames, sequence) -> SlamState:
    return run(frames, sequence.intrinsics)


def same_map(a: SlamState, b: SlamState) -> bool:
    """Bit for bit the same networks, optimiser and keyframes."""

    def leaves(state):
        return jax.tree.leaves(state.submaps)

    structure = [jax.tree.structure(state.submaps) for state in (a, b)]
    return structure[0] == structure[1] and all(map(np.array_equal, leaves(a), leaves(b)))


def test_frames_are_tracked(finished, sequence):
    assert len(finished.records) == FRAMES
    assert [r.frame for r in finished.records] == list(range(FRAMES))
    assert all(r.status is Status.OK for r in finished.records) and finished.frames_in_trouble == 0
    truth = np.linalg.inv(sequence.T_world_cam[0]) @ sequence.T_world_cam
    error = np.linalg.norm(trajectory(finished)[:, :3, 3] - truth[:, :3, 3], axis=1)
    # Tens of pixels and a few steps on purpose; the camera itself moves by more than this
    assert error.max() < 0.03


def test_poses_are_rigid(finished):
    for T in trajectory(finished):
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1, abs=1e-9)
        np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_the_first_pose_is_the_one_asked_for(frames, sequence, finished):
    np.testing.assert_array_equal(trajectory(finished)[0], np.eye(4))
    T = sequence.T_world_cam[0]
    state, _ = slam.start(frames[0], sequence.intrinsics, CFG, T)
    np.testing.assert_allclose(trajectory(state)[0], T, atol=1e-12)


def test_two_runs_give_the_same_bits_and_the_second_compiles_nothing(frames, sequence, finished):
    with compilations() as compiled:
        again = run(frames, sequence.intrinsics)
        blind, _ = slam.step(again, frames[0]._replace(depth=None, problem="gone"), CFG)
        slam.step(blind, frames[5]._replace(color=None), CFG)
        assert not compiled
        jax.jit(lambda x: x * 7)(np.float32(1))
        assert compiled, "the listener hears compilations"
    np.testing.assert_array_equal(trajectory(again), trajectory(finished))
    assert same_map(again, finished)


def following(frame: Frame) -> Frame:
    return frame._replace(number=FRAMES, timestamp=frame.timestamp + 1 / 30)


def test_another_seed_compiles_nothing_and_draws_otherwise(frames, sequence, finished):
    with compilations() as compiled:
        other = run(frames, sequence.intrinsics, replace(CFG, seed=CFG.seed + 1))
    assert not compiled
    assert not np.array_equal(trajectory(other), trajectory(finished))


@pytest.mark.parametrize("how", ["missing", "zero"])
def test_a_frame_without_depth_is_skipped_and_counted(finished, frames, how):
    depth = None if how == "missing" else np.zeros_like(frames[-1].depth)
    bad = following(frames[-1])._replace(depth=depth, problem="cut short" if how == "missing" else "")
    after, info = slam.step(finished, bad, CFG)
    record = after.records[-1]
    assert len(after.records) == FRAMES + 1 and record.status is Status.SKIPPED
    assert info.note == ("cut short" if how == "missing" else "no depth")
    assert after.frames_in_trouble == 1 and same_map(after, finished)
    np.testing.assert_allclose(trajectory(after)[-1], trajectory(after)[-2], atol=1e-12)


def test_a_frame_without_color_is_tracked_but_not_mapped(finished, frames):
    after, info = slam.step(finished, following(frames[-1])._replace(color=None), CFG)
    record = after.records[-1]
    assert record.status is Status.OK and info.map_steps == 0
    assert not record.is_keyframe and not info.keyframe
    assert same_map(after, finished)
    # The same view as the frame before, so about the same pose
    moved = np.linalg.norm(trajectory(after)[-1][:3, 3] - trajectory(after)[-2][:3, 3])
    assert moved < 0.02


def garbage(frame: Frame) -> Frame:
    """Depth that fits no surface, whatever the pose."""
    noise = np.random.default_rng(0).uniform(0.3, 6, frame.depth.shape)
    return following(frame)._replace(depth=noise.astype(np.float32))


def test_nothing_is_learned_from_a_lost_frame(finished, frames):
    after, info = slam.step(finished, garbage(frames[-1]), CFG)
    record = after.records[-1]
    assert record.status is Status.LOST and info.searched and after.frames_in_trouble == 1
    assert same_map(after, finished)
    assert np.isfinite(trajectory(after)).all()


def test_tracking_goes_on_after_a_lost_frame(finished, frames):
    lost, _ = slam.step(finished, garbage(frames[-1]), CFG)
    after, _ = slam.step(lost, following(frames[-1])._replace(timestamp=frames[-1].timestamp + 2 / 30), CFG)
    assert after.records[-1].status is Status.OK and after.frames_in_trouble == 0


def test_finish_aligns_every_trusted_frame_to_the_map(finished, frames):
    """One that colour does not hold comes back from 2 cm off; the anchor and one without depth stay where they were."""
    cfg = replace(CFG, map=replace(CFG.map, final_steps=0))
    state, _ = slam.step(finished, following(frames[-1])._replace(depth=None, problem="gone"), CFG)
    off = state.records[3].T_keyframe_cam.copy()
    off[:3, 3] += 0.02 / np.sqrt(3)
    records = list(state.records)
    records[3] = records[3]._replace(T_keyframe_cam=off, colour=np.zeros((6, 6)))
    after = finish(state._replace(records=Records.of(records)), cfg)
    moved = np.linalg.norm(trajectory(after)[:, :3, 3] - trajectory(state)[:, :3, 3], axis=1)
    # The pose before was found with other pixels of a coarse map
    assert moved[3] < 0.01
    assert moved[0] == 0 and moved[-1] == 0
    assert same_map(after, state)


def test_the_least_residual_falls_at_once_and_rises_slowly(finished, frames):
    _, info = slam.step(finished, following(frames[-1]), CFG)
    last = info.residual_after
    (high, over), (low, under) = (
        slam.step(finished._replace(residual=r), frames[-1], CFG) for r in (3 * last, 0.3 * last)
    )
    above, below = over.residual_after, under.residual_after
    assert 0.3 * last < below and above < 3 * last
    assert high.residual == pytest.approx(above)
    assert 0.3 * last < low.residual < 0.3 * last + 0.1 * (below - 0.3 * last)


def test_a_frame_is_weak_where_its_submap_may_be_elsewhere(finished, frames):
    """However well it fits there; it moves and teaches as ever."""
    # So small images hold a frame to some centimetres only
    slack = replace(CFG, track=replace(CFG.track, held=HeldConfig(weak=1.0)))
    near, said = slam.step(finished, following(frames[-1]), slack)
    assert near.records[-1].status is Status.OK and said.world_deviation_m < 0.1
    loose = finished.with_submap(0, covariance=np.diag([0.2, 0.0, 0.0, 0.0, 0.0, 0.0]) ** 2)
    far, said = slam.step(loose, following(frames[-1]), slack)
    assert far.records[-1].status is Status.WEAK and 0.2 <= said.world_deviation_m < 0.25
    assert far.frames_in_trouble == 0
    np.testing.assert_array_equal(trajectory(far), trajectory(near))


def test_the_motion_is_that_between_the_last_trusted_frames(finished, frames):
    poses = trajectory(finished)
    assert finished.motion is not None
    np.testing.assert_allclose(finished.motion.T_older_newer, np.linalg.inv(poses[-2]) @ poses[-1], atol=1e-9)
    blind, _ = slam.step(finished, frames[0]._replace(depth=None, problem="gone"), CFG)
    assert blind.motion is finished.motion, "nothing was learned about it"


def test_a_frame_with_hardly_any_depth_teaches_nothing(finished, frames):
    """Neither the map, nor how well frames fit, nor how the camera moves."""
    sparse = np.where(np.random.default_rng(0).random(frames[-1].depth.shape) < 0.03, frames[-1].depth, 0)
    before = finished._replace(residual=1.0)
    after, info = slam.step(before, following(frames[-1])._replace(depth=sparse), CFG)
    record = after.records[-1]
    assert record.status is Status.WEAK and info.map_steps == 0
    assert info.note.startswith("depth in ") and info.note.endswith(" % of the pixels only")
    assert same_map(after, finished) and after.frames_in_trouble == 1
    assert after.residual == before.residual and after.motion is before.motion


@pytest.mark.parametrize(
    ("intervals", "steps"), [(1.0, 1.0), (2.5, 2.5), (100.0, 5.0), (0.0, 0.0), (-3.0, 0.0)]
)
@pytest.mark.fault(24)
def test_the_motion_goes_on_for_the_time_that_has_passed(finished, intervals, steps):
    """At the same speed, but not over a long gap, after which no motion is expected, and not backwards in time."""
    motion = Motion(translated(0.02), 1 / 30)
    state = finished._replace(motion=motion)
    last = trajectory(finished)[-1]
    now = finished.records[-1].timestamp + intervals / 30
    candidates = tracker._candidates(state, now)
    moving, still = candidates[::-1] if intervals > steps else candidates
    np.testing.assert_allclose(moving, last @ translated(0.02 * steps), atol=1e-9)
    np.testing.assert_allclose(still, last, atol=1e-12)


def translated(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


@pytest.mark.fault(54)
def test_memory_grows_by_a_small_record_a_frame(finished, frames):
    """100,000 frames in half a gigabyte: where the map stays, a frame adds a record alone, of less than 5 kB."""
    after, _ = slam.step(finished, following(frames[-1])._replace(color=None), CFG)
    blind, _ = slam.step(finished, following(frames[-1])._replace(depth=None, problem="gone"), CFG)
    assert same_map(after, finished) and same_map(blind, finished)
    assert after.records[-1].depth is not None and after.records[-1].depth.nbytes < 5000
    assert blind.records[-1].depth is None


def sized_down(name: str, **field) -> Config:
    """A whole method at the sizes of a test."""
    cfg = PRESETS[name]
    mapping = replace(cfg.map, first_steps=60, steps=6, steps_slow=6, pixels=64)
    ro = replace(cfg.track.ro, particles=128, pixels=48)
    return replace(cfg, field=replace(cfg.field, **field), map=mapping, track=replace(cfg.track, ro=ro))


@pytest.mark.parametrize(
    "cfg",
    [
        sized_down("default"),
        sized_down("default", encoding="hash"),
        sized_down("default", encoding="joint"),
        sized_down("default", encoding="frequency", classification=False),
    ],
    ids=["default", "hash", "joint", "regression"],
)
def test_the_method_tracks_with_each_field(frames, sequence, cfg):
    state = run(frames, sequence.intrinsics, cfg)
    assert all(record.status is Status.OK for record in state.records)
    truth = np.linalg.inv(sequence.T_world_cam[0]) @ sequence.T_world_cam
    error = np.linalg.norm(trajectory(state)[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert error.max() < 0.03  # as above


def test_the_paper_preset_searches_and_learns_in_every_frame_and_tracks(frames, sequence):
    cfg = sized_down("paper")
    # Its one light network of sinusoids learns more slowly than a hash grid
    longer = replace(cfg.map, first_steps=300, steps=10, steps_slow=10, pixels=192)
    wider = replace(cfg.track, ro=replace(cfg.track.ro, particles=512, pixels=192))
    state, infos = told(frames, sequence.intrinsics, replace(cfg, map=longer, track=wider))
    assert all(info.searched and info.map_steps == 10 for info in infos[1:])
    assert all(record.status is Status.OK for record in state.records)
    truth = np.linalg.inv(sequence.T_world_cam[0]) @ sequence.T_world_cam
    error = np.linalg.norm(trajectory(state)[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert error.max() < 0.03


def test_without_an_image_the_paper_preset_goes_by_depth_alone(frames, sequence):
    """The black image that stands for none is nothing to fit."""
    cfg = sized_down("paper")
    known = run(frames[:3], sequence.intrinsics, cfg)
    blind, _ = slam.step(known, frames[3]._replace(color=None), cfg)
    no_term = replace(cfg, track=replace(cfg.track, go=replace(cfg.track.go, rgb=0.0)))
    without, _ = slam.step(known, frames[3]._replace(color=None), no_term)
    np.testing.assert_allclose(trajectory(blind)[-1], trajectory(without)[-1], atol=1e-5)


@pytest.mark.parametrize(
    ("frame", "problem"),
    [
        ({}, ""),
        ({"color": None}, "no image"),
        ({"depth": None, "problem": "torn file"}, "torn file"),
        (
            {"depth": np.zeros((48, 64), np.float32)},
            "depth in 0.0 % of the pixels only; a map begins with at least 10 % (--guard.first-measured)",
        ),
    ],
)
def test_which_frame_can_begin_a_map(frames, frame, problem):
    assert slam.anchor_problem(frames[0]._replace(**frame), CFG) == problem


@pytest.mark.parametrize("nonsense", [np.nan, np.inf, -np.inf, -1.0])
@pytest.mark.fault(16)
def test_depth_that_is_no_distance_is_none(finished, frames, nonsense):
    hole = np.s_[10:30, 10:40]

    def after(value: float):
        depth = frames[-1].depth.copy()
        depth[hole] = value
        frame = frames[-1]._replace(depth=depth)
        begun, _ = slam.start(frame, finished.camera, CFG)
        return begun, slam.step(begun, following(frame), CFG)[0]

    for state, expected in zip(after(nonsense), after(0.0), strict=True):
        np.testing.assert_array_equal(trajectory(state), trajectory(expected))
        for mine, other in zip(
            jax.tree.leaves(state.submap.learned), jax.tree.leaves(expected.submap.learned), strict=True
        ):
            np.testing.assert_array_equal(mine, other)


def test_finish_without_steps_changes_nothing(finished):
    cfg = replace(CFG, map=replace(CFG.map, final_steps=0))
    go = replace(cfg.track.go, final_steps=0)
    after = finish(finished, replace(cfg, track=replace(cfg.track, go=go)))
    np.testing.assert_array_equal(trajectory(after), trajectory(finished))


def test_states_are_values(finished, frames):
    """A step returns a new state and leaves the one it was given as it was."""
    before = trajectory(finished)
    slam.step(finished, following(frames[-1]), CFG)
    np.testing.assert_array_equal(trajectory(finished), before)
    assert len(finished.records) == FRAMES
