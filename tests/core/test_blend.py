"""The blend of submaps: one, several, none, and by Eq. 1 in double precision."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from corner import pose
from planes import CERTAIN, CFG, REGRESSED, TAU, expected, plane

from mipsjax.core import field as nf
from mipsjax.core.blend import Blended, add, start

EYE = np.eye(4, dtype=np.float32)
T_SUB_WORLD = pose((30, 10, -20), (0.2, 0.1, -0.3)).astype(np.float32)
NORMAL = np.array([0.0, 0.6, 0.8])
ALL = np.ones(500, np.float32)
POINTS = np.random.default_rng(0).uniform(-3, 3, (500, 3)).astype(np.float32)
SOME = (POINTS[:, 0] > 0).astype(np.float32)
MORE = np.clip(POINTS[:, 1], 0, 1)
TOLERANCE = {"rtol": 1e-5, "atol": 1e-7}  # means of a few numbers in single precision
UNSEEN = (TAU, np.log(5), 0.0, 0.0)


def blended(submaps, points=POINTS, cfg=CFG) -> Blended:
    """Of (field, T_sub_world, trust) in this order."""
    total = start(len(points), cfg.field)
    for submap in submaps:
        field, T, trust = submap
        total = add(total, field, T, trust[: len(points)], points, cfg)
    return total


def saying(s: float, spread: float = CERTAIN, rgb=(0.5, 0.5, 0.5)):
    """A submap that is everywhere, and everywhere s away from its surface."""
    return plane(0 * NORMAL, -s, spread, rgb), EYE, ALL


SEVERAL = [
    (plane(NORMAL, 0.3, 0.03, (0.2, 0.4, 0.9)), T_SUB_WORLD, SOME),
    (plane(NORMAL, 0.28, 0.05, (0.8, 0.1, 0.3)), EYE, ALL),
    (plane(-NORMAL, 0.1, 0.02, (0.5, 0.6, 0.1)), EYE, MORE),
]


def values(total: Blended, at: int) -> np.ndarray:
    return np.array([total.psi[at], total.entropy[at], *total.color[at], total.weight[at]])


def test_several_by_the_equation_in_double_precision():
    total, sums = blended(SEVERAL), np.zeros((len(POINTS), 6))
    for field, T, trust in SEVERAL:
        p = POINTS.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        made = nf.tsdf(field, jnp.asarray(p, jnp.float32), CFG.field)
        color = nf.color(field, jnp.asarray(p, jnp.float32), CFG.field)
        # 1 / h^2 with a floor, up to a factor common to all submaps (Eq. 1)
        w = trust / (np.asarray(made.entropy, np.float64) ** 2 + 0.3**2) * 0.3**2
        sums += w[:, None] * np.c_[made.psi, made.entropy, color, np.ones(len(p))]
    # weight is the last column; the others are means where any submap reaches, as the second does everywhere
    np.testing.assert_allclose(total.weight, sums[:, 5], **TOLERANCE)
    means = sums[:, :5] / sums[:, 5:]
    np.testing.assert_allclose(np.c_[total.psi, total.entropy, total.color], means, rtol=1e-5, atol=1e-6)


def test_one_submap_alone_gives_its_own_values_exactly():
    field, T, trust = SEVERAL[0]
    total = blended([SEVERAL[0]])
    p_sub = jnp.asarray(POINTS) @ T[:3, :3].T + T[None, :3, 3]
    reached = trust > 0
    np.testing.assert_array_equal(np.asarray(total.weight) > 0, reached)
    alone = blended([(field, T, ALL)])
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
    for total in (blended([]), blended([(SEVERAL[0][0], EYE, 0 * ALL)])):
        for at in range(len(POINTS)):
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


def test_trust_is_a_share_of_the_weight():
    one, other = saying(0.03), saying(-0.03)
    (psi,), _ = expected(np.array([0.03]), CERTAIN)
    total = blended([(*one[:2], 0.75 * ALL), (*other[:2], 0.25 * ALL)])
    np.testing.assert_allclose(total.psi, np.full(len(POINTS), 0.5 * psi), rtol=1e-4)


def test_broken_submaps_and_points_spoil_nothing_else():
    points = POINTS.copy()
    points[0] = np.nan
    broken = (plane(NORMAL, np.nan), EYE, ALL)
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
    total = blended([(field, EYE, ALL) for field in fields], cfg=REGRESSED)
    mean = np.mean(TAU * np.tanh(np.array([0.2, 0.5])))
    np.testing.assert_allclose(total.psi, np.full(len(POINTS), mean), rtol=1e-5)


def test_one_compilation_serves_any_number_of_submaps():
    blended(SEVERAL[:2])
    programs = add._cache_size
    before = programs()
    blended([*SEVERAL, *SEVERAL, saying(0.01)])
    assert programs() == before
