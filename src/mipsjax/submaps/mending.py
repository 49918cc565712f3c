"""A map into which something not finite has come: the last good parameters again, or what its keyframes teach anew.

All steps that a submap learns by are checked, and undone where they are not finite. This is for what is not finite
before them, however it came there: without it such a submap would learn nothing any more.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core import mapping
from mipsjax.submaps.bundle import adjust, random_batch
from mipsjax.submaps.chance import Purpose, key_for
from mipsjax.submaps.dormant import packed
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.state import SlamState

RESTORED = "map not finite: what was good last is restored"
LEARNED_ANEW = "map not finite: learned anew from its keyframes"
HOPELESS = "map not finite, and its keyframes teach nothing else"
STEPS = 10
"""Of mapping on each random batch of keyframes."""


def mended(state: SlamState, submap_id: SubmapId, cfg: Config) -> tuple[SlamState, str]:
    """The state with a submap that is finite, and how it was mended; empty where nothing had to be."""
    learned, active = state.submaps[submap_id].learned, submap_id == state.active
    if is_finite(learned):
        return state, ""
    if active and state.good is not None and is_finite(state.good):
        return state.with_submap(submap_id, learned=state.good), RESTORED
    learned, ok = _learned_anew(state, submap_id, cfg)
    if not ok:
        return state, HOPELESS
    state = state.with_submap(submap_id, learned=learned if active else packed(learned))
    return (state._replace(good=learned) if active else state), LEARNED_ANEW


def is_finite(learned: mapping.Learned) -> bool:
    """Whether all networks and the optimizer's averages are."""
    leaves = jax.device_get(jax.tree.leaves(learned))
    # Averages of a resting submap are in bfloat16, which NumPy does not count among the floats
    numbers = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return all(bool(np.isfinite(leaf.astype(np.float32)).all()) for leaf in numbers)


def _learned_anew(state: SlamState, submap_id: SubmapId, cfg: Config) -> tuple[mapping.Learned, bool]:
    """What a submap learns from its keyframes where they are, in the steps of a new one, and whether all stayed
    finite."""
    submap = state.submaps[submap_id]
    learned = mapping.create(key_for(cfg, Purpose.NETWORKS, submap.anchor.id), cfg)
    calls = max(1, cfg.map.first_steps // STEPS)
    rates, all_ok = [0.0] * cfg.map.frames, True
    for call in range(calls):
        numbers = submap_id, state.next_record, call
        chosen = random_batch(len(submap.keyframes), cfg, Purpose.MEND_KEYFRAMES, *numbers)
        batch = [submap.keyframes[i] for i in chosen]
        key = key_for(cfg, Purpose.MEND, *numbers)
        learned, _, ok = adjust(learned, batch, rates, STEPS, key, state.camera, cfg)
        all_ok &= bool(ok)
    return learned, all_ok
