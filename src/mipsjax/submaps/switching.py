"""Which submap a frame belongs to: boxes grow, submaps begin, old ones take over again (Algorithm 1 of the paper)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from mipsjax.config.sections import Config
from mipsjax.core import mapping, volume
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import inverse, transform
from mipsjax.submaps.astray import begun_at
from mipsjax.submaps.bundle import adjust, adjust_submap, choose, mapping_camera
from mipsjax.submaps.chance import Purpose, generator_for, key_for
from mipsjax.submaps.dormant import packed, rests, unpacked
from mipsjax.submaps.ids import RecordId, SubmapId
from mipsjax.submaps.proposals import Proposal
from mipsjax.submaps.state import Keyframe, Pose, SlamState, Submap, pose_of
from mipsjax.uncertainty.held import NONE, at, carried, difference

STAY, NEW = SubmapId(-1), SubmapId(-2)  # instead of a submap: the active one stays, a new one begins
NOT_FINITE = "first fit of a new submap not finite, not entered"
FULL = "no other submap may begin (--volume.max-submaps)"
REVISIT_NOT_FINITE = "steps on the shared frame not finite, left out"


def begin(
    anchor: Keyframe, support: list[Keyframe], T_world_sub: Pose, steps: int, camera: Intrinsics, cfg: Config
) -> tuple[Submap, bool]:
    """A submap from its anchor and a few keyframes near it, whose poses are relative to the anchor.

    Returns it and whether its first fit stayed finite.
    """
    keyframes = (anchor._replace(T_sub_cam=np.eye(4)), *support)
    learned = mapping.create(key_for(cfg, Purpose.NETWORKS, anchor.id), cfg)
    # Filled up to the number of frames that mapping is compiled for
    batch = [keyframes[i % len(keyframes)] for i in range(cfg.map.frames)]
    key = key_for(cfg, Purpose.FIRST_FIT, anchor.id)
    learned, _, ok = adjust(learned, batch, [0.0] * len(batch), steps, key, camera, cfg)
    box = volume.grow(None, *_seen(keyframes[0], camera, cfg), cfg.volume)
    return Submap(learned, box, keyframes, T_world_sub), ok


def with_grown_box(state: SlamState, cfg: Config) -> SlamState:
    """The state in which the active submap's box encloses what its newest keyframe sees, as far as it may grow."""
    submap = state.submap
    box = volume.grow(submap.box, *_seen(submap.keyframes[-1], state.camera, cfg), cfg.volume)
    return state.with_submap(state.active, box=box)


def governor(active: float, others: Mapping[SubmapId, float], fresh: float, cfg: Config) -> SubmapId:
    """Which submap takes over after a keyframe: STAY, NEW, or an old one.

    `active` is the share of what the frame sees that lies in the active submap's box, `others` the same for those
    that the frame was found in, `fresh` for one that would begin here (below 1 where a view does not fit into any
    box). A submap that takes over must hold more than the active one by the hysteresis.
    """
    if active >= cfg.volume.overlap:
        return STAY
    able = {submap_id: share for submap_id, share in others.items() if share >= cfg.volume.overlap}
    if not able:
        return NEW if fresh >= active + cfg.volume.hysteresis else STAY
    best = max(able, key=able.__getitem__)
    return best if able[best] >= active + cfg.volume.hysteresis else STAY


def govern(state: SlamState, found: Sequence[Proposal], cfg: Config) -> SubmapId:
    """Which submap the camera is tracked in from here on: STAY, NEW, or one in which the newest keyframe was found."""
    keyframe = state.submap.keyframes[-1]
    p_cam, mask = volume.seen(keyframe.depth, mapping_camera(state.camera, cfg), cfg.volume)
    active = volume.contained(state.submap.box, transform(keyframe.T_sub_cam, p_cam), mask)
    others = {}
    # In the order of submaps: of two that hold as much the older one takes over
    for proposal in sorted(found, key=lambda proposal: proposal.second):
        p_sub = transform(proposal.link.second.T_sub_cam, p_cam)
        others[proposal.second] = volume.contained(state.submaps[proposal.second].box, p_sub, mask)
    fresh = volume.contained(volume.grow(None, p_cam, mask, cfg.volume), p_cam, mask)
    return governor(active, others, fresh, cfg)


def enter(state: SlamState, choice: SubmapId, cfg: Config) -> tuple[SlamState, str]:
    """The state in which the submap is active that `govern` chose, and what went wrong with it, if anything.

    Where no other submap may begin, or its first fit is not finite, the state is as it was.
    """
    if choice == STAY:
        return state, ""
    if choice == NEW and full(state, cfg):
        return state, FULL
    return _begin_here(state, cfg) if choice == NEW else _revisit(state, choice, cfg)


