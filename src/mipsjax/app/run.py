"""`python -m mipsjax.run SEQUENCE`: from an RGB-D sequence to a trajectory and a mesh."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import fields
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import trimesh

from mipsjax.app import checkpoint, outputs, signals
from mipsjax.app.checkpoint import Checkpoints, Progress
from mipsjax.app.commandline import Options, bugs_saved_in, complain, ended, parse, say
from mipsjax.app.compilation import enable_cache
from mipsjax.app.kept_map import opened_map, write_map
from mipsjax.app.memory import return_memory
from mipsjax.app.progress import progress, teller
from mipsjax.app.results_folder import choose_folder, claimed, sibling
from mipsjax.app.resume import end_of, progress_in, resumed_options
from mipsjax.app.summary import MIN_USABLE, OUTGROWN, FrameRow, Run, failure, outgrown, verdict
from mipsjax.config.sections import Config
from mipsjax.data.open import SYNTH_PREFIX, describe, open_sequence, parse_frames
from mipsjax.data.sequence import Frame, Sequence
from mipsjax.data.suspicion import suspicions_of_truth
from mipsjax.errors import InputError, MipsjaxError
from mipsjax.mesh.reconstruct import reconstruct
from mipsjax.slam import step as slam
from mipsjax.slam.finish import finish
from mipsjax.slam.info import FrameInfo
from mipsjax.slam.judge import judged
from mipsjax.slam.localise import localise
from mipsjax.submaps.ids import FrameId
from mipsjax.submaps.schedule import executor
from mipsjax.submaps.state import Pose, SlamState, Status, trajectory
from mipsjax.viewer.live import Viewer, is_installed, viewer

log = logging.getLogger(__name__)


def main(arguments: list[str] | None = None) -> int:
    """The program; returns its exit code. Errors are one line on stderr."""
    return ended(lambda: _main(sys.argv[1:] if arguments is None else arguments))


def travel(
    sequence: Sequence,
    cfg: Config,
    stop: Callable[[], bool],
    tell: Callable[[Status], None],
    kept: Checkpoints,
    before: Progress = Progress(),  # noqa: B008 (a value)
    learn: bool = True,
    show: Callable[[SlamState, FrameInfo, Frame], None] | None = None,
) -> Run:
    """All frames in turn, after those of `before`, until `stop` says so or too many are bad. `tell` hears the status
    of each, `show` gets each with the state after it, and `kept` writes checkpoints. Without `learn` the map of
    `before` stays as it is.

    A new map starts with the first frame that has colour and enough depth; frames before it are passed over.
    """
    state, bad = before.state, before.bad
    waited, infos = list(before.waited), list(before.infos)
    read_s, step_s = list(before.read_s), list(before.step_s)

    def so_far() -> Progress:
        return Progress(state, tuple(waited), tuple(infos), tuple(read_s), tuple(step_s), bad)

    with executor(cfg.background.executor) as beside:
        # Each frame that was read, whatever came of it, has its time in the list
        for position in range(len(read_s), len(sequence)):
            if stop() or bad > cfg.input.max_bad_frames:
                break
            began = perf_counter()
            frame = sequence[position]
            read_s.append(perf_counter() - began)
            if state is not None:
                state, info = slam.step(state, frame, cfg, beside) if learn else localise(state, frame, cfg)
                infos.append(info)
            elif reason := slam.anchor_problem(frame, cfg):
                waited.append(
                    FrameRow(FrameId(frame.number), frame.timestamp, Status.SKIPPED, FrameInfo(note=reason))
                )
            else:
                state, info = slam.start(frame, sequence.intrinsics, cfg, _true_pose(sequence, position))
                infos.append(info)
            step_s.append(perf_counter() - began - read_s[-1])
            status = Status.SKIPPED if state is None else state.records[-1].status
            bad += status is Status.SKIPPED
            if state is not None:
                waited_ms = kept.after(infos[-1].keyframe, so_far)
                infos[-1] = infos[-1]._replace(checkpoint_ms=waited_ms)
                if show is not None:
                    show(state, infos[-1], frame)
            tell(status)
        interrupted = len(read_s) < len(sequence) and bad <= cfg.input.max_bad_frames
        # Before `finish`, which ends the map: what is resumed goes on with the next frame
        if interrupted and state is not None:
            kept.last(so_far())
        began = perf_counter()
        if state is not None and learn:
            state = finish(state, cfg, beside)
    finish_s = perf_counter() - began
    too_bad = bad > cfg.input.max_bad_frames
    end = "bad frames" if too_bad else "interrupted" if interrupted else "done"
    return Run(sequence, state, tuple(waited), tuple(infos), tuple(read_s), tuple(step_s), end, finish_s)


def _main(arguments: list[str]) -> int:
    options = resumed_options(arguments) or parse(arguments)
    return _inspect(options) if options.inspect else _run(options)


def _run(options: Options) -> int:
    """Opens, tracks, writes; the exit code where that is no error. Raises MipsjaxError."""
    cfg, tell = options.settings, teller(options.quiet)
    if options.resume is not None and (ended := end_of(options.resume)):
        if ended.failure is not None:
            raise ended.failure(ended.text)
        tell(ended.text)
        return 0
    enable_cache()
    began = perf_counter()
    sequence = _open(options)
    opened_s = perf_counter() - began
    folder = options.resume or choose_folder(sequence.name, options.out, _source(options))
    identity, before, learn = checkpoint.identity(cfg, sequence), Progress(), not options.localise_only
    with (
        signals.noted() as stop,
        claimed(folder) as held,
        bugs_saved_in(folder),
        _warnings(tell) as remarks,
    ):
        tell("\n".join([f"{sequence.name}: {len(sequence)} frames, results in {folder}", *sequence.notes]))
        if options.map is not None and options.resume is None:
            before = Progress(opened_map(options.map, cfg, sequence))
        if options.resume is None:
            outputs.write_config(folder, cfg, _plain_options(options), sequence)
        else:
            before = progress_in(folder, identity)
            checkpoint.tidy(folder)
            remarks[:0] = before.remarks
            tell(f"goes on after {len(before.read_s)} frames")
        with (
            _viewer(options, sequence, tell) as page,
            checkpoint.checkpoints(folder, identity, cfg.checkpoint, remarks) as kept,
            progress(len(sequence), len(before.read_s), options.quiet) as tell_status,
        ):
            show = None if page is None else page.after
            go_no_further = stop if page is None else partial(page.wait, stop)
            run = travel(sequence, cfg, go_no_further, tell_status, kept, before, learn, show)
        state = run.state
        if state is None or not run.infos:
            raise _nothing_usable(run)
        return_memory()
        began = perf_counter()
        run = run._replace(agreement=judged(state, cfg))
        judged_s = perf_counter() - began
        if run.T_truth_cam is not None:
            for remark in suspicions_of_truth(trajectory(state), run.T_truth_cam):
                log.warning(remark)
        if outgrown(run):
            log.warning(OUTGROWN)
        if not held():
            log.warning("%s was deleted or taken by another run meanwhile", folder)
            folder = sibling(folder)
            outputs.write_config(folder, cfg, _plain_options(options), sequence)
            log.warning("the results go to %s", folder)
        seconds = {"open": opened_s, "judge": judged_s}
        with_mesh = learn and not options.no_mesh
        meshing = "unfinished" if with_mesh else "none"
        content = outputs.write_results(folder, run, None, seconds, remarks, meshing)
        # A signal that came after the last frame ends the program before the mesh
        late = stop() and run.end == "done"
        if learn and not options.no_map and run.end != "interrupted":
            write_map(folder, state, cfg)
        if with_mesh:
            began = perf_counter()
            mesh = None if late else _mesh(state, cfg)
            if mesh is None:
                complain(f"interrupted: all results but the mesh are in {folder}")
                return signals.INTERRUPTED
            seconds["mesh"] = perf_counter() - began
            content = outputs.write_results(folder, run, mesh, seconds, remarks, "done")
        if run.end != "interrupted":
            checkpoint.remove(folder)
        tell(_summary(content))
        if options.viewer and is_installed():
            tell(f"python -m mipsjax.view {folder} shows it")
        return _exit_code(run, folder)


def _viewer(
    options: Options, sequence: Sequence, tell: Callable[[str], None]
) -> AbstractContextManager[Viewer | None]:
    """The page beside a run, if one is wanted; true poses are shown where the map lies as they do."""
    if not options.viewer:
        return nullcontext()
    truth = None if options.map is not None or _true_pose(sequence, 0) is None else sequence.T_world_cam
    return viewer(options.settings, tell, options.viewer_port, truth)


def _mesh(state: SlamState, cfg: Config) -> trimesh.Trimesh | None:
    """The mesh of the map; None where a signal ends it, which it does at once: everything else is written by then."""
    try:
        with signals.raising():
            return reconstruct(state, cfg)
    except KeyboardInterrupt:
        return None


def _exit_code(run: Run, folder: Path) -> int:
    """0 or 130. Raises InputError or TrackingLostError where the results are not whole; they are written by
    then."""
    if run.end == "interrupted":
        on = f"; --resume {folder} goes on" if checkpoint.written(folder) else ""
        complain(f"interrupted: results up to then are in {folder}{on}")
        return signals.INTERRUPTED
    rows = run.rows
    usable = sum(row.status is not Status.SKIPPED for row in rows)
    # Depth images that contradict each other degrade a run, and fail none
    failed = failure(run.end, verdict(rows), usable)
    if failed is not None:
        raise failed(_why(run, folder))
    return 0


def _why(run: Run, folder: Path) -> str:
    """What is wrong with the results of a run that failed."""
    rows = run.rows
    bad = [row for row in rows if row.status is Status.SKIPPED]
    if run.end == "bad frames":
        return (
            f"{len(bad)} of {len(rows)} frames are unusable, the last one: {bad[-1].info.note}; results up "
            f"to then are in {folder}; --input.max-bad-frames allows more"
        )
    if len(rows) - len(bad) < MIN_USABLE:
        return f"only 1 of {len(rows)} frames is usable, the others are like: {bad[-1].info.note}"
    if run.state is not None and not run.state.located:
        return (
            f"the camera was not found in the map in any of {len(rows)} frames; the results in {folder} are marked as "
            "failed; is it of the same place, and has it colour?"
        )
    lost = [row.frame for row in rows if row.status is Status.LOST]
    return (
        f"tracking was lost in {len(lost)} of {len(rows)} frames, first in frame {lost[0]}; the results "
        f"in {folder} are marked as failed; more --track.ro.particles or --map.steps may help"
    )


def _nothing_usable(run: Run) -> MipsjaxError | KeyboardInterrupt:
    if run.end == "interrupted":
        return KeyboardInterrupt()
    reason = run.waited[-1].info.note if run.waited else "none was read"
    text = f"none of {len(run.waited)} frames has usable colour and depth, the last one: {reason}"
    more = (
        f"; the other {len(run.sequence) - len(run.waited)} were not read: --input.max-bad-frames allows more"
    )
    return InputError(text + more if run.end == "bad frames" else text)


def _inspect(options: Options) -> int:
    say(describe(_open(options)))
    return 0


def _open(options: Options) -> Sequence:
    sequence = open_sequence(
        options.sequence,
        layout=options.layout,
        intrinsics=options.intrinsics,
        depth_scale=options.depth_scale,
        frames=parse_frames(options.frames),
        input=options.settings.input,
        depth_topic=options.depth_topic,
        color_topic=options.color_topic,
    )
    if len(sequence) < MIN_USABLE:
        raise InputError(f"{options.sequence}: 1 frame selected, at least {MIN_USABLE} are needed")
    return sequence


def _true_pose(sequence: Sequence, position: int) -> Pose | None:
    """Where the first frame is in the world, if that is known."""
    if sequence.T_world_cam is None or not np.isfinite(sequence.T_world_cam[position]).all():
        return None
    return sequence.T_world_cam[position]


def _source(options: Options) -> Path | None:
    return None if options.sequence.startswith(SYNTH_PREFIX) else Path(options.sequence)


def _plain_options(options: Options) -> dict[str, Any]:
    """The command line for config.json."""
    values = {
        item.name: getattr(options, item.name)
        for item in fields(options)
        if item.name not in ("settings", "resume")
    }
    # Whatever folder one is in when it goes on
    return {
        name: os.path.abspath(value) if isinstance(value, Path) else value for name, value in values.items()
    }


def _summary(content: dict[str, Any]) -> str:
    """One line at the end."""
    fps, ate = content["fps"], content.get("ate_rmse_m")
    parts = [f"{content['status']}: {content['frames']} frames in {content['seconds']:.1f} s"]
    parts += [f"{fps:.1f} frames/s after compilation"] if fps else []
    parts += [f"{content['keyframes']} keyframes"]
    parts += [f"ATE {100 * ate:.2f} cm"] if ate is not None else []
    return ", ".join(parts)


@contextmanager
def _warnings(tell: Callable[[str], None]) -> Iterator[list[str]]:
    """Collects what the library logs, and says it."""
    texts: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            texts.append(record.getMessage())
            tell(f"{record.levelname.lower()}: {texts[-1]}")

    handler, logger = Collector(logging.WARNING), logging.getLogger("mipsjax")
    logger.addHandler(handler)
    try:
        yield texts
    finally:
        logger.removeHandler(handler)
