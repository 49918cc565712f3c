"""The blend of submaps: one, several, none, at the faces of a box, and by Eq. 1 in double precision."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from corner import pose
from planes import CERTAIN, CFG, REGRESSED, TAU, expected, plane

from mipsjax.core import field as nf
from mipsjax.core.blend import Blended, add, fading, start

SHARP = replace(CFG, blend=replace(CFG.blend, fade=0.0))
LO, HI = np.array([-1.0, -2.0, -1.5], np.float32), np.array([2.0, 1.0, 1.5], np.float32)
HUGE = np.full(3, 100.0, np.float32)
EYE = np.eye(4, dtype=np.float32)
T_SUB_WORLD = pose((30, 10, -20), (0.2, 0.1, -0.3)).astype(np.float32)
NORMAL = np.array([0.0, 0.6, 0.8])
POINTS = np.random.default_rng(0).uniform(-3, 3, (500, 3)).astype(np.float32)
TOLERANCE = {"rtol": 1e-5, "atol": 1e-7}  # means of a few numbers in single precision
UNSEEN = (TAU, np.log(5), 0.0, 0.0)


def blended(submaps, points=POINTS, cfg=CFG) -> Blended:
    """Of (field, T_sub_world, lo, hi) in this order."""
    total = start(len(points), cfg.field)
    for submap in submaps:
        total = add(total, *submap, points, cfg)
    return total


def saying(s: float, spread: float = CERTAIN, rgb=(0.5, 0.5, 0.5)):
    """A submap that is everywhere, and everywhere s away from its surface."""
    return plane(0 * NORMAL, -s, spread, rgb), EYE, -HUGE, HUGE


SEVERAL = [
    (plane(NORMAL, 0.3, 0.03, (0.2, 0.4, 0.9)), T_SUB_WORLD, LO, HI),
    (plane(NORMAL, 0.28, 0.05, (0.8, 0.1, 0.3)), EYE, -HUGE, HUGE),
    (plane(-NORMAL, 0.1, 0.02, (0.5, 0.6, 0.1)), EYE, LO - 1, HI - 1),
]


def values(total: Blended, at: int) -> np.ndarray:
    return np.array([total.psi[at], total.entropy[at], *total.color[at], total.weight[at]])


def test_several_by_the_equation_in_double_precision():
    total, sums = blended(SEVERAL, cfg=SHARP), np.zeros((len(POINTS), 6))
    for field, T, lo, hi in SEVERAL:
        p = POINTS.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        made = nf.tsdf(field, jnp.asarray(p, jnp.float32), SHARP.field)
        color = nf.color(field, jnp.asarray(p, jnp.float32), SHARP.field)
        within = np.all((p > lo) & (p < hi), 1)
        # 1 / h^2 with a floor, up to a factor common to all submaps (Eq. 1)
        w = within / (np.asarray(made.entropy, np.float64) ** 2 + 0.3**2) * 0.3**2
        sums += w[:, None] * np.c_[made.psi, made.entropy, color, np.ones(len(p))]
    # weight is the last column; the others are means where any submap reaches, as the second does everywhere
    np.testing.assert_allclose(total.weight, sums[:, 5], **TOLERANCE)
    means = sums[:, :5] / sums[:, 5:]
    np.testing.assert_allclose(np.c_[total.psi, total.entropy, total.color], means, rtol=1e-5, atol=1e-6)


def test_one_submap_alone_gives_its_own_values_exactly():
    field, T, lo, hi = SEVERAL[0]
    total = blended([SEVERAL[0]])
    p_sub = jnp.asarray(POINTS) @ T[:3, :3].T + T[None, :3, 3]
    reached = np.asarray(total.weight) > 0
    assert 0.05 < reached.mean() < 0.95, "some inside, some not, some where the weight fades"
    np.testing.assert_array_equal(reached, np.all((p_sub > lo[None]) & (p_sub < hi[None]), 1))
    alone = blended([(field, T, -HUGE, HUGE)])
    for ours, own in zip(total[:3], alone[:3], strict=True):
        np.testing.assert_array_equal(np.asarray(ours)[reached], np.asarray(own)[reached])
    made = nf.tsdf(field, p_sub, CFG.field)
    # Compiled together with the blend or alone, the sums in the network may be ordered differently
    np.testing.assert_allclose(alone.psi, made.psi, atol=1e-6)
    np.testing.assert_allclose(alone.entropy, made.entropy, atol=1e-5)


def test_the_same_twice_is_the_same():
    one, two = blended([SEVERAL[0]]), blended([SEVERAL[0]] * 2)
    for a, b in zip(one[:3], two[:3], strict=True):
        np.testing.assert_allclose(a, b, **TOLERANCE)
    np.testing.assert_allclose(2 * one.weight, two.weight, rtol=1e-6)


@pytest.mark.parametrize("order", [(0, 2, 1), (2, 1, 0), (1, 0, 2)])
def test_the_order_does_not_matter(order):
    for a, b in zip(blended(SEVERAL), blended([SEVERAL[i] for i in order]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_points_of_no_submap_are_free_and_unknown():
    outside = np.array([[5.0, 0, 0], [0, 0, -40], [2.0, 0, 0]], np.float32)  # the last on a face
    for total in (blended([], outside), blended([(SEVERAL[0][0], EYE, LO, HI)], outside)):
        for at in range(len(outside)):
            np.testing.assert_allclose(values(total, at)[[0, 1, 2, 5]], UNSEEN, rtol=1e-6)


def test_the_certain_one_dominates():
    sure, unsure = (0.03, 0.015), (-0.03, 0.2)
    total = blended([saying(*unsure, rgb=(0.9, 0.9, 0.9)), saying(*sure, rgb=(0.1, 0.1, 0.1))])
    (psi_a,), (h_a,) = expected(np.array([sure[0]]), sure[1])
    (psi_b,), (h_b,) = expected(np.array([unsure[0]]), unsure[1])
    assert h_a < 0.7 and h_b > 1.5
    psi, entropy, *color, _ = values(total, 0)
    share = (psi - psi_b) / (psi_a - psi_b)
    assert 0.8 < share < 1  # 1/h^2 with the floor: 0.84
    assert entropy == pytest.approx(share * h_a + (1 - share) * h_b, rel=1e-4)
    assert color[0] == pytest.approx(share * 0.1 + (1 - share) * 0.9, rel=1e-4)


def test_no_step_where_a_submap_ends_within_another():
    """On a line through a face, 1 mm a step: with a fade the blend changes little, without it jumps."""
    line = np.zeros((400, 3), np.float32)
    line[:, 0] = 1.8 + 0.001 * np.arange(400)
    pair = [saying(-0.06), (saying(0.06)[0], EYE, LO, HI)]
    smooth, sharp = (np.asarray(blended(pair, line, cfg).psi) for cfg in (CFG, SHARP))
    gap = abs(smooth[0] - smooth[-1])
    # The steepest place of the fade is 1.5 times as steep as a straight line over 5 cm, and the share of a
    # weight w besides one of 1, w / (1 + w), is at most twice as steep as its half
    assert np.abs(np.diff(smooth)).max() < 2 * 1.5 * gap / 50 * 1.05
    assert np.abs(np.diff(sharp)).max() > 0.9 * gap


def test_the_fade_is_one_inside_and_zero_outside():
    x = np.zeros((7, 3), np.float32)
    x[:, 0] = [-2, -1, -0.975, -0.95, 0, 1.99, np.nan]
    np.testing.assert_allclose(fading(jnp.asarray(x), LO, HI, 0.05)[:5], [0, 0, 0.5, 1, 1], atol=1e-5)
    inside = np.asarray(fading(jnp.asarray(x), LO, HI, 0.05))
    assert 0 < inside[5] < 0.2 and inside[6] == 0
    np.testing.assert_array_equal(fading(jnp.asarray(x), LO, HI, 0.0), [0, 0, 1, 1, 1, 1, 0])


def test_broken_submaps_and_points_spoil_nothing_else():
    points = POINTS.copy()
    points[0] = np.nan
    broken = (plane(NORMAL, np.nan), EYE, -HUGE, HUGE)
    total, without = blended([broken, *SEVERAL], points), blended(SEVERAL, points)
    for a, b in zip(total, without, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(values(total, 0)[[0, 1, 2, 5]], UNSEEN, rtol=1e-6)


def test_without_color_the_rest_is_the_same():
    plain, colored = start(len(POINTS), CFG.field), start(len(POINTS), CFG.field)
    for submap in SEVERAL:
        plain = add(plain, *submap, POINTS, CFG, colored=False)
        colored = add(colored, *submap, POINTS, CFG)
    assert not np.asarray(plain.color).any() and np.asarray(colored.color).any()
    np.testing.assert_allclose(plain.psi, colored.psi, **TOLERANCE)


def test_regressed_distances_are_averaged():
    fields = [plane(0 * NORMAL, -s, cfg=REGRESSED) for s in (0.02, 0.05)]
    total = blended([(field, EYE, -HUGE, HUGE) for field in fields], cfg=REGRESSED)
    mean = np.mean(TAU * np.tanh(np.array([0.2, 0.5])))
    np.testing.assert_allclose(total.psi, np.full(len(POINTS), mean), rtol=1e-5)


def test_one_compilation_serves_any_number_of_submaps():
    blended(SEVERAL[:1])
    before = add._cache_size()
    blended([*SEVERAL, *SEVERAL, saying(0.01)])
    assert add._cache_size() == before
