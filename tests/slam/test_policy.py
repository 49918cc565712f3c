"""The decisions as tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mipsjax.config.sections import Config, KeyframeConfig, MapConfig
from mipsjax.config.tracking import GuardConfig, SearchConfig, TrackConfig
from mipsjax.slam.policy import Decision, FrameStats, converged, decide, widening
from mipsjax.submaps.state import Status
from mipsjax.submaps.switching import NEW, STAY, governor

CFG = Config(
    map=MapConfig(steps=10, steps_slow=4, motion=0.1),
    keyframe=KeyframeConfig(known=0.65, every_frames=3, translation=0.2, rotation=0.15),
    guard=GuardConfig(weak=0.6, lost=0.4),
    track=TrackConfig(ro=SearchConfig(widening=1.5, widening_limit=3.0)),
)
# An ordinary frame: all known, near the last keyframe, hardly moved
PLAIN = FrameStats(
    finite=True,
    measured=0.9,
    known=0.9,
    confirmed=0.8,
    open=0.002,
    astray=0.01,
    residual=0.01,
    least_residual=0.008,
    unsure=False,
    lost=0,
    since_keyframe=5,
    translation=0.05,
    rotation=0.02,
    step_translation=0.0,
    step_rotation=0.0,
)


@pytest.mark.parametrize(
    ("finite", "known", "status"),
    [
        (True, 1.0, Status.OK),
        (True, 0.6, Status.OK),
        (True, 0.59, Status.WEAK),
        (True, 0.4, Status.WEAK),
        (True, 0.39, Status.LOST),
        (True, 0.0, Status.LOST),
        (False, 1.0, Status.LOST),
        (False, float("nan"), Status.LOST),
    ],
)
def test_status(finite, known, status):
    assert decide(PLAIN._replace(finite=finite, known=known), CFG).status is status


def test_a_frame_that_fits_only_where_nothing_was_observed_is_lost():
    limit = CFG.guard.confirmed
    assert decide(PLAIN._replace(confirmed=limit), CFG).status is Status.OK
    assert decide(PLAIN._replace(confirmed=limit - 0.01), CFG).status is Status.LOST


@pytest.mark.parametrize(("least", "limit"), [(0.0, 0.01), (0.005, 0.01), (0.01, 0.015), (0.5, 0.02)])
def test_a_search_begins_above_the_noise_of_the_sensor(least, limit):
    """Never below the limit of its own, and at twice that at most."""
    search = replace(CFG.track.ro, residual=0.01, residual_margin=1.5)
    assert converged(least, replace(CFG, track=replace(CFG.track, ro=search))) == pytest.approx(limit)


def test_a_frame_that_fits_worse_than_the_sensor_explains_is_lost():
    assert decide(PLAIN._replace(residual=0.023), CFG).status is Status.OK
    assert decide(PLAIN._replace(residual=0.025), CFG).status is Status.LOST
    assert decide(PLAIN._replace(residual=0.025, least_residual=0.0), CFG).status is Status.OK, (
        "not known yet"
    )
    unsure = PLAIN._replace(unsure=True)
    assert decide(unsure._replace(residual=0.017), CFG).status is Status.OK
    assert decide(unsure._replace(residual=0.019), CFG).status is Status.LOST
    few, many = unsure._replace(lost=9), unsure._replace(lost=10)
    assert decide(few._replace(residual=0.017), CFG).status is Status.OK
    assert decide(many._replace(residual=0.011), CFG).status is Status.OK
    assert decide(many._replace(residual=0.013), CFG).status is Status.LOST
    assert decide(many._replace(residual=0.017, least_residual=0.012), CFG).status is Status.OK
    blind = replace(CFG, loop=replace(CFG.loop, relocalise=False))
    assert decide(many._replace(residual=0.017), blind).status is Status.OK, "nothing else would find it"
    noisy = PLAIN._replace(least_residual=0.02)
    assert decide(noisy._replace(residual=0.029), CFG).status is Status.OK
    assert decide(noisy._replace(residual=0.031), CFG).status is Status.LOST


def test_a_frame_with_hardly_any_depth_is_weak_and_teaches_nothing():
    few = PLAIN._replace(measured=0.049, translation=9.0)
    nothing = Decision(
        Status.WEAK, keyframe=False, map_steps=0, pose_rate=0.0, in_trouble=True, informative=False
    )
    assert decide(few, CFG) == nothing
    assert decide(few._replace(known=0.1), CFG).status is Status.LOST
    assert decide(few._replace(measured=0.051), CFG).status is Status.OK


@pytest.mark.parametrize(
    ("change", "keyframe"),
    [
        ({}, False),
        ({"translation": 0.25}, True),
        ({"rotation": 0.2}, True),
        ({"known": 0.64}, True),
        ({"known": 0.65}, False),
        ({"translation": 0.25, "since_keyframe": 2}, False),
        ({"translation": 0.25, "since_keyframe": 3}, True),
        ({"known": 0.5, "since_keyframe": 2}, False),
    ],
)
def test_keyframe(change, keyframe):
    assert decide(PLAIN._replace(**change), CFG).keyframe is keyframe


@pytest.mark.parametrize(
    ("translation", "rotation", "steps"),
    [(0.0, 0.0, 4), (0.05, 0.0, 7), (0.0, 0.05, 7), (0.05, 0.1, 10), (0.1, 0.0, 10), (9.0, 0.0, 10)],
)
def test_mapping_effort_grows_with_the_motion(translation, rotation, steps):
    stats = PLAIN._replace(step_translation=translation, step_rotation=rotation)
    assert decide(stats, CFG).map_steps == steps


def test_nothing_is_learned_from_a_lost_frame():
    decision = decide(PLAIN._replace(known=0.1, translation=9.0), CFG)
    assert decision.status is Status.LOST and not decision.keyframe and decision.map_steps == 0


def test_a_weak_frame_is_mapped():
    decision = decide(PLAIN._replace(known=0.5), CFG)
    assert decision.status is Status.WEAK and decision.keyframe and decision.map_steps > 0


@pytest.mark.parametrize(
    ("change", "status", "in_trouble"),
    [
        ({"open": 0.029, "astray": 0.09}, Status.OK, False),
        ({"open": 0.031}, Status.WEAK, True),
        # Held by what it sees, but since a slide nobody knows where: the next search need not be wider
        ({"astray": 0.11}, Status.WEAK, False),
    ],
)
def test_a_frame_that_may_be_elsewhere_is_weak(change, status, in_trouble):
    decision = decide(PLAIN._replace(**change), CFG)
    assert (decision.status, decision.in_trouble) == (status, in_trouble) and decision.informative


def test_the_papers_spacing_of_keyframes():
    cfg = replace(
        CFG, keyframe=replace(CFG.keyframe, every_frames=30, translation=float("inf"), rotation=float("inf"))
    )
    far = PLAIN._replace(known=0.62, translation=5.0, rotation=3.0)
    assert not decide(far._replace(since_keyframe=29), cfg).keyframe
    assert decide(far._replace(since_keyframe=30), cfg).keyframe
    assert not decide(far._replace(since_keyframe=30, known=0.7), cfg).keyframe


@pytest.mark.parametrize(
    ("trouble", "factor"), [(0, 1.0), (1, 1.5), (2, 2.25), (3, 3.0), (100, 3.0), (10_000, 3.0)]
)
@pytest.mark.fault(24)
def test_the_search_widens_with_trouble_up_to_a_limit(trouble, factor):
    assert widening(trouble, CFG) == pytest.approx(factor)


@pytest.mark.parametrize(
    ("active", "others", "expected"),
    [
        (0.9, {}, STAY),
        (0.75, {1: 1.0}, STAY),  # as long as the active one holds enough, nothing changes
        (0.74, {}, NEW),
        (0.74, {1: 0.7}, NEW),  # an old submap that holds too little itself is no way out
        (0.6, {1: 0.8, 2: 0.95}, 2),
        (0.74, {1: 0.80}, STAY),  # able, but not by the hysteresis: wait, rather than take turns
        (0.6, {3: 0.75}, 3),
        (0.0, {0: 1.0}, 0),
    ],
)
def test_which_submap_takes_over(active, others, expected):
    assert governor(active, others, 1.0, CFG) == expected


def test_a_view_that_fits_no_box_begins_no_submap_after_submap():
    assert governor(0.6, {}, 0.65, CFG) == STAY
    assert governor(0.5, {}, 0.65, CFG) == NEW


def test_two_submaps_do_not_take_turns():
    """Around the border either holds about as much: whoever is active stays so until the other is clearly better."""
    here, switches = 0, 0
    for share in 0.7 + 0.06 * np.sin(np.linspace(0, 40, 400)):
        shares = {0: share, 1: 1.45 - share}
        choice = governor(shares[here], {1 - here: shares[1 - here]}, 1.0, CFG)
        assert choice != NEW or max(shares.values()) < CFG.volume.overlap
        if choice in (0, 1):
            here, switches = choice, switches + 1
    assert switches <= 1
