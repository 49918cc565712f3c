"""Boxes of submaps: growth within a limit, what a frame sees, shares of points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from corner import CAMERA, HOME, see
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mipsjax.config.submaps import VolumeConfig
from mipsjax.core import volume
from mipsjax.core.rigid import transform
from mipsjax.core.volume import Box, contained, grow, inside, seen

CFG = VolumeConfig(governs="depth", far=5.0, max_side=7.0, margin=0.0)
ROUNDING = 1e-12  # metres; coordinates are below 100 m, with 2e-14 in the last place
COUNT = 6
POINTS = arrays(np.float64, (COUNT, 3), elements=st.floats(-10, 10))
NEAR_POINTS = arrays(np.float64, (COUNT, 3), elements=st.floats(-3, 3))
MASK = arrays(np.bool_, COUNT)
ALL = np.ones(COUNT, bool)


def sides(box: Box) -> np.ndarray:
    return box.hi - box.lo


def encloses(outer: Box, inner: Box) -> bool:
    return bool((outer.lo <= inner.lo).all() and (outer.hi >= inner.hi).all())


@given(POINTS, POINTS, MASK, st.sampled_from([0.0, 0.1]))
def test_growing_never_shrinks_and_never_exceeds_the_limit(first, more, mask, margin):
    cfg = replace(CFG, margin=margin)
    small = grow(None, first, ALL, cfg)
    large = grow(small, more, mask, cfg)
    assert encloses(large, small)
    for box in (small, large):
        assert (sides(box) >= 0).all() and (sides(box) <= cfg.max_side + ROUNDING).all()


@given(NEAR_POINTS, NEAR_POINTS, MASK)
def test_within_the_limit_everything_is_inside_and_nothing_more_is_taken(first, more, mask):
    box = grow(grow(None, first, ALL, CFG), more, mask, CFG)
    assert contained(box, first, ALL) == contained(box, more, mask) == 1.0
    kept = np.concatenate([first, more[mask]])
    np.testing.assert_array_equal(box, [kept.min(0), kept.max(0)])  # the least box, without any rounding


@given(POINTS, POINTS, MASK)
def test_growing_twice_for_the_same_points_changes_nothing(first, more, mask):
    once = grow(grow(None, first, ALL, CFG), more, mask, CFG)
    np.testing.assert_allclose(grow(once, more, mask, CFG), once, atol=ROUNDING)


@given(POINTS, POINTS, POINTS)
def test_containment_grows_with_the_box(first, more, points):
    small = grow(None, first, ALL, CFG)
    assert contained(grow(small, more, ALL, CFG), points, ALL) >= contained(small, points, ALL)


def test_a_side_grows_to_exactly_the_limit_where_it_is_needed():
    box = Box(np.zeros(3), np.full(3, 5.0))
    far = grow(box, np.array([[9.0, 1.0, -9.0]]), np.ones(1, bool), CFG)
    np.testing.assert_allclose(far, [[0, 0, -2], [7, 5, 5]], atol=ROUNDING)


def test_two_ends_share_what_is_left_by_their_need():
    box = Box(np.zeros(3), np.full(3, 5.0))
    both = grow(box, np.array([[-3.0, 1, 1], [6.0, 1, 1]]), np.ones(2, bool), CFG)  # 3 and 1 wanted, 2 free
    np.testing.assert_allclose([both.lo[0], both.hi[0]], [-1.5, 5.5], atol=ROUNDING)


def test_a_first_box_beyond_the_limit_stays_by_the_camera():
    points = np.array([[-1.0, 2.0, 0.5], [1.0, 30.0, 9.5]])
    box = grow(None, points, np.ones(2, bool), CFG)
    np.testing.assert_allclose(box, [[-1, 2, 0.5], [1, 9, 7.5]], atol=ROUNDING)


def test_the_margin_is_added_on_every_side():
    box = grow(None, np.ones((1, 3)), np.ones(1, bool), replace(CFG, margin=0.2))
    np.testing.assert_allclose(box, [[0.8] * 3, [1.2] * 3], atol=ROUNDING)


def test_a_box_larger_than_the_limit_is_left_alone():
    box = Box(np.zeros(3), np.full(3, 9.0))
    np.testing.assert_array_equal(grow(box, np.full((1, 3), 20.0), np.ones(1, bool), CFG), box)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((2, 3), np.nan), np.full((2, 3), np.inf)])
def test_nothing_seen(points):
    mask, box = np.ones(len(points), bool), Box(-np.ones(3), np.ones(3))
    np.testing.assert_array_equal(grow(box, points, mask, CFG), box)
    np.testing.assert_array_equal(grow(None, points, mask, CFG), np.zeros((2, 3)))
    assert contained(box, points, mask) == 1.0


def test_masked_and_broken_points_do_not_count():
    points = np.array([[0.0, 0, 0], [9.0, 9, 9], [np.nan, 0, 0], [0.5, 0.5, 2.0]])
    mask = np.array([True, False, True, True])
    box = Box(-np.ones(3), np.ones(3))
    assert contained(box, points, mask) == 0.5
    np.testing.assert_array_equal(grow(box, points, mask, CFG), [[-1, -1, -1], [1, 1, 2]])


def test_faces_belong_to_a_box_and_nan_does_not():
    points = np.array([[1.0, 0, 0], [1 + 1e-9, 0, 0], [np.nan, 0, 0]])
    np.testing.assert_array_equal(inside(Box(-np.ones(3), np.ones(3)), points), [True, False, False])


def test_what_is_seen_has_the_same_size_whatever_was_measured():
    depth = see(HOME)[0]
    for governs in ("frustum", "depth", "surface"):
        cfg = replace(CFG, governs=governs)
        shapes = {tuple(a.shape for a in seen(d, CAMERA, cfg)) for d in (depth, 0 * depth)}
        assert len(shapes) == 1


def test_the_frustum_reaches_far_whatever_was_measured():
    cfg = replace(CFG, governs="frustum")
    full, none = (seen(d, CAMERA, cfg) for d in (see(HOME)[0], np.zeros((96, 128), np.float32)))
    np.testing.assert_array_equal(full.p_cam, none.p_cam)
    assert full.mask.all() and none.mask.all()
    # The four corners of the image at the far plane, by the pinhole equation
    corners = np.array([[(u - 63.5) / 105 * 5, (v - 47.5) / 105 * 5, 5] for v in (0, 95) for u in (0, 127)])
    box = grow(None, full.p_cam, full.mask, cfg)
    np.testing.assert_allclose(box.hi, corners.max(0), atol=ROUNDING)
    np.testing.assert_allclose(box.lo, [*corners.min(0)[:2], 5 / volume.DEPTHS], atol=ROUNDING)


@pytest.mark.parametrize("governs", ["depth", "surface"])
def test_nothing_is_seen_without_depth(governs):
    depth = np.array([0.0, np.nan, np.inf, -1.0], np.float32)[np.arange(96 * 128) % 4].reshape(96, 128)
    view = seen(depth, CAMERA, replace(CFG, governs=governs))
    assert not view.mask.any() and np.isfinite(view.p_cam).all()


def test_depth_and_surface_end_at_the_measured_surface():
    """The corner of a room: its walls are the farthest that is seen, and all points on them by `surface`."""
    surface, depth = (seen(see(HOME)[0], CAMERA, replace(CFG, governs=g)) for g in ("surface", "depth"))
    on_walls = np.abs(transform(HOME, surface.p_cam) - [-1.2, 0.9, 2.0]).min(1)
    assert surface.mask.all() and on_walls.max() < 1e-5  # depth is in single precision
    np.testing.assert_allclose(depth.p_cam.reshape(-1, volume.DEPTHS, 3)[:, -1], surface.p_cam)
    within = transform(HOME, depth.p_cam)
    assert (within[:, 0] > -1.2001).all() and (within[:, 1] < 0.9001).all() and (within[:, 2] < 2.0001).all()


def test_beyond_the_far_plane_depth_is_cut_and_surface_is_none():
    depth = np.full((96, 128), 6.0, np.float32)
    assert not seen(depth, CAMERA, replace(CFG, governs="surface")).mask.any()
    cut = seen(depth, CAMERA, replace(CFG, governs="depth"))
    assert cut.mask.all() and cut.p_cam[:, 2].max() == 5.0
