"""What holds the camera, in recordings and in drawn homes: one command for a whole table, on two cores at once.

    python experiments/held.py [--groups large homes ...] [--seeds 0 1 2] [--only bookstore ...] [--again]

Each run is a process held to one core, two at a time. Writes `docs/held.csv`, a row a run, as each of them ends, and
in `experiments/out`, where the truth is known, the poses, the mesh and a plan of each: the true and the estimated path
from above. The whole table takes hours: runs of which there is a row of the same code, by a digest of `src/`, are left
out unless `--again`. `results.py` makes a page of the CSV.

Groups: `large`, recordings of the development data; `homes`, ten homes drawn from seeds that are for the test, on which
nobody tuned, slow and fast; `tuning`, others that one may look at; `loops`, where a place is seen again and where it is
not; `rooms` and `kitchen`, earlier figures; `blind`, images made flat, so that surfaces alone hold the camera;
`wrong-depth`, depth that is not what a sequence says, measured along the ray or in whole metres, of which a run must
say so; `colour`, colour in tracking switched off and on; `moving`, somebody who walks through the view, left out
and, for comparison, left in; `no-pairs`, keyframes not measured against each other after
the last frame.

Errors are of the trajectory as it is written; those of columns that begin with `online` are of each pose as it was when
its frame came, from where the map began, before a later loop or the adjustment after the last frame moved it; but
`ate_online_cm` is of all poses as they were after the last frame. Statuses and stated deviations were given as each
frame came. A slide is the
error of the motion over 12 frames, which no residual shows and which alignment of the whole trajectory hides. A true
loop is a pair of submaps, far along the chain, in which the camera saw the same: three tenths of what a keyframe of one
measured, in a keyframe of the other, less than a metre and 30 degrees apart. It is found if the pair is joined in the
end, within 10 cm of the truth; a pair joined otherwise is false. Accuracy is the mean distance of the mesh to the
surface that was seen, where a recording comes with it, without what is farther off than 20 cm, and completion the share
of that surface within 5 cm of the mesh; no mesh is aligned.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import product
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import trimesh
from matplotlib.axes import Axes
from scipy.spatial import KDTree

from common import DATA, OUT, ROOT, Altered, Run, changed, code, read_rows, run, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.presets import preset
from mipsjax.config.sections import Config
from mipsjax.core.camera import Intrinsics, unproject
from mipsjax.core.rigid import align_rigid, distance, inverse, transform
from mipsjax.data.sequence import Frame, Sequence
from mipsjax.mesh.reconstruct import reconstruct
from mipsjax.slam.judge import judged
from mipsjax.submaps.bundle import mapping_camera
from mipsjax.submaps.links import chain_distances, linked_pairs, links
from mipsjax.submaps.state import SlamState, Status, deviations_of, pose_of, trajectory

SLIDE_FRAMES = 12
CHANGE_FRAMES = 15
"""Frames after and before a change of submap that count as near it."""
SEEN_AGAIN_M, SEEN_AGAIN_DEG, SEEN_AGAIN = 1.0, 30.0, 0.3
"""How near one frame must be to another, and the share of what one of both measured that the other must show."""
SAME_M, SAME = 0.05, 0.02
"""Metres, and share of the depth, by which two measurements of one surface may differ."""
JOINED_M = 0.1
FAR_M, NEAR_M = 0.2, 0.05
"""Of a mesh: parts farther off count apart, true surface this near to it is complete."""
SAMPLES = 300_000
OFF_M = 0.3
"""A frame farther off than this, and yet `ok`, was wrong without a word."""
WALK_FRAMES = 30
FLAT = 128
"""Grey of an image that shows nothing."""
RESULTS = ROOT / "docs"
TEST_HOMES, TUNING_HOMES = range(1, 11), range(101, 111)


class Task(NamedTuple):
    """One run."""

    group: str
    name: str
    stride: int = 1
    switch: str = "full"
    seed: int = 0


def homes(seeds: Iterable[int], group: str) -> list[Task]:
    names = [f"synth:home-{seed}{kind}" for seed in seeds for kind in ("+noise", "-fast+noise+blur")]
    return [Task(group, name) for name in names]


def tasks(group: str, seeds: list[int]) -> list[Task]:
    """The runs of a group; of homes, with seed 0 alone."""
    large = ("bookstore", "corridor_walk")
    if group == "large":
        return [Task(group, name, seed=seed) for name, seed in product(large, seeds)]
    if group == "homes":
        return homes(TEST_HOMES, group)
    if group == "tuning":
        return homes(TUNING_HOMES, group)
    if group == "loops":
        names = ("synth:apartment+noise", "synth:corridor-loop+noise", "synth:no-loop+noise")
        return [Task(group, name, seed=seed) for name, seed in product(names, seeds)]
    if group == "rooms":
        names = ("synth:room", "synth:room+noise", "synth:room-fast+noise+blur", "small_house/living")
        return [Task(group, name, seed=seed) for name, seed in product(names, seeds)]
    if group == "kitchen":
        strides = product((1, 4, 8, 16), seeds)
        return [Task(group, "redkitchen", stride, seed=seed) for stride, seed in strides]
    if group == "blind":
        return [Task(group, name, switch="flat", seed=seed) for name, seed in product(large, seeds)]
    if group == "wrong-depth":
        switches = product(large, ("along-ray", "whole-metres"), seeds)
        return [Task(group, name, switch=switch, seed=seed) for name, switch, seed in switches]
    if group == "moving":
        switches = product(
            (("small_house/living", 1), ("redkitchen", 8)), ("walker", "walker-left-in"), seeds
        )
        return [Task(group, *name, switch=switch, seed=seed) for name, switch, seed in switches]
    if group == "no-pairs":
        names = (("bookstore", 1), ("corridor_walk", 1), ("small_house/living", 1), ("redkitchen", 8))
        return [Task(group, *name, switch="no-pairs", seed=seed) for name, seed in product(names, seeds)]
    assert group == "colour"
    real = (("redkitchen", 4), ("rgbd_dataset_freiburg3_excerpt", 1))
    runs = product(real, ("full", "no-colour"), seeds)
    return [Task(group, name, stride, switch, seed) for (name, stride), switch, seed in runs]


GROUPS = (
    "large",
    "homes",
    "tuning",
    "loops",
    "rooms",
    "kitchen",
    "blind",
    "wrong-depth",
    "colour",
    "moving",
    "no-pairs",
)


def flat(sequence: Sequence, place: int) -> Frame:
    """With an image that shows nothing."""
    frame = sequence[place]
    return frame if frame.color is None else frame._replace(color=np.full_like(frame.color, FLAT))


def along_the_ray(sequence: Sequence, place: int) -> Frame:
    """With distances from the camera where depth along its axis should be."""
    frame, camera = sequence[place], sequence.intrinsics
    if frame.depth is None:
        return frame
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    longer = np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)
    return frame._replace(depth=(frame.depth * longer).astype(np.float32))


def in_whole_metres(sequence: Sequence, place: int) -> Frame:
    """With depth as of an image whose unit was taken for a thousand times what it is."""
    frame = sequence[place]
    return frame if frame.depth is None else frame._replace(depth=np.round(frame.depth))


def crossed(sequence: Sequence, place: int) -> Frame:
    """With somebody who walks through the view again and again: a quarter of its width, from one to one and a half
    metres away, in a second of 30 frames, after each of which there is nobody for a second."""
    frame, camera = sequence[place], sequence.intrinsics
    crossing, step = divmod(place, 2 * WALK_FRAMES)
    if frame.depth is None or frame.color is None or step < WALK_FRAMES or crossing == 0:
        return frame
    share = (step - WALK_FRAMES) / WALK_FRAMES
    width = camera.width // 4
    left = round(share * (camera.width + width)) - width
    body = np.s_[camera.height // 6 :, max(left, 0) : left + width]
    depth, color = frame.depth.copy(), frame.color.copy()
    metres = np.float32(1 + 0.5 * share)
    hidden = (depth[body] == 0) | (depth[body] > metres)
    depth[body] = np.where(hidden, metres, depth[body])
    color[body] = np.where(hidden[..., None], np.uint8([40, 70, 160]), color[body])
    return frame._replace(depth=depth, color=color)


ALTERED = {
    "flat": flat,
    "along-ray": along_the_ray,
    "whole-metres": in_whole_metres,
    "walker": crossed,
    "walker-left-in": crossed,
}


def rendered_once(synthetic: Sequence) -> Callable[[Sequence, int], Frame]:
    """Frames of a synthetic sequence, kept in `OUT`: rendering some of them takes as long as tracking them."""
    folder = OUT / "frames" / f"{short(synthetic.name)}-{code('mipsjax/data')}"
    folder.mkdir(parents=True, exist_ok=True)

    def frame(sequence: Sequence, place: int) -> Frame:
        timestamp = float(sequence.timestamps[place])
        path = folder / f"{timestamp:09.4f}.npz"
        if path.exists():
            with np.load(path) as file:
                return Frame(int(file["number"]), timestamp, file["color"], file["depth"])
        rendered = sequence[place]
        begun = path.with_suffix(f".{os.getpid()}.npz")
        np.savez_compressed(begun, number=rendered.number, color=rendered.color, depth=rendered.depth)
        begun.rename(path)
        return rendered

    return frame


def configuration(switch: str) -> Config:
    cfg = preset("default")
    if switch == "no-colour":
        return changed(changed(cfg, "track.corners", count=0), "track.brightness", weight=0.0)
    if switch == "walker-left-in":
        return changed(cfg, "track.moving", most=0.0)
    return changed(cfg, "pairs", before=0, others=0, oldest=0) if switch == "no-pairs" else cfg


def done(task: Task) -> dict[str, Any]:
    """The row of one run."""
    row = task._asdict() | {"code": code()}  # of what is running: `src/` may change before it ends
    enable_cache()
    path = task.name if ":" in task.name else str(DATA / task.name)
    cfg = configuration(task.switch)
    frames, altered = slice(None, None, task.stride), ALTERED.get(task.switch)

    def see(seen: Sequence) -> Sequence:
        seen = Altered(seen, rendered_once(seen)) if ":" in task.name else seen
        return seen if altered is None else Altered(seen, altered)

    found = run(path, cfg, frames=frames, seed=task.seed, see=see)
    row |= found.row | {"sequence": short(task.name)}
    agreement = judged(found.state, cfg)
    row["looked_through"] = float("nan") if agreement is None else agreement.worst.share
    row["contradicted"] = agreement is not None and agreement.begins is not None
    true = found.sequence.T_world_cam
    if true is not None and np.isfinite(true).all():
        row |= slides(found) | near_changes(found) | stated(found.state, true)
        row |= wrong(found.state, trajectory(found.state), true)
        online = wrong(found.state, found.as_it_came, true) | stated_from_first(found, true)
        row |= {f"online_{key}": value for key, value in online.items()}
        mesh = reconstruct(found.state, cfg)
        row |= loops(found, cfg) | surface(mesh, Path(path) / "observed.npz")
        keep(found, mesh, OUT / stem(task), row["code"])
    return row


def stem(task: Task) -> str:
    """Name of the files that are kept of a run, without ending."""
    return f"held-{short(task.name).replace('/', '-')}-{task.stride}-{task.switch}-{task.seed}"


def keep(found: Run, mesh: trimesh.Trimesh, path: Path, program: str) -> None:
    """Writes, each with its own ending, poses, status and submap of each frame with the loops (frame, two submaps; how;
    kept or not), the mesh, and a plan."""
    path.parent.mkdir(exist_ok=True)
    mesh.export(path.with_name(f"{path.name}.ply"))
    records, poses, true = found.state.records, trajectory(found.state), found.sequence.T_world_cam
    closed = found.state.loops
    np.savez_compressed(
        path.with_name(f"{path.name}.npz"),
        code=program,
        poses=poses,
        true=true,
        status=[str(record.status) for record in records],
        submap=[record.submap for record in records],
        loops=np.array([(loop.record, loop.first, loop.second) for loop in closed], int).reshape(-1, 3),
        how=[str(loop.how) for loop in closed],
        kept=[loop.weight > 0 for loop in closed],
    )
    figure, axes = plt.subplots(figsize=(6, 6))
    plan(axes, poses, true)
    axes.set_title(f"{path.name} ({program})", fontsize=8)
    axes.legend()
    figure.savefig(path.with_name(f"{path.name}.png"), dpi=100, bbox_inches="tight")
    plt.close(figure)


def plan(axes: Axes, poses: np.ndarray, true: np.ndarray) -> None:
    """True and estimated path from above, the latter aligned to the former, in metres."""
    T = align_rigid(poses[:, :3, 3], true[:, :3, 3])
    aligned = (T @ poses)[:, :3, 3]
    spread = np.ptp(true[:, :3, 3], axis=0)
    x, y = np.sort(np.argsort(spread)[1:])  # the two directions in which the camera moves most
    axes.plot(true[:, x, 3], true[:, y, 3], color="0.6", linewidth=3, label="true")
    axes.plot(aligned[:, x], aligned[:, y], color="C3", linewidth=1, label="estimated")
    axes.set_aspect("equal")
    axes.set_xlabel("metres")


def surface(mesh: trimesh.Trimesh, observed: Path) -> dict[str, Any]:
    """How well the mesh shows the surface that was seen, where a recording has a file of it."""
    if not observed.exists():
        return {}
    with np.load(observed) as file:
        true = file["q"].T * file["step"] + file["origin"]
    if mesh.is_empty:
        return {"completion": 0.0}
    sampled, _ = trimesh.sample.sample_surface(mesh, SAMPLES, seed=0)
    off, missing = KDTree(true).query(sampled)[0], KDTree(sampled).query(true)[0]
    near = off <= FAR_M
    return {
        "accuracy_cm": 100 * float(off[near].mean()) if near.any() else float("nan"),
        "left_out": float(np.mean(~near)),
        "completion": float(np.mean(missing <= NEAR_M)),
    }


def slides(found: Run) -> dict[str, Any]:
    """Largest errors of the motion over `SLIDE_FRAMES` frames, and where the largest shift begins."""
    metres, radians = motion_errors(found, SLIDE_FRAMES).T
    return {
        "slide_max_cm": 100 * float(metres.max()),
        "slide_from": int(metres.argmax()),
        "turn_max_deg": float(np.degrees(radians.max())),
    }


def motion_errors(found: Run, frames: int) -> np.ndarray:
    """Metres and radians by which the motion over so many frames, or over all of a shorter run, is wrong, N x 2."""
    poses, true = trajectory(found.state), found.sequence.T_world_cam
    frames, errors = min(frames, len(poses) - 1), []
    for begin in range(len(poses) - frames):
        moved, truly = (inverse(T[begin]) @ T[begin + frames] for T in (poses, true))
        errors.append(distance(truly, moved))
    return np.array(errors)


def wrong(state: SlamState, poses: np.ndarray, true: np.ndarray) -> dict[str, Any]:
    """Frames that are `ok` and yet far off. The first frame was given its true pose; nothing is aligned."""
    off = np.linalg.norm(poses[:, :3, 3] - true[:, :3, 3], axis=1)
    ok = np.array([record.status is Status.OK for record in state.records])
    return {
        "wrong_ok": int(np.sum(ok & (off > OFF_M))),
        "off_max_cm": 100 * float(off.max()),
        "ok_off_max_cm": 100 * float(off[ok].max()),  # the first frame is always `ok`
    }


def stated(state: SlamState, true: np.ndarray) -> dict[str, Any]:
    """Share of frames whose error in their submap is within three times the stated deviation; anchors have none."""
    within = []
    for place, record in enumerate(state.records):
        deviation, _ = deviations_of(state, record)
        if deviation > 0:
            anchor = state.submaps[record.submap].anchor.id
            metres, _ = distance(inverse(true[anchor]) @ true[place], pose_of(state, record))
            within.append(metres <= 3 * deviation)
    return {"within_3_deviations": float(np.mean(within)) if within else float("nan")}


def stated_from_first(found: Run, true: np.ndarray) -> dict[str, Any]:
    """The same from where the map began, of frames after the first, as they came."""
    metres = np.linalg.norm(found.as_it_came[:, :3, 3] - true[:, :3, 3], axis=1)
    deviation = np.array([info.world_deviation_m for info in found.infos])
    return {"within_3_deviations": float(np.mean(metres[1:] <= 3 * deviation[1:]))}


def near_changes(found: Run) -> dict[str, Any]:
    """Median error of the motion over a frame near a change of submap, and elsewhere."""
    submaps = [record.submap for record in found.state.records]
    changes = np.flatnonzero(np.diff(submaps)) + 1
    metres = motion_errors(found, 1)[:, 0]
    frames = np.arange(1, len(metres) + 1)
    near = (np.abs(frames[:, None] - changes[None]) <= CHANGE_FRAMES).any(1)
    if not near.any() or near.all():
        return {}
    middle = {"near_change_mm": near, "elsewhere_mm": ~near}
    return {name: 1000 * float(np.median(metres[chosen])) for name, chosen in middle.items()}


def loops(found: Run, cfg: Config) -> dict[str, Any]:
    """True loops, those of them that were found, and false ones that were kept."""
    state, true = found.state, found.sequence.T_world_cam
    joined = set(linked_pairs(state))
    away = [chain_distances(state, place) for place in range(len(state.submaps))]
    camera = mapping_camera(state.camera, cfg)
    own = [
        [(k.depth, true[k.id]) for k in submap.keyframes if state.records[k.id].submap == place]
        for place, submap in enumerate(state.submaps)
    ]
    count = {"loops_true": 0, "loops_found": 0, "loops_false": 0}
    for j, k in product(range(len(state.submaps)), repeat=2):
        if j >= k or away[j][k] < cfg.loop.apart:
            continue
        again = any(seen_again(a, b, camera) for a in own[j] for b in own[k])
        right = (j, k) in joined and _rightly(state, j, k, true)
        count["loops_true"] += again
        count["loops_found"] += again and right
        count["loops_false"] += (j, k) in joined and not right
    return count


Posed = tuple[np.ndarray, np.ndarray]
"""A depth image, metres, and the true pose of its camera."""


def seen_again(first: Posed, second: Posed, camera: Intrinsics) -> bool:
    """Whether one of two frames shows enough of what the other does, from about the same place: not through a wall."""
    metres, radians = distance(first[1], second[1])
    if metres >= SEEN_AGAIN_M or radians >= np.radians(SEEN_AGAIN_DEG):
        return False
    return max(_shown(first, second, camera), _shown(second, first, camera)) >= SEEN_AGAIN


def _shown(first: Posed, second: Posed, camera: Intrinsics) -> float:
    """Share of what the first frame measured that the second measured too, at its true pose."""
    (depth, T_world_first), (other, T_world_second) = first, second
    v, u = np.nonzero(depth)
    T_second_first = inverse(T_world_second) @ T_world_first
    x, y, z = transform(T_second_first, unproject(v, u, depth[v, u], camera)).T
    z = np.where(z > 0, z, np.inf)
    u, v = np.rint(camera.fx * x / z + camera.cx), np.rint(camera.fy * y / z + camera.cy)
    inside = np.isfinite(z) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    measured = other[v[inside].astype(int), u[inside].astype(int)]
    same = (measured > 0) & (np.abs(measured - z[inside]) < SAME_M + SAME * measured)
    return float(same.sum() / max(len(z), 1))


def _rightly(state: SlamState, j: int, k: int, true: np.ndarray) -> bool:
    """Whether the frames that two submaps share are where they were in both."""
    off = []
    for link in links(state.submaps[j], state.submaps[k]):
        for place, keyframe in zip((j, k), link, strict=True):
            anchor = state.submaps[place].anchor.id
            off.append(distance(inverse(true[anchor]) @ true[keyframe.id], keyframe.T_sub_cam)[0])
    return float(np.median(off)) < JOINED_M


def in_a_process(task: Task, core: int) -> dict[str, Any]:
    """One run, held to one core: two at once then leave each other alone."""
    command = [sys.executable, __file__, "--one", json.dumps(task), "--core", str(core)]
    ended = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if ended.returncode:
        return task._asdict() | {"sequence": short(task.name), "failed": f"exit code {ended.returncode}"}
    return json.loads(ended.stdout.splitlines()[-1])


def all_of(wanted: list[Task], workers: int, again: bool) -> None:
    """All runs, as many at a time as there are workers, each on a core of its own; replaces rows of the same runs."""
    rows, now = {_key(row): row for row in read_rows("held", RESULTS)}, code()
    known = {key for key, row in rows.items() if row.get("code") == now and not row.get("failed")}
    wanted = [task for task in wanted if again or _key(task._asdict()) not in known]
    cores: SimpleQueue[int] = SimpleQueue()
    for core in sorted(os.sched_getaffinity(0))[:workers]:
        cores.put(core)

    def work(task: Task) -> dict[str, Any]:
        core = cores.get()
        try:
            return in_a_process(task, core)
        finally:
            cores.put(core)

    own: dict[tuple[str, ...], dict[str, Any]] = {}
    with ThreadPoolExecutor(workers) as pool:
        for ended in as_completed([pool.submit(work, task) for task in wanted]):
            row = {"code": now} | ended.result()
            own[_key(row)] = row
            show(row)
            # Read anew: another process may have added rows of other runs
            rows = {_key(row): row for row in read_rows("held", RESULTS)} | own
            write_rows("held", rows.values(), RESULTS)


def short(name: str) -> str:
    """A sequence without the kind of its source."""
    return name.removeprefix("synth:")


def _key(row: Mapping[str, Any]) -> tuple[str, ...]:
    return tuple(str(row[field]) for field in Task._fields)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--groups", nargs="*", choices=GROUPS, default=[g for g in GROUPS if g != "tuning"])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument(
        "--only", nargs="*", default=[""], help="parts of names, which every name has one of if none is given"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--again", action="store_true", help="also what there is a row of already")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--core", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        os.sched_setaffinity(0, {options.core})
        print(json.dumps(done(Task(*json.loads(options.one)))))
    else:
        every = [task for group in options.groups for task in tasks(group, options.seeds)]
        wanted = [task for task in every if any(part in task.name for part in options.only)]
        all_of(wanted, options.workers, options.again)


if __name__ == "__main__":
    main()
