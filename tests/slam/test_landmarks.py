"""Landmarks: which frames corners are followed from, where they say the camera is, and what tracking is given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mipsjax.config.sections import Config
from mipsjax.config.tracking import BrightnessConfig, CornerConfig, TrackConfig
from mipsjax.core import mapping
from mipsjax.core.rigid import distance
from mipsjax.core.volume import Box
from mipsjax.data.sequence import Frame
from mipsjax.images.corners import Corners
from mipsjax.slam.landmarks import corners_of, follow_all, images_of, landmarks, placed, with_corners
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import Keyframe, Pose, Record, SlamState, Status, Submap
from painted import CAMERA, painting, pose, wall

CFG = Config()
SIZE = CFG.track.corners.count * (1 + CFG.track.corners.keyframes)
LEARNED = mapping.Learned(None, None)  # type: ignore[arg-type]  # nothing here reads a map
BOX = Box(np.zeros(3), np.ones(3))
PAINTED = painting()
PATH = [pose((0, i, 0), (0.02 * i, 0, 0)) for i in range(6)]
"""A degree and 2 cm a frame."""


def frame(place: int, color: bool = True) -> Frame:
    grey, depth = wall(PATH[place], PAINTED)
    return Frame(place, place / 30, np.repeat(grey[..., None], 3, axis=2) if color else None, depth)


def own(place: int, cfg: Config = CFG, color: bool = True) -> Corners | None:
    return corners_of(frame(place, color), place, CAMERA, cfg)


def travelled(keyframes: tuple[int, ...], until: int, cfg: Config = CFG) -> SlamState:
    """After frames 0 to `until` at true poses, in one submap whose anchor is the first."""
    anchor = Keyframe(0, np.zeros((1, 1), np.float32), np.zeros((1, 1, 3), np.uint8), np.eye(4))
    state = SlamState((Submap(LEARNED, BOX, (anchor,), np.eye(4)),), 0, Records(), CAMERA, 0)
    for place in range(until + 1):
        record = Record(place, place / 30, 0, 0, PATH[place], Status.OK, is_keyframe=place in keyframes)
        found = follow_all(state, frame(place), PATH[max(place - 1, 0)], cfg)
        state = state.with_record(record)
        state = with_corners(state, own(place, cfg), found, cfg)
    return state


def test_the_last_frame_comes_first_then_the_newest_keyframe_and_the_oldest_ones():
    two = replace(CFG, track=TrackConfig(corners=CornerConfig(keyframes=2)))
    assert [c.record for c in travelled((0, 1, 2), until=4, cfg=two).corners] == [4, 2, 0]
    assert [c.record for c in travelled((0, 1, 4), until=4, cfg=two).corners] == [4, 1, 0]
    assert [c.record for c in travelled((0, 1, 2), until=4).corners] == [4, 2, 1, 0]


def test_a_keyframe_that_is_out_of_sight_is_let_go():
    """Not where nothing at all is seen, as in a blurred frame."""
    state = travelled((0, 1), until=3)
    found = follow_all(state, frame(4), PATH[3], CFG)
    assert [seen.reference.record for seen in found] == [3, 1, 0]
    record = state.records[-1]._replace(T_keyframe_cam=PATH[4])
    later = state.with_record(record)
    assert [c.record for c in with_corners(later, own(4), found[:2], CFG).corners] == [4, 1]
    assert [c.record for c in with_corners(later, own(4), [], CFG).corners] == [4, 1, 0]


def test_each_frame_says_where_the_camera_is():
    state = travelled((0, 2), until=4)
    found = follow_all(state, frame(5), PATH[4], CFG)
    assert len(found) == 3
    for seen in found:
        metres, radians = distance(PATH[5], seen.T_sub_cam)
        assert metres < 0.005 and radians < 0.003  # as in tests/host/test_corners.py


def test_frames_of_another_submap_say_nothing_unless_one_was_begun_from_the_other():
    state, T_old_new = travelled((0,), until=2), pose((0, 40, 0), (1, 0, 2))
    anchor = state.submap.keyframes[0]._replace(id=7)
    old = state.submap._replace(
        keyframes=(*state.submap.keyframes, anchor._replace(T_sub_cam=T_old_new)),
        T_world_sub=pose((0, 0, 9), (9, 0, 0)),  # what the pose graph says of it since
    )
    new = state.submap._replace(keyframes=(anchor,))
    expected = np.linalg.inv(T_old_new) @ PATH[2]
    for parent, count in ((None, 0), (0, 2)):
        elsewhere = state._replace(submaps=(old, new._replace(parent=parent)), active=1)
        found = follow_all(elsewhere, frame(3), expected, CFG)
        assert len(found) == count
        for seen in found:
            assert distance(np.linalg.inv(T_old_new) @ PATH[3], seen.T_sub_cam)[0] < 0.005


def test_without_colour_or_corners_there_is_nothing_to_follow():
    state = travelled((0,), until=2)
    assert follow_all(state, frame(3, color=False), PATH[2], CFG) == []
    assert own(3, color=False) is None and with_corners(state, None, [], CFG) is state
    none = replace(
        CFG, track=TrackConfig(corners=CornerConfig(count=0), brightness=BrightnessConfig(weight=0.0))
    )
    assert travelled((0,), until=2, cfg=none).corners == ()
    assert landmarks([], 4, CAMERA, none) is None


@pytest.mark.parametrize("keyframes", [0, 2])
def test_tracking_is_given_points_of_the_submap_where_they_are_seen(keyframes: int):
    cfg = replace(CFG, track=TrackConfig(corners=CornerConfig(keyframes=keyframes)))
    found = follow_all(travelled((0, 2), until=4, cfg=cfg), frame(5), PATH[4], cfg)
    given = landmarks(found, 1 + keyframes, CAMERA, cfg)
    assert given is not None and len(given.mask) == CFG.track.corners.count * (1 + keyframes)
    count = sum(len(seen.followed.pixel) for seen in found)
    assert np.sum(given.mask) == count > 100
    p_cam = (np.asarray(given.p_sub)[:count] - PATH[5][:3, 3]) @ PATH[5][:3, :3]
    off = p_cam[:, :2] / p_cam[:, 2:] - np.asarray(given.ray)[:count]
    # Followed to a fraction of a pixel, in frames whose poses are true
    assert np.median(np.abs(off)) * CAMERA.fx < 0.3


def test_no_landmarks_have_the_same_shape():
    given = landmarks([], 4, CAMERA, CFG)
    assert given is not None and given.p_sub.shape == (SIZE, 3) and not given.mask.any()


def test_where_the_camera_is_does_not_depend_on_a_turned_submap():
    """Points are in the frame of the submap, whatever that is."""
    T: Pose = pose((10, -20, 30), (1, 2, 3))
    state = travelled((0,), until=2)
    turned = state.with_submap(0, keyframes=(state.submap.keyframes[0]._replace(T_sub_cam=T),))
    (one, *_), (other, *_) = (
        follow_all(s, frame(3), start @ PATH[2], CFG) for s, start in ((state, np.eye(4)), (turned, T))
    )
    np.testing.assert_allclose(other.T_sub_cam, T @ one.T_sub_cam, atol=1e-3)


def test_tracking_is_given_images_of_earlier_frames_as_many_as_always():
    """Of fewer frames again, so that each point has an image; of none they say nothing."""
    state = travelled((0,), until=2)
    frames = placed(state, CFG)
    assert [reference.record for reference, _ in frames] == [2, 0]
    given, none = images_of(frames, 4, CAMERA, CFG), images_of([], 4, CAMERA, CFG)
    assert given is not None and none is not None
    assert given.mask.all() and not none.mask.any()
    assert [part.shape for part in given] == [part.shape for part in none]
    for place, record in enumerate((2, 0, 2, 0)):
        np.testing.assert_array_equal(given.grey[place], wall(PATH[record], PAINTED)[0])
        np.testing.assert_allclose(given.T_sub_cam[place], PATH[record], atol=1e-6)
    without = replace(CFG, track=TrackConfig(brightness=BrightnessConfig(weight=0.0)))
    assert images_of(frames, 4, CAMERA, without) is None


def test_brightness_alone_needs_no_corners():
    cfg = replace(CFG, track=TrackConfig(corners=CornerConfig(count=0)))
    state = travelled((0,), until=2, cfg=cfg)
    assert [len(kept.pixel) for kept in state.corners] == [0, 0]
    assert follow_all(state, frame(3), PATH[2], cfg) == []
    assert len(placed(state, cfg)) == 2
