"""The host loop where the camera stands still, turns on the spot, is covered, or where somebody crosses its view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import Config, InputConfig
from mipsjax.config.tracking import GuardConfig
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import distance
from mipsjax.data.sequence import Frame
from mipsjax.data.synth import open_synth
from mipsjax.data.synth.render import render
from mipsjax.slam import step as slam
from mipsjax.slam.finish import finish
from mipsjax.slam.info import FrameInfo
from mipsjax.slam.moving import in_free_space, without_moving
from mipsjax.submaps.bundle import views_of
from mipsjax.submaps.mending import is_finite
from mipsjax.submaps.state import SlamState, Status, trajectory

pytestmark = pytest.mark.slow

CFG = PRESETS["tiny"]
NOISE_M = 0.005


@pytest.fixture(scope="module")
def sequence():
    return open_synth("room-fast", slice(24), InputConfig(working_width=80))


@pytest.fixture(scope="module")
def frames(sequence) -> list[Frame]:
    return [sequence[i] for i in range(len(sequence))]


@pytest.fixture(scope="module")
def truth(sequence) -> np.ndarray:
    """Camera poses as seen from the first."""
    return np.linalg.inv(sequence.T_world_cam[0]) @ sequence.T_world_cam


def run(
    frames: list[Frame], camera: Intrinsics, cfg: Config = CFG
) -> tuple[list[SlamState], list[FrameInfo]]:
    """The state after each frame, and what was said of it."""
    frames = [frame._replace(number=i, timestamp=i / 30) for i, frame in enumerate(frames)]
    state, info = slam.start(frames[0], camera, cfg)
    states, infos = [state], [info]
    for frame in frames[1:]:
        state, info = slam.step(state, frame, cfg)
        states.append(state)
        infos.append(info)
    return states, infos


def statuses(state: SlamState) -> list[Status]:
    return [record.status for record in state.records]


def ate(state: SlamState, truth: np.ndarray) -> float:
    """Metres, of the centres as they are: the first pose is the true one."""
    return float(np.sqrt(np.mean((trajectory(state)[:, :3, 3] - truth[:, :3, 3]) ** 2) * 3))


@pytest.mark.fault(30)
def test_a_camera_that_stands_still_adds_nothing(sequence, frames):
    rng, still = np.random.default_rng(0), frames[0]
    assert still.depth is not None

    def noisy() -> Frame:
        noise = rng.normal(0, NOISE_M, still.depth.shape)
        return still._replace(depth=np.where(still.depth > 0, still.depth + noise, 0).astype(np.float32))

    states, _ = run([noisy() for _ in range(500)], sequence.intrinsics)
    end = finish(states[-1], CFG)
    assert len(end.submaps) == 1 and len(end.submap.keyframes) == 1 and end.loops == ()
    assert set(statuses(end)) == {Status.OK}
    moved = np.linalg.norm(trajectory(end)[:, :3, 3], axis=1)
    assert moved.max() < 0.01 and is_finite(end.submap.learned)


@pytest.mark.fault(31)
def test_before_a_bare_wall_it_is_said_that_nothing_holds_the_camera():
    """It walks along it, which no image shows."""
    camera = Intrinsics(72.5, 72.5, 39.5, 29.5, 80, 60)
    rng = np.random.default_rng(1)

    def wall() -> Frame:
        depth = (2 + rng.normal(0, NOISE_M, (60, 80))).astype(np.float32)
        return Frame(0, 0.0, np.full((60, 80, 3), 150, np.uint8), depth)

    held = replace(CFG, guard=GuardConfig(), track=replace(CFG.track, held=Config().track.held))
    states, infos = run([wall() for _ in range(30)], camera, held)
    assert set(statuses(states[-1])[1:]) == {Status.WEAK}
    # Along the wall, and turns about its normal
    assert all(max(info.together) > 10 * min(info.together) for info in infos[1:])
    stated = [info.world_deviation_m for info in infos[1:]]
    assert np.isfinite(trajectory(states[-1])).all() and np.isfinite(stated).all()
    assert stated[-1] > stated[0] and is_finite(states[-1].submap.learned)


@pytest.mark.fault(31)
def test_a_whole_turn_on_the_spot_ends_where_it_began(sequence):
    scene, camera = sequence.scene, sequence.intrinsics
    poses = []
    for degrees in np.arange(0, 361, 5):
        # About the vertical of the camera: its second axis points down
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
        poses.append(sequence.T_world_cam[0] @ turn)
    images = [render(scene, camera, pose[None]) for pose in poses]
    states, _ = run([Frame(0, 0.0, image.color, image.depth) for image in images], camera)
    end = finish(states[-1], CFG)
    assert Status.LOST not in statuses(end) and is_finite(end.submap.learned)
    metres, radians = distance(trajectory(end)[0], trajectory(end)[-1])
    assert metres < 0.1 and radians < 0.05


@pytest.mark.fault(32)
@pytest.mark.parametrize("cover", ["no depth", "a hand"])
def test_a_camera_that_was_covered_goes_on_in_the_same_map(sequence, frames, truth, cover):
    covered_m = 0.0 if cover == "no depth" else 0.2
    dark = frames[0]._replace(
        color=np.zeros_like(frames[0].color), depth=np.full_like(frames[0].depth, covered_m)
    )
    before, after = frames[:16], frames[12:16]
    # Five seconds
    states, _ = run([*before, *[dark] * 150, *after], sequence.intrinsics)
    end = states[-1]
    expected = Status.SKIPPED if cover == "no depth" else Status.LOST
    # The first frames of a hand may still be taken for what was there
    assert set(statuses(end)[len(before) + 5 : -len(after)]) == {expected}
    assert len(end.submaps) == len(states[len(before) - 1].submaps)
    assert end.records[-1].status in (Status.OK, Status.WEAK)
    assert distance(trajectory(end)[-1], truth[15])[0] < 0.06


def crossed(frames: list[Frame], height: slice = slice(10, 60), width: int = 20) -> list[Frame]:
    """With a box, of a fifth of the image, that crosses it one to one and a half metres away."""
    crossing = []
    for i, frame in enumerate(frames):
        assert frame.depth is not None and frame.color is not None
        depth, color = frame.depth.copy(), frame.color.copy()
        left = 4 * i - 24
        seen = height, slice(max(left, 0), max(left + width, 0))
        depth[seen] = np.minimum(np.where(depth[seen] > 0, depth[seen], np.inf), 1.0 + 0.02 * i)
        color[seen] = (40, 70, 160)
        crossing.append(frame._replace(depth=depth, color=color))
    return crossing


@pytest.mark.fault(33)
def test_who_walks_through_the_view_hardly_moves_the_camera(sequence, frames, truth):
    clean, infos = run(frames, sequence.intrinsics)
    assert all(info.moving == 0 for info in infos)
    states, infos = run(crossed(frames), sequence.intrinsics)
    # He comes into view with the third frame and is all in it from the seventh on
    moving = [info.moving for info in infos]
    assert moving[0] == moving[1] == 0 and min(moving[8:18]) > 0.05
    assert Status.LOST not in statuses(states[-1])
    assert ate(states[-1], truth) < 2 * ate(clean[-1], truth)
    # Nor is he learned, but for where no keyframe had looked before, as where he comes into view
    for keyframe in states[-1].submap.keyframes:
        behind = frames[keyframe.id].depth
        left_in = (keyframe.depth > 0) & (keyframe.depth != behind)
        assert keyframe.id < 12 or left_in.mean() < 0.01


def test_where_nearly_all_moves_it_is_rather_the_pose_that_is_wrong(sequence, frames):
    states, _ = run(frames[:8], sequence.intrinsics)
    [hidden] = crossed(frames[12:13], slice(0, 60), 80)
    submap, T = states[-1].submap, np.float32(trajectory(states[-1])[-1])
    found = in_free_space(hidden, T, views_of(submap.keyframes), sequence.intrinsics, CFG)
    assert found is not None and np.mean(found.free) > 0.5
    still, share = without_moving(hidden, found, CFG)
    assert still is hidden and share == 0
