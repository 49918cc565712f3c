"""A second recording in the map of a first one: found in it, and either learned from or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import InputConfig
from mipsjax.config.submaps import LoopConfig, VolumeConfig
from mipsjax.core.rigid import distance
from mipsjax.data.sequence import Frame
from mipsjax.data.synth import open_synth
from mipsjax.errors import InputError
from mipsjax.slam import step as slam
from mipsjax.slam.finish import finish
from mipsjax.slam.localise import continued, localise
from mipsjax.slam.recovery import lost_in_a_row
from mipsjax.submaps.dormant import packed, rests
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.state import SlamState, Status, trajectory

pytestmark = pytest.mark.slow

# Two submaps within three metres, of so little that frames of neighbours differ by centimetres
CFG = replace(
    PRESETS["tiny"],
    volume=VolumeConfig(max_side=2.0, far=1.2, overlap=0.8, hysteresis=0.05, support=2),
    loop=LoopConfig(overlap=0.3, inliers=0.6, sigma_rotation=0.02, fewest_points=50, patience=2),
    map=replace(PRESETS["tiny"].map, steps=10, steps_slow=10),
)
FRAMES = 40
NEAR_M = 0.08


@pytest.fixture(scope="module")
def sequence():
    return open_synth("room-fast", slice(FRAMES), InputConfig(working_width=80))


@pytest.fixture(scope="module")
def learned(sequence) -> SlamState:
    state, _ = slam.start(sequence[0], sequence.intrinsics, CFG, sequence.T_world_cam[0])
    for position in range(1, FRAMES):
        state, _ = slam.step(state, sequence[position], CFG)
    return finish(state, CFG)


@pytest.fixture(scope="module")
def way_back(sequence) -> list[Frame]:
    """From where the first recording nearly ended to where it began, as a recording of its own."""
    positions = range(FRAMES - 3, 0, -1)
    return [
        sequence[position]._replace(number=number, timestamp=number / 30)
        for number, position in enumerate(positions)
    ]


def errors(state: SlamState, sequence) -> np.ndarray:
    """Metres by which each frame of the way back is off in the world."""
    true = sequence.T_world_cam[FRAMES - 3 : 0 : -1]
    return np.array([distance(T, there)[0] for T, there in zip(trajectory(state), true, strict=False)])


def test_a_map_that_only_answers_stays_as_it_is(learned, way_back, sequence):
    state, infos = continued(learned, sequence.intrinsics), []
    for frame in way_back:
        state, info = localise(state, frame, CFG)
        infos.append(info)
    assert len(learned.submaps) == 2 and state.submaps is learned.submaps
    assert (infos[0].found, infos[0].submap) == ("again", 1)
    # The rest is tracked, and the other submap takes the camera over on the way
    assert not any(info.found for info in infos[1:]) and infos[-1].submap == state.active == 0
    assert len(trajectory(state)) == len(way_back)
    assert all(record.status.trusted for record in state.records[state.first :])
    assert errors(state, sequence).max() < NEAR_M


def test_a_map_goes_on_growing(learned, way_back, sequence):
    state = continued(learned, sequence.intrinsics)
    assert not state.located
    for frame in way_back[:8]:
        state, _ = slam.step(state, frame, CFG)
        assert state.located
    own = state.records[state.first :]
    assert [record.frame for record in own] == list(range(8)) and errors(state, sequence).max() < NEAR_M
    assert any(record.is_keyframe for record in own)
    # Keyframes of both recordings are there, each with its own record
    assert {k.id >= state.first for k in state.submap.keyframes} == {False, True}
    assert len(trajectory(finish(state, CFG))) == 8


@pytest.mark.parametrize("look", [localise, slam.step], ids=["localise", "step"])
def test_a_frame_of_elsewhere_is_lost_and_nothing_is_known_of_where_it_is(learned, way_back, sequence, look):
    frame = way_back[0]
    elsewhere = frame._replace(color=np.full_like(frame.color, 90), depth=np.full_like(frame.depth, 0.3))
    state, info = look(continued(learned, sequence.intrinsics), elsewhere, CFG)
    assert state.records[-1].status is Status.LOST and "not yet found" in info.note
    assert info.world_deviation_m > 1 and not state.located and state.submaps is learned.submaps
    found, info = look(state, frame._replace(number=1, timestamp=0.1), CFG)
    assert info.found == "again" and found.located


def test_a_lost_end_of_the_first_recording_is_not_held_against_the_second(learned, way_back, sequence):
    """Else its first frame that is not recognised would begin a submap that hangs on nothing."""
    state, blind = learned, way_back[0]._replace(depth=np.full_like(way_back[0].depth, 0.3))
    blind = blind._replace(color=np.full_like(blind.color, 90))
    for i in range(CFG.loop.patience):
        state, _ = slam.step(state, blind._replace(number=99 + i, timestamp=9.0 + i), CFG)
    assert lost_in_a_row(state, CFG.loop.patience) == CFG.loop.patience
    # One skipped frame of the second does not let one of the first count
    dark = blind._replace(depth=np.zeros_like(blind.depth))
    state, _ = slam.step(continued(state, sequence.intrinsics), dark, CFG)
    assert lost_in_a_row(state, CFG.loop.patience) == 0
    state, info = slam.step(state, blind, CFG)
    assert not info.found and len(state.submaps) == len(learned.submaps)


def test_a_recording_that_is_never_found_leaves_the_map_as_it_is(learned, way_back, sequence):
    """However long it waits, and whatever follows its last frame."""
    # Upside down and in a mirror, with enough to be recognised by
    state = continued(learned, sequence.intrinsics)
    for number in range(CFG.loop.patience + 2):
        frame = way_back[number]
        other = frame._replace(color=frame.color[::-1].copy(), depth=frame.depth[::-1].copy(), number=number)
        state, _ = slam.step(state, other, CFG)
    end = finish(state, CFG)
    assert not end.located and end.submaps is learned.submaps
    assert np.isnan(trajectory(end)).all() and len(trajectory(end)) == CFG.loop.patience + 2


def test_what_was_good_is_not_that_of_an_earlier_time(learned, way_back, sequence):
    assert learned.good is None
    state = continued(learned._replace(good=learned.submap.learned), sequence.intrinsics)
    assert state.good is None
    # After a camera was only localised, it can be learned from again, also in a submap that rested
    resting = learned.submaps[1]._replace(learned=packed(learned.submaps[1].learned))
    state = state._replace(submaps=(learned.submaps[0], resting), active=SubmapId(0))
    state, info = localise(state, way_back[0], CFG)
    assert (info.found, state.active) == ("again", 1) and rests(state.submap.learned)
    after, _ = slam.step(state, way_back[1], CFG)
    assert not rests(after.submap.learned) and after.records[-1].status.trusted


def test_a_map_without_features_is_refused(learned, sequence):
    bare = [
        submap._replace(keyframes=tuple(k._replace(features=None) for k in submap.keyframes))
        for submap in learned.submaps
    ]
    with pytest.raises(InputError, match="without image features"):
        continued(learned._replace(submaps=tuple(bare)), sequence.intrinsics)


def test_another_camera_is_refused(learned, sequence):
    camera = sequence.intrinsics._replace(fx=sequence.intrinsics.fx + 1)
    with pytest.raises(InputError, match="one camera"):
        continued(learned, camera)
