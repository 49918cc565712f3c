"""Adam's averages of a submap at rest: packed and unpacked."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.core.mapping import Learned
from mipsjax.submaps.dormant import packed, unpacked


def learned(*arrays) -> Learned:
    """Averages alone; the networks are not touched."""
    return Learned(field=None, optimizer={"count": jnp.int32(7), "averages": list(arrays)})


def sparse(shape, share: float) -> np.ndarray:
    """Powers of two, which bfloat16 holds, and zeros."""
    rng = np.random.default_rng(0)
    values = np.exp2(rng.integers(-100, 100, shape)) * rng.choice([-1, 1], shape)
    return np.where(rng.random(shape) < share, values, 0).astype(np.float32)


@pytest.mark.parametrize("shape", [(), (1,), (7,), (8,), (3, 5, 2), (0, 4)])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_what_bfloat16_holds_comes_back_to_the_bit(shape, share):
    before = sparse(shape, share)
    after = unpacked(packed(learned(before))).optimizer["averages"][0]
    assert after.dtype == np.float32 and after.shape == before.shape
    np.testing.assert_array_equal(after, before)


def test_signs_of_zeros_and_what_is_not_finite_come_back():
    before = np.array([-0.0, 0.0, np.inf, -np.inf, np.nan], np.float32)
    after = unpacked(packed(learned(before))).optimizer["averages"][0]
    np.testing.assert_array_equal(after, before)
    np.testing.assert_array_equal(np.signbit(after[:2]), [True, False])


def test_zeros_take_a_bit():
    half = sparse((1000, 2), 0.5)
    resting = packed(learned(half)).optimizer["averages"]
    assert sum(leaf.nbytes for leaf in jax.tree.leaves(resting)) == 2000 // 8 + 2 * np.count_nonzero(half)


def test_counts_stay_as_they_are():
    both = learned(sparse((4,), 1.0))
    assert packed(both).optimizer["count"] is both.optimizer["count"]


def test_resting_twice_or_waking_twice_changes_nothing():
    resting = packed(learned(jnp.asarray(sparse((9, 3), 0.5))))
    woken = unpacked(resting)
    for once, twice in [(resting, packed(resting)), (woken, unpacked(woken))]:
        leaves = (jax.tree.leaves(each.optimizer) for each in (once, twice))
        assert all(a is b for a, b in zip(*leaves, strict=True))


def test_resting_again_after_waking_gives_the_same_bits():
    """Of values that bfloat16 does not hold, too: they are rounded once."""
    resting = packed(learned(np.random.default_rng(0).normal(size=(9, 3)).astype(np.float32)))
    again = packed(unpacked(resting))
    for once, twice in zip(*(jax.tree.leaves(each.optimizer) for each in (resting, again)), strict=True):
        np.testing.assert_array_equal(once, twice)
