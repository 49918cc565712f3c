"""Loop closure with fields fitted to exact depth: how much of an injected loop error goes away.

    python experiments/drift.py [--counts 4 6 10] [--errors 0.2 0.5 1.0] [--false 0 3] [--seeds 0]

The closed walk of `synth:apartment` is cut into 4, 6 or 10 submaps. Their networks learn exact depth from true poses,
relative to the anchor. Each submap's anchor is also the last keyframe of the submap before: those shared frames carry
a drift that adds up to exactly the given error (0.2 m and 5 degrees, 0.5 m and 10, 1 m and 20) around the ring. Then
the last frame meets the first submap again: found by its image, verified in the field, linked, and the pose graph is
solved as in a run. False loops are shared frames with poses 2 to 4 m and 30 to 120 degrees wrong, between submaps at
least two apart (two in a ring of four, which has no more such pairs). Errors are those of the last submap's pose, and
the mean over all but the first. Writes `drift.csv`.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax
import numpy as np

from common import changed, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.core import mapping, volume
from mipsjax.core.rigid import distance, from_parts, inverse, rotation, to_twist, transform
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Sequence
from mipsjax.images.features import detect
from mipsjax.submaps.bundle import adjust, make_keyframe
from mipsjax.submaps.chance import Purpose, key_for
from mipsjax.submaps.closure import solve
from mipsjax.submaps.ids import FrameId, SubmapId
from mipsjax.submaps.proposals import proposed, with_links
from mipsjax.submaps.recognition import recognise
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import (
    How,
    Keyframe,
    Pose,
    Record,
    SlamState,
    Status,
    Submap,
)

KEYFRAMES = 12  # of each submap
CALLS, STEPS = 40, 10  # of mapping
DEGREES = {0.2: 5.0, 0.5: 10.0, 1.0: 20.0}
FALSE_M, FALSE_DEG = (2.0, 4.0), (30.0, 120.0)


def built(sequence: Sequence, count: int, cfg: Config) -> SlamState:
    """Submaps along the walk, all at their true poses."""
    truth = sequence.T_world_cam
    assert truth is not None
    borders = np.linspace(0, len(sequence) - 1, count + 1).astype(int)
    submaps = [
        submap(sequence, *borders[i : i + 2], cfg)._replace(parent=i - 1 if i else None) for i in range(count)
    ]
    last = SubmapId(count - 1)
    record = Record(FrameId(0), 0.0, last, submaps[last].anchor.id, np.eye(4), Status.OK)
    return SlamState(tuple(submaps), last, Records.of([record]), sequence.intrinsics, 0)


def submap(sequence: Sequence, first: int, last: int, cfg: Config) -> Submap:
    truth = sequence.T_world_cam
    assert truth is not None
    keyframes = [
        keyframe(sequence, int(i), np.linalg.inv(truth[first]) @ truth[i], cfg)
        for i in np.linspace(first, last, KEYFRAMES).astype(int)
    ]
    learned, rng = mapping.create(jax.random.key(first), cfg), np.random.default_rng(first)
    for call in range(CALLS):
        batch = [keyframes[i] for i in rng.choice(KEYFRAMES, cfg.map.frames, replace=False)]
        rates, key = [0.0] * len(batch), key_for(cfg, Purpose.MAP, first + call)
        learned, _, _ = adjust(learned, batch, rates, STEPS, key, sequence.intrinsics, cfg, 1 - call / CALLS)
    box = None
    small = sequence.intrinsics.decimated(sequence.intrinsics.width // keyframes[0].depth.shape[1])
    for k in keyframes:
        p_cam, mask = volume.seen(k.depth, small, cfg.volume)
        box = volume.grow(box, transform(k.T_sub_cam, p_cam), mask, cfg.volume)
    assert box is not None
    return Submap(learned, box, tuple(keyframes), truth[first])


def keyframe(sequence: Sequence, place: int, T_sub_cam: Pose, cfg: Config) -> Keyframe:
    frame = sequence[place]
    assert frame.depth is not None and frame.color is not None
    made = make_keyframe(frame, place, T_sub_cam, cfg, sequence.intrinsics)
    return made._replace(features=detect(frame.color, frame.depth, sequence.intrinsics))


def drifted(state: SlamState, metres: float, degrees: float, rng: np.random.Generator) -> SlamState:
    """The same with submaps that are off by a share of the error that grows along the ring, as shared frames say.

    The error is a turn about the last submap's origin and a shift, so that all of it, and no more, shows there.
    """
    edges = len(state.submaps) - 1
    whole = motion(rng, metres, degrees)
    whole = to_twist(whole)
    center = state.submaps[-1].T_world_sub[:3, 3]
    for place, submap in enumerate(state.submaps):
        pose, share = submap.T_world_sub, place / edges
        turn = rotation(share * whole[3:])
        off = from_parts(turn, center - turn @ center + share * whole[:3])
        state = state.with_submap(place, T_world_sub=off @ pose)
    for place in range(edges):
        here, after = state.submaps[place], state.submaps[place + 1]
        shared = here.keyframes[-1]._replace(T_sub_cam=inverse(here.T_world_sub) @ after.T_world_sub)
        state = state.with_submap(place, keyframes=(*here.keyframes[:-1], shared))
    return state


def motion(rng: np.random.Generator, metres: float, degrees: float) -> Pose:
    shift, axis = rng.standard_normal((2, 3))
    turn = rotation(np.radians(degrees) * axis / np.linalg.norm(axis))
    return from_parts(turn, metres * shift / np.linalg.norm(shift))


def closed(
    state: SlamState, false: int, rng: np.random.Generator, cfg: Config
) -> tuple[SlamState, dict[str, Any]]:
    """After the last frame meets the first submap, and `false` frames meet submaps that they do not show."""
    count, last = len(state.submaps), state.submap.keyframes[-1]
    found = recognise(state, last, [0], cfg)
    if found is None:
        return state, {"found": False}
    state = with_links(state, [proposed(state, state.active, last, found, How.FEATURES)])
    suspects = {(0, count - 1)}
    free = [(j, k) for j in range(count) for k in range(j + 2, count) if (j, k) != (0, count - 1)]
    for j, k in (free[i] for i in rng.choice(len(free), min(false, len(free)), replace=False)):
        shown = state.submaps[k].keyframes[KEYFRAMES // 2]
        truth = np.linalg.inv(state.submaps[j].T_world_sub) @ state.submaps[k].T_world_sub @ shown.T_sub_cam
        wrong = truth @ motion(rng, rng.uniform(*FALSE_M), rng.uniform(*FALSE_DEG))
        state = state.with_submap(j, keyframes=(*state.submaps[j].keyframes, shown._replace(T_sub_cam=wrong)))
        suspects.add((j, k))
    solved, weights = solve(state, cfg)
    kept = {
        "true_kept": weights[0, count - 1],
        "false_kept": sum(weights[p] for p in suspects) - weights[0, count - 1],
    }
    return solved, {"found": True, "false": len(suspects) - 1, **kept}


def errors(state: SlamState, truth: SlamState) -> np.ndarray:
    """Metres and radians of every submap but the first."""
    pairs = zip(state.submaps[1:], truth.submaps[1:], strict=True)
    return np.array([distance(a.T_world_sub, b.T_world_sub) for a, b in pairs])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--counts", type=int, nargs="*", default=[4, 6, 10])
    parser.add_argument("--errors", type=float, nargs="*", default=list(DEGREES))
    parser.add_argument("--false", type=int, nargs="*", default=[0, 3])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    options = parser.parse_args()
    enable_cache()
    cfg, rows = changed(Config(), "loop", apart=2), []
    sequence = open_sequence("synth:apartment")
    for count in options.counts:
        truth = built(sequence, count, cfg)
        for metres in options.errors:
            for false in options.false:
                for seed in options.seeds:
                    rng = np.random.default_rng((seed, count))
                    start = drifted(truth, metres, DEGREES[metres], rng)
                    end, info = closed(start, false, rng, cfg)
                    before, after = errors(start, truth), errors(end, truth)
                    removed = 100 * (1 - after / before)
                    rows.append(
                        {"submaps": count, "error_m": metres, "error_deg": DEGREES[metres], "seed": seed}
                        | info
                        | {"before_cm": 100 * before[-1, 0], "before_deg": np.degrees(before[-1, 1])}
                        | {"after_cm": 100 * after[-1, 0], "after_deg": np.degrees(after[-1, 1])}
                        | {"removed_m": removed[-1, 0], "removed_rad": removed[-1, 1]}
                        | {"removed_mean_m": 100 * (1 - after[:, 0].sum() / before[:, 0].sum())}
                        | {"removed_mean_rad": 100 * (1 - after[:, 1].sum() / before[:, 1].sum())}
                    )
                    show(rows[-1])
                    write_rows("drift", rows)


if __name__ == "__main__":
    main()
