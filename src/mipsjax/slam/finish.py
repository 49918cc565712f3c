"""After the last frame: loops and keyframes once more, then submaps learned where they lie, and every frame aligned."""

from __future__ import annotations

import logging

import jax.numpy as jnp
import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core import tracking
from mipsjax.core.rigid import distance, rigid
from mipsjax.slam.straighten import straightened
from mipsjax.submaps.background import with_refined
from mipsjax.submaps.bundle import adjust, random_batch
from mipsjax.submaps.chance import Purpose, key_for
from mipsjax.submaps.closure import closed_again
from mipsjax.submaps.dormant import packed
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.links import unjoined
from mipsjax.submaps.mending import mended
from mipsjax.submaps.records import Records
from mipsjax.submaps.schedule import INLINE, Executor
from mipsjax.submaps.state import (
    Pose,
    Record,
    SlamState,
    Submap,
    pose_of,
    thumbnail_stride,
    to_metres,
)
from mipsjax.uncertainty.trust import ALLOWED_TRACKED, trusted

log = logging.getLogger(__name__)

BATCH_STEPS = 10  # of mapping on each random batch of keyframes
MOVED = 1e-4  # metres or radians: less is rounding
ALIGNED = 16  # frames in one call of `tracking.align`


def finish(state: SlamState, cfg: Config, executor: Executor = INLINE) -> SlamState:
    """The state after the last frame: all loops once more, keyframes moved to where they lie by each other,
    `map.final_steps` steps of mapping of each submap, and `track.go.final_steps` of tracking of each frame. `executor`
    is the one that `step` was given. Warns where submaps hang on nothing.

    In a map of earlier recordings only submaps learn in which this one has keyframes, or whose keyframes it moved, and
    only its own frames are aligned. One that was never found in it leaves it as it is.
    """
    state = with_refined(state, executor, cfg)
    if not state.located:
        return state
    before = state
    state = closed_again(_mended(state, cfg), cfg)
    as_tracked = trusted(state.doubts, ALLOWED_TRACKED)
    # Where submaps do not learn once more they stay bent, and so do the keyframes in them
    state, trust = straightened(state, cfg) if cfg.map.final_steps else (state, as_tracked)
    for submap_id in state.submap_ids:
        if _concerned(state, before, submap_id):
            state = _adjusted(state, submap_id, cfg)
    if cfg.track.go.final_steps and cfg.track.go.method == "lm":
        for submap_id in state.submap_ids:
            state = _aligned(state, submap_id, trust, cfg)
    if apart := unjoined(state):
        log.warning(
            "submaps %s, begun by a lost camera, were never seen to overlap the first: where they lie is a guess",
            apart,
        )
    # What was good is older than all this
    return state._replace(good=None)


def _mended(state: SlamState, cfg: Config) -> SlamState:
    """The state without anything that is not finite in any submap. Warns where there was."""
    for submap_id in state.submap_ids:
        state, how = mended(state, submap_id, cfg)
        if how:
            log.warning("submap %d: %s", submap_id, how)
    return state


def _concerned(state: SlamState, before: SlamState, submap_id: SubmapId) -> bool:
    """Whether a submap has keyframes of this recording, or other poses of keyframes than before."""
    after, earlier = state.submaps[submap_id].keyframes, before.submaps[submap_id].keyframes
    if len(after) != len(earlier) or any(keyframe.id >= state.first for keyframe in after):
        return True
    moved = (distance(one.T_sub_cam, other.T_sub_cam) for one, other in zip(after, earlier, strict=True))
    return any(max(both) > MOVED for both in moved)


def _adjusted(state: SlamState, submap_id: SubmapId, cfg: Config) -> SlamState:
    """Bundle adjustment at rates that fall to zero; each call takes another random batch, the anchor stays."""
    submap = state.submaps[submap_id]
    keyframes, learned = list(submap.keyframes), submap.learned
    calls = -(-cfg.map.final_steps // BATCH_STEPS)  # rounded up
    for call in range(calls):
        numbers = submap_id, state.next_record, call
        chosen = random_batch(len(keyframes), cfg, Purpose.FINISH_KEYFRAMES, *numbers)
        fall = 1 - call / calls
        rates = [cfg.map.pose_rate_slow * fall if i != 0 else 0.0 for i in chosen]
        batch = [keyframes[i] for i in chosen]
        key = key_for(cfg, Purpose.FINISH, *numbers)
        learned, poses, _ = adjust(learned, batch, rates, BATCH_STEPS, key, state.camera, cfg, fall)
        for i, pose in zip(chosen, poses, strict=True):
            keyframes[i] = keyframes[i]._replace(T_sub_cam=pose)
    kept = learned if submap_id == state.active else packed(learned)
    return state.with_submap(submap_id, learned=kept, keyframes=tuple(keyframes))


def _aligned(state: SlamState, submap_id: SubmapId, trust: float, cfg: Config) -> SlamState:
    """Every trusted frame of this recording in a submap at the pose where it fits the finished map; the map's first
    frame stays. Colour holds it where it was as far as it is trusted."""
    small = state.camera.decimated(thumbnail_stride(state.camera))
    submap, records = state.submaps[submap_id], list(state.records)
    own = [
        i for i, r in enumerate(records) if i >= state.first and r.submap == submap_id and r.depth is not None
    ]
    for begin in range(0, len(own), ALIGNED):
        group = own[begin : begin + ALIGNED]
        # Full groups only, so that one compilation serves any number of frames
        filled = [group[i % len(group)] for i in range(ALIGNED)]
        depth = np.stack([to_metres(records[i]) for i in filled])
        start = np.stack([pose_of(state, records[i]) for i in filled]).astype(np.float32)
        colour = trust * np.stack([records[i].colour for i in filled]).astype(np.float32)
        poses = np.asarray(
            tracking.align(submap.learned.field, jnp.asarray(depth), start, colour, small, cfg)
        )
        for i, pose in zip(group, poses, strict=False):
            records[i] = _moved(records[i], rigid(pose), submap)
    return state._replace(records=Records.of(records))


def _moved(record: Record, T_sub_cam: Pose, submap: Submap) -> Record:
    """The record of a frame of a submap, moved to another pose there."""
    keyframe = submap.keyframe_of(record.keyframe)
    return record._replace(T_keyframe_cam=np.linalg.inv(keyframe.T_sub_cam) @ T_sub_cam)