def full(state: SlamState, cfg: Config) -> bool:
    """Whether the map has as many submaps as it may."""
    return 0 < cfg.volume.max_submaps <= len(state.submaps)


def _begin_here(state: SlamState, cfg: Config) -> tuple[SlamState, str]:
    """The state with a new submap whose anchor is the newest keyframe of the active one."""
    old = state.submap
    *before, anchor = old.keyframes
    T_new_old = inverse(anchor.T_sub_cam)
    # The first ones, with which a submap was begun, are not in the order of time
    before.sort(key=lambda keyframe: keyframe.id, reverse=True)
    support = [_support(k, anchor, T_new_old) for k in before[: cfg.volume.support]]
    T_world_sub = old.T_world_sub @ anchor.T_sub_cam
    first, steps = anchor._replace(covariance=NONE), cfg.map.submap_steps
    new, ok = begin(first, support, T_world_sub, steps, state.camera, cfg)
    if not ok:
        return state, NOT_FINITE
    covariance = begun_at(state, state.active, anchor.covariance)
    new = new._replace(parent=state.active, covariance=covariance)
    state = state._replace(submaps=(*state.submaps, new))
    return moved_in(state, state.submap_ids[-1], anchor.id), ""


def _support(keyframe: Keyframe, anchor: Keyframe, T_new_old: Pose) -> Keyframe:
    """A keyframe of one submap in another that begins at a later one, `anchor`."""
    between = difference(anchor.covariance, keyframe.covariance) + difference(
        keyframe.covariance, anchor.covariance
    )
    return keyframe._replace(T_sub_cam=T_new_old @ keyframe.T_sub_cam, covariance=carried(between, T_new_old))


def _revisit(state: SlamState, submap_id: SubmapId, cfg: Config) -> tuple[SlamState, str]:
    """The state in which an old submap takes over, after a few steps on the shared frame, so that tracking goes on
    smoothly."""
    submap, problem = state.submaps[submap_id], ""
    newest, shared = len(submap.keyframes) - 1, submap.keyframes[-1].id
    if cfg.map.revisit_steps:
        known = submap._replace(keyframes=submap.keyframes[:-1])
        rng = generator_for(cfg, Purpose.REVISIT_KEYFRAMES, shared)
        others = choose(known, cfg.map.frames - 2, rng)
        share, key = cfg.map.pose_rate_slow, key_for(cfg, Purpose.REVISIT, shared)
        chosen, steps = [newest, *others], cfg.map.revisit_steps
        # Steps that are not finite leave the submap as it was, which is fit to be entered
        submap, ok = adjust_submap(submap, chosen, share, steps, key, state.camera, cfg)
        problem = "" if ok else REVISIT_NOT_FINITE
    box = volume.grow(submap.box, *_seen(submap.keyframes[-1], state.camera, cfg), cfg.volume)
    state = state.with_submap(submap_id, **submap._replace(box=box)._asdict())
    return moved_in(state, submap_id, shared), problem


def moved_in(state: SlamState, submap_id: SubmapId, keyframe_id: RecordId) -> SlamState:
    """The state in which a submap is active, and the last frame hangs on its own keyframe there."""
    own, last = state.submaps[submap_id].keyframe_of(keyframe_id), state.records[-1]
    T_new_old = own.T_sub_cam @ inverse(pose_of(state, last))
    held = at(own.covariance, own.T_sub_cam, carried(last.held.joint[6:, 6:], T_new_old))
    last = last._replace(submap=submap_id, keyframe=keyframe_id, T_keyframe_cam=np.eye(4), held=held)
    return activated(state, submap_id)._replace(records=state.records.with_last(last))


def activated(state: SlamState, submap_id: SubmapId) -> SlamState:
    """The state in which the camera is in this submap from here on; the one before rests."""
    if submap_id == state.active:
        return state
    state = state.with_submap(state.active, learned=packed(state.submap.learned))
    entered = unpacked(state.submaps[submap_id].learned)
    # What was good is of the submap that is left
    return state.with_submap(submap_id, learned=entered)._replace(active=submap_id, good=None)


def awake(state: SlamState) -> SlamState:
    """The state whose active submap can learn, whoever made it the active one."""
    if not rests(state.submap.learned):
        return state
    return state.with_submap(state.active, learned=unpacked(state.submap.learned))


def _seen(keyframe: Keyframe, camera: Intrinsics, cfg: Config) -> tuple[np.ndarray, np.ndarray]:
    """Points of what a keyframe sees, in the frame of its submap, and which of them count."""
    p_cam, mask = volume.seen(keyframe.depth, mapping_camera(camera, cfg), cfg.volume)
    return transform(keyframe.T_sub_cam, p_cam), mask
