"""The state as a value: a tree of numbers and arrays, with words for what is read by people."""

from __future__ import annotations

import json

import jax
import numpy as np

import maps
from mipsjax.config.presets import PRESETS
from mipsjax.core import mapping
from mipsjax.submaps.dormant import packed
from mipsjax.submaps.state import How, Loop, Motion, Refinement, SlamState, Status
from mipsjax.uncertainty.trust import Differing


def whole() -> SlamState:
    """With a refinement under way, and with something in every field."""
    cfg = PRESETS["tiny"]
    learned = [mapping.create(jax.random.key(seed), cfg) for seed in (0, 1)]
    first = maps.submap(maps.keyframe(0), learned=learned[0])
    second = maps.submap(maps.keyframe(3), learned=packed(learned[1]))._replace(parent=0)
    return maps.state(first, second)._replace(
        loops=(Loop(0, 0, 1, How.FEATURES, 0.9, 0.1, 0.01, 1.0),),
        motion=Motion(np.eye(4), 0.1),
        refinement=Refinement((1,), (second,), 1),
        doubts=(Differing(np.zeros(6), np.ones(6)),),
    )


def test_a_state_is_a_tree_of_numbers():
    """Also where fields are None, as the corners and features of these keyframes."""
    state = whole()
    arrays = jax.tree.map(np.asarray, state)
    assert jax.tree.structure(arrays) == jax.tree.structure(state)
    for leaf in jax.tree.leaves(arrays):
        assert leaf.dtype.kind in "biufV" and leaf.dtype != object  # V: bfloat16, which NumPy does not know
    assert arrays.records[-1].status == Status.OK and arrays.submaps[0].parent is None


def test_nothing_in_a_state_can_be_called():
    leaves = jax.tree.leaves(whole())
    assert not any(callable(leaf) or isinstance(leaf, str) for leaf in leaves)


def test_what_is_a_number_reads_as_a_word():
    assert [str(status) for status in Status] == ["ok", "weak", "lost", "skipped"]
    assert [f"{how}" for how in How] == ["box", "features"]
    assert f"{Status.LOST:>6}" == "  lost" and json.dumps(str(How.BOX)) == '"box"'
