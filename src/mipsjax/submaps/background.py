"""Refinement of the submaps that the camera is not in, in turn (Section 3.5 of the paper).

One begins after a frame and is taken over when the next begins, or when the camera changes submaps. Meanwhile it may
run beside the frames; the submap stays as it was.
"""

from __future__ import annotations

from functools import partial

from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics
from mipsjax.submaps.bundle import adjust_submap, adjust_submaps, choose
from mipsjax.submaps.chance import Purpose, generator_for, key_for
from mipsjax.submaps.dormant import packed
from mipsjax.submaps.ids import SubmapId
from mipsjax.submaps.schedule import Executor
from mipsjax.submaps.state import Refinement, SlamState, Submap


def turn(frame: int, active: SubmapId, submaps: int, cfg: Config) -> tuple[SubmapId, ...]:
    """The submaps whose refinement begins after a frame, if any."""
    work = cfg.background
    inactive = [SubmapId(index) for index in range(submaps) if index != active]
    if not work.every_frames or not work.steps or not inactive or frame % work.every_frames:
        return ()
    # So many or one: each other number would be compiled anew
    count = work.together if len(inactive) >= work.together else 1
    # From the number of the frame alone, so that a run that is resumed goes on with the same ones
    first = frame // work.every_frames * count
    return tuple(inactive[(first + i) % len(inactive)] for i in range(count))


def refine_inactive(state: SlamState, cfg: Config, executor: Executor) -> SlamState:
    """Takes the refinement under way over and begins the next, if it is time for it."""
    number = len(state.records)
    places = turn(number, state.active, len(state.submaps), cfg)
    if not places:
        return state
    state = with_refined(state, executor, cfg)
    refinement = Refinement(places, tuple(state.submaps[place] for place in places), number)
    executor.start(partial(refined, camera=state.camera, cfg=cfg), refinement)
    return state._replace(refinement=refinement)


def refined(refinement: Refinement, camera: Intrinsics, cfg: Config) -> list[Submap]:
    """Local bundle adjustment of submaps, each on its anchor and random keyframes; they go on resting."""
    places, submaps, number = refinement
    work, others = cfg.background, cfg.map.frames - 1
    chosen = [
        choose(submap, others, generator_for(cfg, Purpose.BACKGROUND_KEYFRAMES, number, place))
        for submap, place in zip(submaps, places, strict=True)
    ]
    keys = [key_for(cfg, Purpose.BACKGROUND, number, place) for place in places]
    # One alone goes by what is compiled for the active submap
    if len(submaps) == 1:
        (submap,), (some,), (key,) = submaps, chosen, keys
        after = [adjust_submap(submap, some, work.pose_rate, work.steps, key, camera, cfg, work.rate)[0]]
    else:
        after = adjust_submaps(
            list(submaps), chosen, work.pose_rate, work.steps, keys, camera, cfg, work.rate
        )
    return [submap._replace(learned=packed(submap.learned)) for submap in after]


def with_refined(state: SlamState, executor: Executor, cfg: Config) -> SlamState:
    """With the result of the refinement under way, if there is one.

    Keyframes that were added or dropped meanwhile stay so.
    """
    if state.refinement is None:
        return state
    after = executor.result(partial(refined, camera=state.camera, cfg=cfg), state.refinement)
    for place, new in zip(state.refinement.places, after, strict=True):
        poses = {keyframe.id: keyframe.T_sub_cam for keyframe in new.keyframes}
        keyframes = tuple(
            k._replace(T_sub_cam=poses.get(k.id, k.T_sub_cam)) for k in state.submaps[place].keyframes
        )
        state = state.with_submap(place, learned=new.learned, keyframes=keyframes)
    return state._replace(refinement=None)
