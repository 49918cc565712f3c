"""A list in blocks: it is read as a tuple is, and a longer one shares what it can with the one before."""

from __future__ import annotations

import jax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mipsjax.submaps.records import BLOCK, Records

LENGTHS = st.sampled_from((0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK + 5))


@given(LENGTHS, st.slices(3 * BLOCK))
def test_it_reads_as_a_tuple(length: int, part: slice):
    expected = tuple(range(length))
    one_by_one = Records[int]()
    for number in expected:
        one_by_one = one_by_one.appended(number)
    for records in (Records.of(expected), one_by_one):
        assert len(records) == length and tuple(records) == expected
        assert tuple(reversed(records)) == expected[::-1]
        assert records[part] == expected[part]
        assert all(records[place] == expected[place] for place in range(-length, length))
        for beyond in (length, -length - 1):
            with pytest.raises(IndexError):
                records[beyond]


@pytest.mark.parametrize("length", [1, BLOCK - 1, BLOCK, BLOCK + 1])
def test_the_last_one_is_replaced(length: int):
    before = Records.of(range(length))
    after = before.with_last(-1)
    assert tuple(after) == (*range(length - 1), -1) and tuple(before) == tuple(range(length))
    with pytest.raises(IndexError):
        Records().with_last(-1)


def test_one_more_copies_one_block_at_most():
    before = Records.of(range(5 * BLOCK + 3))
    after = before.appended(7)
    assert after.full is before.full and len(after.open) <= BLOCK
    filled = Records.of(range(6 * BLOCK - 1)).appended(7)
    assert filled.open == () and all(len(block) == BLOCK for block in filled.full)


def test_it_is_a_tree():
    records = Records.of(range(BLOCK + 2))
    doubled = jax.tree.map(lambda leaf: 2 * leaf, records)
    assert isinstance(doubled, Records) and tuple(doubled) == tuple(range(0, 2 * BLOCK + 4, 2))
