"""Every loss against a plain loop over the paper's equation, and at its edges."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit, log_softmax

from mipsjax.config.sections import FieldConfig
from mipsjax.core import losses
from mipsjax.core.field import Tsdf

CFG = FieldConfig(encoding="frequency", truncation=0.1, classes=5, classification=True)
REGRESSION = FieldConfig(encoding="frequency", classification=False)
TAU, LABELS = 0.1, np.linspace(-0.1, 0.1, 5)
RAYS, SAMPLES = 6, 8
# Sums of about 50 numbers in float32 against float64
TOLERANCE = {"rtol": 1e-5, "atol": 1e-8}


@pytest.fixture(scope="module")
def draws():
    """Predictions, targets and masks. Every ray has as many samples as the others: the paper's mean over rays
    of means over samples is then the mean over all samples that the code takes."""
    rng = np.random.default_rng(0)
    near = np.zeros((RAYS, SAMPLES), bool)
    near[:, 3:] = True
    return {
        "psi": rng.uniform(-TAU, TAU, (RAYS, SAMPLES)).astype(np.float32),
        "target": rng.uniform(-TAU, TAU, (RAYS, SAMPLES)).astype(np.float32),
        "logits": log_softmax(rng.normal(size=(RAYS * SAMPLES, 5)), -1).astype(np.float32),
        "values": rng.random((RAYS, SAMPLES, 3)).astype(np.float32),
        "depth": rng.uniform(0.5, 3, (RAYS, SAMPLES)).astype(np.float32),
        "near": near,
    }


def prediction(logits) -> Tsdf:
    logits = jnp.asarray(logits, jnp.float32)
    p = jnp.exp(logits)
    return Tsdf(p @ jnp.asarray(LABELS, jnp.float32), -jnp.sum(p * logits, -1), logits)


def mean_over_rays(term, near) -> float:
    """1 / |P| sum over rays of 1 / |S_p| sum over samples, as in Eqs. 9 to 12."""
    total = 0.0
    for p in range(RAYS):
        inside = [s for s in range(SAMPLES) if near[p, s]]
        total += sum(term(p, s) for s in inside) / len(inside)
    return total / RAYS


def test_d2t(draws):
    psi, mask = draws["psi"][:, 0], np.array([1, 1, 0, 1, 0, 1], bool)
    expected = sum(float(x) ** 2 for x, m in zip(psi, mask, strict=True) if m) / mask.sum()
    np.testing.assert_allclose(losses.d2t(psi, mask), expected, **TOLERANCE)


def test_truncation_region(draws):
    psi, target, near = draws["psi"], draws["target"], draws["near"]
    expected = mean_over_rays(lambda p, s: (float(psi[p, s]) - float(target[p, s])) ** 2, near)
    np.testing.assert_allclose(losses.distance(psi, target, near), expected, **TOLERANCE)


def test_free_space(draws):
    psi, free = draws["psi"], ~draws["near"]
    expected = mean_over_rays(lambda p, s: (float(psi[p, s]) - TAU) ** 2, free)
    np.testing.assert_allclose(losses.distance(psi, np.full_like(psi, TAU), free), expected, **TOLERANCE)


def test_earth_movers_distance(draws):
    logits, target, near = draws["logits"].reshape(RAYS, SAMPLES, 5), draws["target"], draws["near"]

    def term(p, s):
        label = min(range(5), key=lambda i: abs(LABELS[i] - target[p, s]))
        return sum(np.exp(float(logits[p, s, i])) * abs(i - label) for i in range(5))

    value = losses.emd(prediction(draws["logits"]), target.ravel(), near.ravel(), CFG)
    np.testing.assert_allclose(value, mean_over_rays(term, near), **TOLERANCE)


def two_hot(target: float) -> np.ndarray:
    """Weights of the two classes around the target."""
    upper = min(max(int(np.searchsorted(LABELS, target)), 1), 4)
    share = (target - LABELS[upper - 1]) / (LABELS[upper] - LABELS[upper - 1])
    weights = np.zeros(5)
    weights[upper - 1], weights[upper] = 1 - share, share
    return weights


def test_two_hot_cross_entropy(draws):
    logits, target, near = draws["logits"].reshape(RAYS, SAMPLES, 5), draws["target"], draws["near"]
    value = losses.cross_entropy(prediction(draws["logits"]), target.ravel(), near.ravel(), CFG)
    expected = mean_over_rays(lambda p, s: -float(two_hot(float(target[p, s])) @ logits[p, s]), near)
    np.testing.assert_allclose(value, expected, **TOLERANCE)


@pytest.mark.parametrize("target", [-0.1, -0.07, 0.0, 0.024, 0.1])
def test_the_two_hot_distribution_is_the_best_and_has_the_targets_mean(target):
    """The cross entropy is least, and its gradient zero, where psi is the target exactly."""
    weights = two_hot(target)
    assert weights @ LABELS == pytest.approx(target, abs=1e-12)
    # A probability of exactly zero has no logarithm: 1e-9 stands for it
    logits = np.log(np.maximum(weights, 1e-9))[None]

    def loss(z):
        log_p = jax.nn.log_softmax(z)
        return losses.cross_entropy(
            Tsdf(log_p[:, 0], log_p[:, 0], log_p), jnp.array([target], jnp.float32), jnp.ones(1, bool), CFG
        )

    entropy = -np.sum(weights * np.log(np.maximum(weights, 1e-9)))
    value, gradient = jax.value_and_grad(loss)(jnp.asarray(logits, jnp.float32))
    np.testing.assert_allclose(value, entropy, atol=1e-5)
    np.testing.assert_allclose(gradient, np.zeros((1, 5)), atol=1e-5)


def test_rendering_weights(draws):
    psi, near = draws["psi"], draws["near"]
    weights = np.asarray(losses.render_weights(psi, near, TAU))
    for p in range(RAYS):
        raw = [expit(psi[p, s] / TAU) * expit(-psi[p, s] / TAU) * near[p, s] for s in range(SAMPLES)]
        np.testing.assert_allclose(weights[p], np.array(raw) / sum(raw), **TOLERANCE)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-6)


def test_the_weight_is_largest_at_the_surface_and_nothing_outside():
    psi = jnp.array([[0.1, 0.05, 0.0, -0.05, -0.1]])
    weights = losses.render_weights(psi, jnp.array([[False, True, True, True, True]]), TAU)
    assert int(jnp.argmax(weights)) == 2
    assert float(weights[0, 0]) == 0
    np.testing.assert_allclose(weights[0, 1], weights[0, 3], rtol=1e-6)


def test_rendered_color_and_depth(draws):
    weights = losses.render_weights(draws["psi"], draws["near"], TAU)
    color, depth = losses.render(weights, draws["values"]), losses.render(weights, draws["depth"])
    w = np.asarray(weights, np.float64)
    for p in range(RAYS):
        np.testing.assert_allclose(
            color[p], sum(w[p, s] * draws["values"][p, s] for s in range(SAMPLES)), **TOLERANCE
        )
        np.testing.assert_allclose(
            depth[p], sum(w[p, s] * draws["depth"][p, s] for s in range(SAMPLES)), **TOLERANCE
        )


def test_rays_without_a_sample_near_the_surface_have_no_weight():
    weights = losses.render_weights(jnp.zeros((2, 3)), jnp.zeros((2, 3), bool), TAU)
    np.testing.assert_array_equal(weights, np.zeros((2, 3)))


def test_rgb(draws):
    rendered, measured, mask = (
        draws["values"][:, 0],
        draws["values"][:, 1],
        np.array([1, 0, 1, 1, 0, 1], bool),
    )
    expected = np.mean([np.linalg.norm(rendered[p] - measured[p]) for p in range(RAYS) if mask[p]])
    np.testing.assert_allclose(losses.rgb(rendered, measured, mask), expected, **TOLERANCE)


def test_a_perfect_prediction_costs_nothing():
    target, mask = jnp.asarray(LABELS, jnp.float32), jnp.ones(5, bool)
    one_hot = prediction(np.log(np.maximum(np.eye(5), 1e-12)))
    color = jnp.full((5, 3), 0.3)
    assert float(losses.d2t(jnp.zeros(5), mask)) == 0
    assert float(losses.distance(target, target, mask)) == 0
    assert float(losses.emd(one_hot, target, mask, CFG)) == pytest.approx(0, abs=1e-9)
    assert float(losses.cross_entropy(one_hot, target, mask, CFG)) == pytest.approx(0, abs=1e-6)
    # The norm is rounded off at 1e-6 so that it has a gradient at zero
    assert float(losses.rgb(color, color, mask)) == pytest.approx(0, abs=2e-6)


def every_loss(z, color, mask):
    """The sum of all, as a function of network outputs and rendered colours."""
    log_p = jax.nn.log_softmax(z)
    made, target = prediction(log_p), jnp.linspace(-0.1, 0.1, z.shape[0])
    weights = losses.render_weights(made.psi[None], mask[None], TAU)
    return (
        losses.d2t(made.psi, mask)
        + losses.distance(made.psi, target, mask)
        + losses.emd(made, target, mask, CFG)
        + losses.cross_entropy(made, target, mask, CFG)
        + losses.rgb(losses.render(weights, color[None]), jnp.full((1, 3), 0.5), jnp.any(mask)[None])
    )


every_loss_and_gradient = jax.jit(jax.value_and_grad(every_loss, argnums=(0, 1)))


@pytest.mark.parametrize("scale", [0.0, 1.0, 1000.0])
@pytest.mark.parametrize("masked", ["all", "some", "none"])
def test_values_and_gradients_are_finite(scale, masked):
    mask = {"all": np.ones(6, bool), "some": np.arange(6) < 2, "none": np.zeros(6, bool)}[masked]
    z = scale * np.random.default_rng(1).normal(size=(6, 5)).astype(np.float32)
    color = jnp.full((6, 3), 0.5)
    value, gradients = every_loss_and_gradient(z, color, mask)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((value, gradients)))
    if masked == "none":
        assert float(value) == 0 and not any(np.asarray(g).any() for g in gradients)


def test_regression_has_no_distribution_to_compare():
    psi = jnp.linspace(-0.1, 0.1, 4)
    made, mask = Tsdf(psi, jnp.ones(4), psi[:, None]), jnp.ones(4, bool)
    assert float(losses.emd(made, psi, mask, REGRESSION)) == 0
    assert float(losses.cross_entropy(made, psi, mask, REGRESSION)) == 0
