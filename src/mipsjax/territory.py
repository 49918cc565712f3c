"""Which submap a frame belongs to: boxes grow, submaps begin, old ones take over again (Algorithm 1 of the paper)."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mipsjax.bundle import INIT, MAP, adjust, choose, mapping_camera, nearest, random_key, refine, views_of
from mipsjax.config import Config
from mipsjax.core import mapping, tracking, volume
from mipsjax.core.camera import Intrinsics
from mipsjax.host.held import NONE, at, carried, difference
from mipsjax.links import best_link, chain, joined, links
from mipsjax.policy import NEW, STAY, governor
from mipsjax.rest import awake, rested
from mipsjax.state import Keyframe, Pose, SlamState, Submap, distance, inverse, pose_of, rigid

AGAIN = 3  # times at most that registration is repeated: from 9 cm off the third moves a frame by millimetres
VIEWS = 8  # keyframes that say what a submap observed around a guess
STILL = 0.01  # metres, or as many times 1 rad: registration that moves a frame by less has ended


class Sighting(NamedTuple):
    """A frame found in a submap other than the one it was tracked in."""

    submap: int
    T_sub_cam: Pose
    inliers: float


class Expected(NamedTuple):
    """Where a frame lies in a submap, before it is looked for there."""

    T_sub_cam: Pose
    metres: float = float("inf")
    """Farthest from there that it may be found."""
    radians: float = float("inf")
    """The same, turned."""

    def agrees(self, T_sub_cam: Pose) -> bool:
        metres, radians = distance(self.T_sub_cam, T_sub_cam)
        return metres <= self.metres and radians <= self.radians


def begin(
    anchor: Keyframe, support: list[Keyframe], T_world_sub: Pose, steps: int, camera: Intrinsics, cfg: Config
) -> tuple[Submap, bool]:
    """A submap from its anchor and a few keyframes near it, whose poses are relative to the anchor.

    Returns it and whether its first fit stayed finite.
    """
    keyframes = (anchor._replace(T_sub_cam=np.eye(4)), *support)
    learned = mapping.create(random_key(cfg, INIT, anchor.number), cfg)
    batch = [keyframes[i % len(keyframes)] for i in range(cfg.map.frames)]
    key = random_key(cfg, MAP, anchor.number)
    learned, _, ok = adjust(learned, batch, [0.0] * len(batch), steps, key, camera, cfg)
    box = volume.grow(None, *_seen(keyframes[0], camera, cfg), cfg.volume)
    return Submap(learned, box, keyframes, T_world_sub), ok


def settle(state: SlamState, cfg: Config) -> tuple[SlamState, list[Sighting]]:
    """After a new keyframe of the active submap: its box grows, the frame is offered to the submaps that see it.

    Only to those of which it is known how they lie: where the camera had been lost, boxes mean nothing.
    Returns the sightings that became linked keyframes.
    """
    keyframe = state.submap.keyframes[-1]
    p_cam, mask = volume.seen(keyframe.depth, mapping_camera(state.camera, cfg), cfg.volume)
    state = state.with_submap(
        state.active,
        box=volume.grow(state.submap.box, volume.moved(keyframe.T_sub_cam, p_cam), mask, cfg.volume),
    )
    sightings, near = [], joined(state, state.active)
    for place, submap in enumerate(state.submaps):
        if place == state.active or place not in near:
            continue
        expected = expect(state, place, cfg)
        inside = volume.contained(submap.box, volume.moved(expected.T_sub_cam, p_cam), mask)
        if inside < cfg.loop.overlap:
            continue
        found = sight(state, place, keyframe, expected, cfg)
        if found is not None:
            state = link(state, keyframe, found)
            sightings.append(found)
    return state, sightings


def expect(state: SlamState, place: int, cfg: Config) -> Expected:
    """Where the newest keyframe of the active submap lies in the submap at `place`.

    Near along the chain the nearest frame that both share says so, up to what tracking may have drifted since: one
    found elsewhere has slid along surfaces that hardly hold it, or turned towards what the submap has never seen. Where
    none is shared, the poses of the submaps say so, up to what may have drifted on the way through those between.
    Across a loop they may be off by any amount.
    """
    keyframe, other, loop = state.submap.keyframes[-1], state.submaps[place], cfg.loop
    way = chain(state, state.active, place)
    by_submaps = inverse(other.T_world_sub) @ state.submap.T_world_sub @ keyframe.T_sub_cam
    if not 0 < len(way) <= loop.apart:
        return Expected(by_submaps)
    shared = links(other, state.submap)
    if not shared:
        passed = [best_link(state.submaps[a], state.submaps[b], True, cfg) for a, b in pairwise(way)]
        reach = sum(float("inf") if link is None else link.reach for link in passed)
        return Expected(by_submaps, *_drifted(float(np.linalg.norm(keyframe.T_sub_cam[:3, 3])) + reach, cfg))
    away = [distance(link.second.T_sub_cam, keyframe.T_sub_cam)[0] for link in shared]
    nearest = min(range(len(shared)), key=away.__getitem__)
    return Expected(shared[nearest].T_first_second @ keyframe.T_sub_cam, *_drifted(away[nearest], cfg))


def _drifted(metres: float, cfg: Config) -> tuple[float, float]:
    """Metres and radians by which a registered frame may be from where it is expected, after a way."""
    loop = cfg.loop
    return loop.sigma + loop.drift * metres, loop.sigma_rotation + loop.drift_rotation * metres


def sight(
    state: SlamState, place: int, keyframe: Keyframe, expected: Expected, cfg: Config, measured: bool = False
) -> Sighting | None:
    """The frame in a submap; None where it does not fit what the submap knows, or not where it was expected.

    Unless that was `measured`, as by image features, the surfaces must hold the frame in every direction.
    """
    loop = cfg.loop
    found = _registered(state.submaps[place], keyframe, expected.T_sub_cam, state.camera, cfg)
    fits = found.overlap >= loop.overlap and found.inliers >= loop.inliers
    if not measured:
        fits = fits and found.held >= loop.held
    if not (np.isfinite(found.T_sub_cam).all() and fits):
        return None
    T_sub_cam = rigid(found.T_sub_cam)
    return Sighting(place, T_sub_cam, float(found.inliers)) if expected.agrees(T_sub_cam) else None


def _registered(submap: Submap, keyframe: Keyframe, guess: Pose, camera: Intrinsics, cfg: Config) -> Any:
    """The frame registered in the submap, on the host. It is registered again from where it ended, while that moves it:
    across a loop the guess may be decimetres off."""
    small, depth = mapping_camera(camera, cfg), jnp.asarray(keyframe.depth)
    views = views_of(nearest(submap.keyframes, guess, VIEWS))

    def register(T_sub_cam: Pose) -> Any:
        start = jnp.asarray(T_sub_cam, jnp.float32)
        return jax.device_get(tracking.register(submap.learned.field, depth, start, small, cfg, views))

    found = register(guess)
    for _ in range(AGAIN):
        if max(distance(guess, found.T_sub_cam)) < STILL:
            break
        guess, found = found.T_sub_cam, register(found.T_sub_cam)
    return found


def link(state: SlamState, keyframe: Keyframe, found: Sighting) -> SlamState:
    """The frame as a keyframe of the submap that it was found in."""
    known = state.submaps[found.submap].keyframes
    (beside,) = nearest(known, found.T_sub_cam, 1)
    # What registration itself may be off by is `loop.sigma`, which each factor has
    shared = keyframe._replace(T_sub_cam=found.T_sub_cam, covariance=beside.covariance)
    return state.with_submap(found.submap, keyframes=(*known, shared))


def govern(state: SlamState, cfg: Config) -> int:
    """Which submap the camera is tracked in from here on: STAY, NEW, or the place of an old one."""
    keyframe = state.submap.keyframes[-1]
    p_cam, mask = volume.seen(keyframe.depth, mapping_camera(state.camera, cfg), cfg.volume)
    shares = {}
    for place, submap in enumerate(state.submaps):
        last = submap.keyframes[-1]
        if last.number == keyframe.number:
            shares[place] = volume.contained(submap.box, volume.moved(last.T_sub_cam, p_cam), mask)
    fresh = volume.contained(volume.grow(None, p_cam, mask, cfg.volume), p_cam, mask)
    return governor(shares.pop(state.active), shares, fresh, cfg)


def enter(state: SlamState, choice: int, cfg: Config) -> SlamState:
    """With the submap active that `govern` chose."""
    if choice == STAY:
        return state
    return _begin_here(state, cfg) if choice == NEW else _revisit(state, choice, cfg)


def _begin_here(state: SlamState, cfg: Config) -> SlamState:
    """A new submap whose anchor is the newest keyframe of the active one."""
    old = state.submap
    *before, anchor = old.keyframes
    T_new_old = inverse(anchor.T_sub_cam)
    before.sort(key=lambda keyframe: keyframe.number, reverse=True)
    support = [_support(k, anchor, T_new_old) for k in before[: cfg.volume.support]]
    T_world_sub = old.T_world_sub @ anchor.T_sub_cam
    new, _ = begin(
        anchor._replace(covariance=NONE), support, T_world_sub, cfg.map.submap_steps, state.camera, cfg
    )
    new = new._replace(parent=state.active)
    return moved_in(state._replace(submaps=(*state.submaps, new)), len(state.submaps), 0)


def _support(keyframe: Keyframe, anchor: Keyframe, T_new_old: Pose) -> Keyframe:
    """A keyframe of one submap in another that begins at a later one, `anchor`."""
    between = difference(anchor.covariance, keyframe.covariance) + difference(
        keyframe.covariance, anchor.covariance
    )
    return keyframe._replace(T_sub_cam=T_new_old @ keyframe.T_sub_cam, covariance=carried(between, T_new_old))


def _revisit(state: SlamState, place: int, cfg: Config) -> SlamState:
    """An old submap takes over, after a few steps on the shared frame, so that tracking goes on smoothly."""
    submap = state.submaps[place]
    newest, number = len(submap.keyframes) - 1, submap.keyframes[-1].number
    if cfg.map.revisit_steps:
        known = submap._replace(keyframes=submap.keyframes[:-1])
        others = choose(known, cfg.map.frames - 2, (cfg.seed, INIT, number))
        share, key = cfg.map.pose_rate_slow, random_key(cfg, MAP, number)
        submap, _ = refine(submap, [newest, *others], share, cfg.map.revisit_steps, key, state.camera, cfg)
    box = volume.grow(submap.box, *_seen(submap.keyframes[-1], state.camera, cfg), cfg.volume)
    return moved_in(state.with_submap(place, **submap._replace(box=box)._asdict()), place, newest)


def moved_in(state: SlamState, place: int, keyframe: int) -> SlamState:
    """The submap at `place` is active, and the last frame hangs on its own keyframe there."""
    own, last = state.submaps[place].keyframes[keyframe], state.records[-1]
    T_new_old = own.T_sub_cam @ inverse(pose_of(state, last))
    held = at(own.covariance, own.T_sub_cam, carried(last.held.joint[6:, 6:], T_new_old))
    last = last._replace(submap=place, keyframe=keyframe, T_keyframe_cam=np.eye(4), held=held)
    return activated(state, place)._replace(records=(*state.records[:-1], last))


def activated(state: SlamState, place: int) -> SlamState:
    """The camera is in the submap at `place` from here on; the one before rests."""
    if place == state.active:
        return state
    state = state.with_submap(state.active, learned=rested(state.submap.learned))
    return state.with_submap(place, learned=awake(state.submaps[place].learned))._replace(active=place)


def _seen(keyframe: Keyframe, camera: Intrinsics, cfg: Config) -> tuple[np.ndarray, np.ndarray]:
    p_cam, mask = volume.seen(keyframe.depth, mapping_camera(camera, cfg), cfg.volume)
    return volume.moved(keyframe.T_sub_cam, p_cam), mask
