"""Depths along rays and their labels: bounds, masks, signs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.config.sections import SampleConfig
from mipsjax.core import sampling

TAU = 0.1
KEY = jax.random.key(3)
CFG = SampleConfig(uniform=7, truncation=5, surface=4, surface_spread=0.03)
# No measurement, nearer than the truncation, and ordinary ones
MEASURED = np.array([0.0, 0.06, 0.5, 2.0, 7.9], np.float32)
JITTER = np.random.default_rng(0).random((len(MEASURED), CFG.surface), np.float32)
ROUNDING = 1e-5  # metres; a depth below 8 m has a unit in the last place of 5e-7


def test_stratified_draws_one_in_each_part():
    lo, hi, count = np.array([0.0, -1.0, 2.0], np.float32), np.array([1.0, 3.0, 2.0], np.float32), 10
    draws = np.asarray(sampling.stratified(KEY, lo, hi, count))
    edges = lo[:, None] + (hi - lo)[:, None] * np.arange(count + 1) / count
    assert (draws >= edges[:, :-1] - ROUNDING).all() and (draws <= edges[:, 1:] + ROUNDING).all()
    assert (np.diff(draws) >= -ROUNDING).all()


def test_stratified_rays_and_keys_differ():
    lo, hi = jnp.zeros(2), jnp.ones(2)
    draws = sampling.stratified(KEY, lo, hi, 6)
    assert (draws[0] != draws[1]).any()
    assert (draws != sampling.stratified(jax.random.key(4), lo, hi, 6)).any()
    np.testing.assert_array_equal(draws, sampling.stratified(KEY, lo, hi, 6))


def test_first_phase_covers_free_space_then_the_truncation_region():
    depth = np.asarray(sampling.first_phase(KEY, MEASURED, TAU, CFG))
    assert depth.shape == (len(MEASURED), CFG.uniform + CFG.truncation)
    far, near = MEASURED[:, None] + TAU, np.maximum(MEASURED - TAU, sampling.NEAR)[:, None]
    uniform, close = depth[:, : CFG.uniform], depth[:, CFG.uniform :]
    assert (uniform >= sampling.NEAR - ROUNDING).all() and (uniform <= far + ROUNDING).all()
    assert (close >= near - ROUNDING).all() and (close <= far + ROUNDING).all()
    assert (np.diff(uniform) >= -ROUNDING).all() and (np.diff(close) >= -ROUNDING).all()


def test_second_phase_gathers_round_the_smallest_distance():
    first = sampling.first_phase(KEY, MEASURED, TAU, CFG)
    surface = MEASURED[:, None] + 0.02
    depth = np.asarray(sampling.second_phase(JITTER, first, lambda d: surface - d, CFG))
    np.testing.assert_array_equal(depth[:, : first.shape[1]], first)
    extra = depth[:, first.shape[1] :]
    assert extra.shape == (len(MEASURED), CFG.surface)
    closest = np.take_along_axis(np.asarray(first), np.argmin(np.abs(surface - first), 1)[:, None], 1)
    assert (np.abs(extra - closest) <= CFG.surface_spread + ROUNDING).all()
    assert (extra >= sampling.NEAR - ROUNDING).all()


def test_second_phase_can_be_left_out():
    first = sampling.first_phase(KEY, MEASURED, TAU, CFG)
    none = SampleConfig(surface=0)
    np.testing.assert_array_equal(sampling.second_phase(JITTER[:, :0], first, lambda d: d, none), first)


@pytest.mark.parametrize("slope", [1.0, 0.4])
def test_labels(slope):
    depth = sampling.first_phase(KEY, MEASURED, TAU, CFG)
    samples = jax.tree.map(np.asarray, sampling.label(depth, MEASURED, jnp.full(5, slope), TAU))
    in_front = MEASURED[:, None] - np.asarray(depth)
    assert not (samples.near & samples.free).any()
    assert not samples.near[0].any() and not samples.free[0].any(), "no measurement, no supervision"
    measured = MEASURED[:, None] > 0
    np.testing.assert_array_equal(samples.free, measured & (in_front > TAU))
    np.testing.assert_array_equal(samples.near, measured & (np.abs(in_front) <= TAU))
    assert (np.sign(samples.target) == np.sign(in_front)).all(), "positive in front, negative behind"
    np.testing.assert_allclose(samples.target, np.clip(in_front * slope, -TAU, TAU), atol=ROUNDING)


def test_nothing_is_known_behind_the_truncation_region():
    depth, measured = jnp.array([[1.0, 1.05, 1.2, 3.0]]), jnp.array([1.0])
    samples = sampling.label(depth, measured, jnp.ones(1), TAU)
    np.testing.assert_array_equal(samples.near | samples.free, [[True, True, False, False]])
