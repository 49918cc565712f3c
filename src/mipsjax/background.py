"""Refinement of the submaps that the camera is not in, in turn (Section 3.5 of the paper).

One begins after a frame and is taken over when the next begins, or when the camera changes submaps. Meanwhile it may
run beside the frames; the submap stays as it was.
"""

from __future__ import annotations

import jax

from mipsjax.bundle import BACKGROUND, choose, random_key, refine, refine_together
from mipsjax.config import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.rest import rested
from mipsjax.schedule import Executor, Job
from mipsjax.state import Refinement, SlamState, Submap


def turn(frame: int, active: int, submaps: int, cfg: Config) -> tuple[int, ...]:
    """The submaps whose refinement begins after a frame, if any."""
    work = cfg.background
    inactive = [place for place in range(submaps) if place != active]
    if not work.every_frames or not work.steps or not inactive or frame % work.every_frames:
        return ()
    count = work.together if len(inactive) >= work.together else 1
    first = frame // work.every_frames * count
    return tuple(inactive[(first + i) % len(inactive)] for i in range(count))


def refine_inactive(state: SlamState, cfg: Config, executor: Executor) -> SlamState:
    """Takes the refinement under way over and begins the next, if it is time for it."""
    number = len(state.records)
    places = turn(number, state.active, len(state.submaps), cfg)
    if not places:
        return state
    state = taken_over(state, executor)
    submaps = tuple(state.submaps[place] for place in places)
    job = Job(refined, (submaps, places, number, state.camera, cfg))
    executor.start(job)
    return state._replace(refinement=Refinement(places, job))


def refined(
    submaps: tuple[Submap, ...], places: tuple[int, ...], number: int, camera: Intrinsics, cfg: Config
) -> list[Submap]:
    """Local bundle adjustment of submaps, each on its anchor and random keyframes; they go on resting."""
    work, others = cfg.background, cfg.map.frames - 1
    chosen = [
        choose(submap, others, (cfg.seed, BACKGROUND, number, place))
        for submap, place in zip(submaps, places, strict=True)
    ]
    keys = [jax.random.fold_in(random_key(cfg, BACKGROUND, number), place) for place in places]
    if len(submaps) == 1:
        (submap,), (some,), (key,) = submaps, chosen, keys
        after = [refine(submap, some, work.pose_rate, work.steps, key, camera, cfg, work.rate)[0]]
    else:
        after = refine_together(
            list(submaps), chosen, work.pose_rate, work.steps, keys, camera, cfg, work.rate
        )
    return [submap._replace(learned=rested(submap.learned)) for submap in after]


def taken_over(state: SlamState, executor: Executor) -> SlamState:
    """With the result of the refinement under way, if there is one.

    Keyframes that were added or dropped meanwhile stay so.
    """
    if state.refinement is None:
        return state
    places, job = state.refinement
    for place, new in zip(places, executor.result(job), strict=True):
        poses = {keyframe.number: keyframe.T_sub_cam for keyframe in new.keyframes}
        keyframes = tuple(
            k._replace(T_sub_cam=poses.get(k.number, k.T_sub_cam)) for k in state.submaps[place].keyframes
        )
        state = state.with_submap(place, learned=new.learned, keyframes=keyframes)
    return state._replace(refinement=None)
