"""What a frame costs after few and after many others; no wall time is asserted."""

from __future__ import annotations

import jax
import pytest

from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import InputConfig
from mipsjax.data.sequence import Frame
from mipsjax.data.synth import open_synth
from mipsjax.slam import step as slam
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import SlamState

CFG = PRESETS["tiny"]
FRAMES = 4


@pytest.fixture(scope="module")
def followed() -> tuple[SlamState, Frame]:
    """After a few frames, and the next one."""
    sequence = open_synth("tiny", slice(FRAMES + 1), InputConfig())
    state, _ = slam.start(sequence[0], sequence.intrinsics, CFG)
    for number in range(1, FRAMES):
        state, _ = slam.step(state, sequence[number], CFG)
    return state, sequence[FRAMES]


@pytest.mark.parametrize("before", [200, 20_000])
def test_one_more_frame(benchmark, followed, before):
    """The same frame, with as many records before it."""
    state, frame = followed
    last = state.records[-1]
    repeated = [last] * (before - len(state.records))
    longer = state._replace(records=Records.of([*state.records, *repeated]))

    def step() -> None:
        after, _ = slam.step(longer, frame, CFG)
        # Not the whole state: the way through all of its records is no part of a step
        jax.block_until_ready((after.submaps, after.records[-1]))

    benchmark.pedantic(step, rounds=20, iterations=1, warmup_rounds=3)
    benchmark.extra_info.update(records=before)
