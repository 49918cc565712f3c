"""What is not finite in a map is found where it would stop it from learning, and mended."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import InputConfig
from mipsjax.data.synth import open_synth
from mipsjax.slam import step as slam
from mipsjax.submaps import mending
from mipsjax.submaps.dormant import packed, rests
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.state import SlamState, Status

pytestmark = pytest.mark.slow

CFG = PRESETS["tiny"]
FRAMES = 4


@pytest.fixture(scope="module")
def sequence():
    return open_synth("tiny", slice(FRAMES + 1), InputConfig())


@pytest.fixture(scope="module")
def state(sequence) -> SlamState:
    state, _ = slam.start(sequence[0], sequence.intrinsics, CFG)
    for position in range(1, FRAMES):
        state, _ = slam.step(state, sequence[position], CFG)
    return state


def spoilt(state: SlamState, number: int) -> SlamState:
    """With NaN in one array of what the active submap has learned: its last entry, which few samples reach."""
    leaves, structure = jax.tree.flatten(state.submap.learned)
    leaves[number] = jnp.asarray(leaves[number]).reshape(-1).at[-1].set(jnp.nan).reshape(leaves[number].shape)
    return state.with_submap(state.active, learned=jax.tree.unflatten(structure, leaves))


def floats(state: SlamState) -> list[int]:
    leaves = jax.tree.leaves(state.submap.learned)
    return [i for i, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jnp.floating)]


def test_nothing_is_done_to_a_finite_map(state):
    after, how = mending.mended(state, state.active, CFG)
    assert after is state and not how


@pytest.mark.fault(34)
def test_whatever_array_is_not_finite_is_restored_and_learned_from_again(state, sequence):
    for number in floats(state):
        after, info = slam.step(spoilt(state, number), sequence[FRAMES], CFG)
        assert mending.RESTORED in info.note, number
        assert after.records[-1].status is Status.OK
        assert mending.is_finite(after.submap.learned)
        # It has learned from the frame, after it was mended
        assert not same(after.submap.learned, state.submap.learned)


@pytest.mark.fault(34)
def test_where_nothing_good_is_known_keyframes_teach_it_anew(state, sequence):
    after, info = slam.step(spoilt(state, 0)._replace(good=None), sequence[FRAMES], CFG)
    assert mending.LEARNED_ANEW in info.note and mending.is_finite(after.submap.learned)
    assert after.records[-1].status is Status.OK


@pytest.mark.fault(34)
def test_what_rests_is_looked_at_too_before_the_last_steps(state, caplog):
    """Also the averages that are kept in fewer bits."""
    resting = state.submap._replace(learned=packed(state.submap.learned), parent=state.active)
    leaves, structure = jax.tree.flatten(resting.learned)
    brief = next(i for i, leaf in enumerate(leaves) if leaf.dtype == jnp.bfloat16 and leaf.size)
    leaves[brief] = np.full_like(leaves[brief], np.nan)
    resting = resting._replace(learned=jax.tree.unflatten(structure, leaves))
    assert not mending.is_finite(resting.learned)
    after, how = mending.mended(state._replace(submaps=(*state.submaps, resting)), SubmapId(1), CFG)
    assert how == mending.LEARNED_ANEW and mending.is_finite(after.submaps[1].learned)
    assert rests(after.submaps[1].learned) and after.good is state.good


def test_keyframes_that_teach_nothing_finite_are_said_to(state):
    fast = replace(CFG, map=replace(CFG.map, learning_rate=float("inf")))
    broken = spoilt(state, 0)._replace(good=None)
    after, how = mending.mended(broken, broken.active, fast)
    assert after is broken and how == mending.HOPELESS


def test_steps_that_are_not_finite_are_left_out_and_said(state, sequence):
    """Of a finite map: nothing is wrong with what they began from."""
    fast = replace(CFG, map=replace(CFG.map, learning_rate=float("inf")))
    after, info = slam.step(state, sequence[FRAMES], fast)
    assert info.note == "map not finite" and same(after.submap.learned, state.submap.learned)
    assert after.good is state.good


def same(one, other) -> bool:
    return all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )
