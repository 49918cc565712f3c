"""The field: what its outputs may be, and its encodings against numpy."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax

from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import Encoding, FieldConfig
from mipsjax.core import field as nf
from mipsjax.core.encodings import ENCODINGS
from mipsjax.core.encodings.hashgrid import hash_features
from mipsjax.core.encodings.sinusoids import frequencies

SMALL = FieldConfig(
    encoding="both",
    octaves=6,
    longest_wavelength=8.0,
    hidden=(8,),
    hash_levels=3,
    hash_log2_entries=8,
    hash_features=2,
    hash_coarsest=0.4,
    hash_finest=0.1,
    hash_hidden=(8,),
    color_hidden=(8,),
)
REGRESSION = replace(SMALL, classification=False)
KEY = jax.random.key(5)
POINTS = np.random.default_rng(0).uniform(-4, 4, (200, 3)).astype(np.float32)
TAU = SMALL.truncation


@pytest.fixture(scope="module")
def field() -> nf.Field:
    return nf.init(KEY, SMALL)


def scaled(field: nf.Field, factor: float) -> nf.Field:
    return jax.tree.map(lambda a: factor * a, field)


def saying(outputs, cfg: FieldConfig) -> nf.Field:
    """A field whose networks have the same output everywhere."""

    def constant(net: nf.Net) -> nf.Net:
        return net._replace(
            weights=(*net.weights[:-1], jnp.zeros_like(net.weights[-1])),
            biases=(*net.biases[:-1], jnp.asarray(outputs, jnp.float32)),
        )

    field = nf.init(KEY, cfg)
    return field._replace(smooth=constant(field.smooth), fine=constant(field.fine))


def test_every_encoding_that_can_be_chosen_is_in_the_table():
    assert ENCODINGS.keys() == set(get_args(Encoding))


@pytest.mark.parametrize("name", ENCODINGS)
def test_an_encoding_is_as_wide_as_it_says(name):
    cfg = replace(SMALL, encoding=name)
    for encoding in [e for e in ENCODINGS[name] if e is not None]:
        encoded = encoding.apply(encoding.init(KEY, cfg), POINTS, cfg)
        assert encoded.shape == (len(POINTS), encoding.width(cfg))


@pytest.mark.parametrize("factor", [1.0, 10.0, 1e4])
@pytest.mark.parametrize("part", ["search", "whole"])
def test_distance_and_entropy_are_bounded(field, factor, part):
    made = nf.tsdf(scaled(field, factor), POINTS, SMALL, part)
    rounding = 1e-6
    assert np.abs(made.psi).max() <= TAU * (1 + rounding)
    assert made.entropy.min() >= -rounding and made.entropy.max() <= np.log(SMALL.classes) + rounding
    np.testing.assert_allclose(np.exp(made.logits).sum(1), 1, rtol=1e-5)


def test_an_even_distribution_knows_nothing():
    made = nf.tsdf(saying(np.full(5, 0.7), SMALL), POINTS, SMALL)
    np.testing.assert_allclose(made.psi, 0, atol=1e-8)
    np.testing.assert_allclose(made.entropy, np.log(5), rtol=1e-6)


def test_distance_and_entropy_against_the_definition():
    """Eq. 2 and the entropy of Section 3.1."""
    z, cfg = np.array([0.3, -1.2, 0.8, 0.1, -0.4]), replace(SMALL, coldness=2.5)
    made = nf.tsdf(saying(z, cfg), POINTS[:3], cfg)
    p = softmax(2.5 * z)
    np.testing.assert_allclose(made.psi, p @ [-0.1, -0.05, 0, 0.05, 0.1], rtol=1e-5)
    np.testing.assert_allclose(made.entropy, -np.sum(p * np.log(p)), rtol=1e-5)


def test_the_papers_normalised_outputs():
    z, cfg = np.array([0.3, -1.2, 0.8, 0.1, -0.4]), replace(SMALL, coldness=10.0, normalised=True)
    p = softmax(10 / (1 + np.exp(-z)))
    made = nf.tsdf(saying(z, cfg), POINTS[:3], cfg)
    np.testing.assert_allclose(made.psi, p @ [-0.1, -0.05, 0, 0.05, 0.1], rtol=1e-5)


@pytest.mark.parametrize("factor", [1.0, 1e4])
def test_regression_is_bounded_and_always_certain(factor):
    made = nf.tsdf(scaled(nf.init(KEY, REGRESSION), factor), POINTS, REGRESSION)
    assert np.abs(made.psi).max() <= TAU * (1 + 1e-6)
    np.testing.assert_array_equal(made.entropy, np.ones(len(POINTS)))
    assert made.logits.shape == (len(POINTS), 1)


def test_colors_are_between_0_and_1(field):
    rgb = nf.color(scaled(field, 100.0), POINTS, SMALL)
    assert rgb.shape == (len(POINTS), 3) and rgb.min() >= 0 and rgb.max() <= 1


def test_the_parts_of_a_double_field(field):
    search, whole = nf.tsdf(field, POINTS, SMALL, "search"), nf.tsdf(field, POINTS, SMALL, "whole")
    np.testing.assert_array_equal(search.psi, nf.smooth_tsdf(field, POINTS, SMALL).psi)
    np.testing.assert_array_equal(whole.psi, nf.tsdf(field, POINTS, SMALL).psi)


@pytest.mark.parametrize("encoding", ["frequency", "hash", "joint"])
def test_a_single_field_has_one_answer(encoding):
    cfg = replace(SMALL, encoding=encoding)
    field = nf.init(KEY, cfg)
    np.testing.assert_array_equal(
        nf.tsdf(field, POINTS, cfg, "search").psi, nf.tsdf(field, POINTS, cfg, "whole").psi
    )


@pytest.mark.parametrize("name", PRESETS)
def test_every_submap_of_a_config_has_the_same_shapes_and_is_small(name):
    cfg = PRESETS[name].field
    one, other = (jax.eval_shape(lambda k: nf.init(k, cfg), jax.random.key(s)) for s in (0, 1))
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert [(a.shape, a.dtype) for a in jax.tree.leaves(one)] == [
        (a.shape, a.dtype) for a in jax.tree.leaves(other)
    ]
    size = sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(one))
    assert size < (1e6 if cfg.encoding == "frequency" else 4e6)


def test_parameters_depend_on_the_key_alone(field):
    again, other = nf.init(KEY, SMALL), nf.init(jax.random.key(6), SMALL)
    assert all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (field, again)), strict=True))
    assert not np.array_equal(field.fine.weights[0], other.fine.weights[0])


def test_sinusoids_against_double_precision():
    encoded = np.asarray(frequencies(POINTS, SMALL), np.float64)
    assert encoded.shape == (len(POINTS), 3 + 6 * SMALL.octaves)
    np.testing.assert_array_equal(encoded[:, :3], POINTS)
    for octave in range(SMALL.octaves):
        angle = 2**octave * POINTS.astype(np.float64) * (2 * np.pi / SMALL.longest_wavelength)
        got = encoded[:, 3 + 6 * octave : 9 + 6 * octave]
        # The polynomial is good to 1e-7; rounding of the angle doubles with every octave
        np.testing.assert_allclose(
            got, np.concatenate([np.sin(angle), np.cos(angle)], 1), atol=2**octave * 3e-7 + 1e-7
        )


def test_derivatives_of_the_sinusoids():
    def total(points):
        return jnp.sum(frequencies(points, SMALL)[:, 3:9], -1)  # of the first octave

    slope = 2 * np.pi / SMALL.longest_wavelength
    points = POINTS.astype(np.float64)
    expected = slope * (np.cos(slope * points) - np.sin(slope * points))
    got = jax.vmap(jax.grad(lambda p: total(p[None])[0]))(jnp.asarray(POINTS))
    # The derivative of the polynomial is ten times worse than the polynomial
    np.testing.assert_allclose(got, expected, atol=slope * 1e-5)


# The spatial hash of Teschner et al. 2003 with the constants of Mueller et al. 2022, in plain Python integers
PRIMES = (1, 2654435761, 805459861)


def entry(corner, entries: int) -> int:
    mixed = 0
    for c, prime in zip(corner, PRIMES, strict=True):
        mixed ^= (int(c) % 2**32) * prime % 2**32
    return mixed % entries


def trilinear(table: np.ndarray, point: np.ndarray, cell: float) -> np.ndarray:
    """Features (F) of one level at one point."""
    scaled_point = point.astype(np.float64) / cell
    base = np.floor(scaled_point)
    offset, out = scaled_point - base, np.zeros(table.shape[1])
    for corner in product((0, 1), repeat=3):
        weight = np.prod(np.where(corner, offset, 1 - offset))
        out += weight * table[entry(base + corner, len(table))]
    return out


def random_table(cfg: FieldConfig) -> np.ndarray:
    shape = (cfg.hash_levels, 2**cfg.hash_log2_entries, cfg.hash_features)
    return np.random.default_rng(1).normal(size=shape).astype(np.float32)


def test_hash_features_against_plain_python():
    table = random_table(SMALL)
    cells = np.geomspace(SMALL.hash_coarsest, SMALL.hash_finest, SMALL.hash_levels)
    encoded = np.asarray(hash_features(table, POINTS, SMALL))
    for point, row in zip(POINTS[:60], encoded, strict=False):
        expected = [trilinear(level, point, cell) for level, cell in zip(table, cells, strict=True)]
        # The order of the features within a row is the encoding's own affair. A coordinate is up to 40 cells:
        # its place in the cell is known to 40 * 2^-24, and neighbouring entries differ by up to about 6.
        np.testing.assert_allclose(np.sort(row), np.sort(np.ravel(expected)), atol=5e-5)


ONE_LEVEL = replace(
    SMALL, hash_levels=1, hash_coarsest=0.25, hash_finest=0.25
)  # a power of two: exact in float32


def test_a_corner_of_a_cell_has_the_features_of_its_entry():
    table = random_table(ONE_LEVEL)
    corners = np.array(list(product((-3, 0, 5), repeat=3)))
    encoded = hash_features(table, (corners * 0.25).astype(np.float32), ONE_LEVEL)
    expected = [table[0, entry(corner, table.shape[1])] for corner in corners]
    np.testing.assert_allclose(encoded, expected, atol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("border", [-0.5, 0.0, 0.75])
def test_hash_features_are_continuous_across_cell_borders(axis, border):
    table, step = random_table(ONE_LEVEL), 1e-6
    before = np.random.default_rng(2).uniform(-1, 1, (50, 3)).astype(np.float32)
    after = before.copy()
    before[:, axis], after[:, axis] = border - step, border + step
    jump = hash_features(table, after, ONE_LEVEL) - hash_features(table, before, ONE_LEVEL)
    steepest = np.ptp(table) / 0.25
    assert np.abs(jump).max() <= 2 * step * steepest + 1e-6


def test_the_gradient_of_hash_features_is_numerical():
    table, step = random_table(ONE_LEVEL), 0.01
    cell = np.random.default_rng(3).integers(-6, 6, (40, 3))
    points = (0.25 * (cell + np.random.default_rng(4).uniform(0.1, 0.9, (40, 3)))).astype(np.float32)
    gradient = jax.grad(lambda p: jnp.sum(hash_features(table, p, ONE_LEVEL)))(points)
    for axis in range(3):
        shift = np.zeros(3, np.float32)
        shift[axis] = step
        rise = hash_features(table, points + shift, ONE_LEVEL) - hash_features(
            table, points - shift, ONE_LEVEL
        )
        # Linear along each axis within a cell, so that only rounding separates the two: 1e-6 over 0.02
        np.testing.assert_allclose(gradient[:, axis], rise.sum(1) / (2 * step), atol=2e-3)


def test_the_gradient_of_the_table_shares_one_among_eight_corners():
    gradient = jax.grad(lambda t: jnp.sum(hash_features(t, POINTS[:1], SMALL)))(random_table(SMALL))
    np.testing.assert_allclose(gradient.sum(1), np.ones((SMALL.hash_levels, SMALL.hash_features)), rtol=1e-5)
    assert gradient.min() >= 0 and ((gradient > 0).sum(1) <= 8).all()


def test_the_gradient_of_the_distance_is_numerical():
    cfg = replace(SMALL, encoding="frequency", octaves=3)
    field, step = nf.init(KEY, cfg), 1e-3

    def psi(p):
        return nf.tsdf(field, p, cfg).psi

    gradient = jax.grad(lambda p: jnp.sum(psi(p)))(POINTS)
    for axis in range(3):
        shift = np.zeros(3, np.float32)
        shift[axis] = step
        rise = (psi(POINTS + shift) - psi(POINTS - shift)) / (2 * step)
        # A ReLU that switches between the two points spoils a few; psi itself is rounded to 1e-8
        assert np.quantile(np.abs(gradient[:, axis] - rise), 0.95) < 2e-4


@pytest.mark.parametrize("feature", range(SMALL.hash_features))
def test_the_gradient_of_the_table_is_the_transpose_of_reading_it(feature):
    # Many points to an entry, and another weight for every feature of each
    weight = np.random.default_rng(5).normal(size=(len(POINTS), SMALL.hash_levels * SMALL.hash_features))
    table, change = random_table(SMALL), np.zeros_like(random_table(SMALL))
    change[..., feature] = np.random.default_rng(6).normal(size=change.shape[:2])
    gradient = jax.grad(lambda t: jnp.sum(weight * hash_features(t, POINTS, SMALL)))(table)
    read = weight * hash_features(change, POINTS, SMALL)
    np.testing.assert_allclose(np.sum(gradient * change), np.sum(read), rtol=1e-4, atol=1e-3)
