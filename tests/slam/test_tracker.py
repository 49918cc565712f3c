"""One frame in the active submap: what its pose follows where nothing holds it."""

from __future__ import annotations

import numpy as np
import pytest

import maps
from mipsjax.config.sections import Config
from mipsjax.core.information import Information
from mipsjax.core.tracking import TrackInfo
from mipsjax.data.sequence import Frame
from mipsjax.images.corners import Corners
from mipsjax.slam.landmarks import Seen
from mipsjax.slam.tracker import _believed, _information, _reference, coasting
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import SlamState, Status
from mipsjax.uncertainty.held import NONE, Directions, Gains, at

CFG = Config()
T_EXPECTED = maps.pose((10.0, 20.0, 30.0), (1.0, 2.0, 3.0))


@pytest.mark.parametrize(("open_m", "followed"), [(0.005, 0.0), (0.02, 0.75), (1.0, 1.0)])
def test_along_what_measurements_leave_loose_a_frame_goes_on_as_far_as_that_says_more(open_m, followed):
    found = T_EXPECTED @ maps.pose(translation=(0.05, 0.03, 0.0))
    deviation = np.array([*[0.001] * 5, open_m])
    together = Directions(deviation, np.roll(np.eye(6), -1, axis=0))
    share = np.diag([1 - followed, *[0.9] * 5])
    moved = _believed(found, T_EXPECTED, together, Gains(share, share / 2), CFG)
    left, going = ((np.linalg.inv(T_EXPECTED) @ T)[:3, 3] for T in moved)
    # Where it is firmly held it is where it was found, also where the motion before would have a word
    np.testing.assert_allclose(left, [0.05 * (1 - followed), 0.03, 0.0], atol=1e-12)
    np.testing.assert_allclose(going[0], left[0] / 2 if followed else 0.05, atol=1e-12)


def test_a_camera_that_may_be_elsewhere_is_measured_against_the_frame_before():
    """Not against a keyframe that only seems near, unless its corners are seen or the frame before taught nothing."""
    loose = 0.05**2 * np.eye(6)
    sure, unsure = (at(metres**2 * np.eye(6), np.eye(4)) for metres in (0.03, 0.5))
    keyframes = [maps.keyframe(0), maps.keyframe(1)._replace(covariance=loose)]
    state: SlamState = maps.state(maps.submap(*keyframes))
    reference = Corners(1, *[np.zeros(0)] * 5)  # pyright: ignore[reportArgumentType]
    seen = Seen(reference, np.eye(4), None)  # pyright: ignore[reportArgumentType]
    for held, status, found, expected in (
        (sure, Status.OK, [], NONE),
        (unsure, Status.OK, [], None),
        (unsure, Status.OK, [seen], loose),
        # What has passed since it was known taught the map nothing
        (unsure, Status.SKIPPED, [], unsure.covariance),
    ):
        known = state.records[-1]._replace(held=held)
        records = (known, known._replace(status=status, held=at(np.eye(6), np.eye(4))))
        records = records[:1] if status is Status.OK else records
        there = _reference(state._replace(records=Records.of(records)), keyframes, found, CFG)
        assert (there is None) == (expected is None)
        np.testing.assert_array_equal(
            NONE if there is None else there, NONE if expected is None else expected
        )


def test_a_camera_that_nobody_sees_may_be_anywhere_soon():
    state: SlamState = maps.state(maps.submap(maps.keyframe(0)))
    deviations = []
    for place in range(1, 31):
        held = coasting(state, Frame(place, place / 30, None, None), CFG)
        deviations.append(float(np.sqrt(held.covariance[0, 0])))
        record = state.records[-1]._replace(timestamp=place / 30, status=Status.LOST, held=held)
        state = state.with_record(record)
    assert np.all(np.diff(deviations) > 0) and 0.5 < deviations[-1] < 5.0  # of a second, in metres


def test_a_frame_that_is_not_finite_says_nothing():
    held = [np.full((6, 6), np.nan, np.float32), *2 * [np.eye(6, dtype=np.float32)]]
    information = Information(*held, np.zeros(6), np.zeros(6))  # pyright: ignore[reportArgumentType]
    info = TrackInfo(None, None, information, None, None)  # pyright: ignore[reportArgumentType]
    surfaces, colour = _information(info, CFG)
    np.testing.assert_array_equal(surfaces, NONE)
    by_both = 1 / CFG.track.held.corners + 1 / CFG.track.held.brightness
    np.testing.assert_allclose(colour, by_both * np.eye(6))
