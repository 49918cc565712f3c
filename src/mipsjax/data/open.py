"""Opening a sequence by looking at it: layout, frames, and whether its numbers make sense."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from collections.abc import Sequence as Numbers
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mipsjax.config.sections import InputConfig
from mipsjax.data import bag, fastcamo, folder, replica, scannet, sevenscenes, tum
from mipsjax.data.calibration import DEPTH_UNITS, DepthScale, Options, declared_intrinsics
from mipsjax.data.imagesequence import ImageSequence
from mipsjax.data.sequence import Sequence
from mipsjax.data.suspicion import suspicions_of_depth, suspicions_of_times
from mipsjax.data.trajectory import known_poses
from mipsjax.errors import ConfigError, InputError

SYNTH_PREFIX = "synth:"

DEPTH_POSSIBLE_M = (0.05, 50.0)
"""No RGB-D camera gives a median outside: the depth scale must be wrong."""

DEPTH_USUAL_M = (0.65, 6.0)
"""A median outside is worth a remark. So narrow that a room's falls outside where the scale is wrong by
a factor of five."""

USABLE_FRACTION = 0.01
"""A frame with fewer measurements than this says nothing about the depth scale."""

_LOOKED_AT = 100
"""Frames read at the start, and again over the whole sequence, in search of a usable one."""

_NAMES_SHOWN = 10
_MIN_FRAMES = 2
_COMMON_SCALES = (1000.0, 5000.0, 6553.5, 4000.0, 10000.0, 1.0)


class Layout(NamedTuple):
    """One supported layout."""

    markers: str
    """What it is recognised by, for the user."""
    matches: Callable[[Path], bool]
    read: Callable[[Path, Options], ImageSequence]


LAYOUTS = {
    module.LAYOUT: Layout(module.MARKERS, module.matches, module.read)
    for module in (folder, tum, replica, scannet, sevenscenes, fastcamo, bag)
}


def open_sequence(
    path: str | Path,
    *,
    layout: str | None = None,
    intrinsics: Numbers[float | int] | None = None,
    depth_scale: float | None = None,
    frames: slice = slice(None),
    input: InputConfig = InputConfig(),  # noqa: B008 (frozen)
    depth_topic: str | None = None,
    color_topic: str | None = None,
) -> Sequence:
    """Opens a folder, a `.seq` file, a bag or `synth:NAME`; no image is kept, nothing is written.

    Args:
        path: what to open.
        layout: name of a layout of `LAYOUTS`; found by looking where None.
        intrinsics: fx, fy, cx, cy in pixels of the depth image, or followed by width and height.
        depth_scale: depth units per metre.
        frames: which frames, by their number.
        input: range of depth, working width.
        depth_topic: of a bag with several; likewise `color_topic`.

    Raises:
        InputError: the sequence is unusable; the message says what to do.
        ConfigError: an option makes no sense.
    """
    if str(path).startswith(SYNTH_PREFIX):
        from mipsjax.data.synth import open_synth

        synthetic = open_synth(str(path).removeprefix(SYNTH_PREFIX), frames, input)
        given = {
            "--layout": layout,
            "--intrinsics": intrinsics,
            "--depth-scale": depth_scale,
            "--depth-topic": depth_topic,
            "--color-topic": color_topic,
        }
        unused = [name for name, value in given.items() if value is not None]
        if unused:
            synthetic.notes += (f"{' and '.join(unused)} left out: {path} has its own",)
        return synthetic
    low, high = DEPTH_UNITS
    if depth_scale is not None and not low <= depth_scale <= high:
        raise ConfigError(
            f"--depth-scale must be a positive number of units per metre, from {low:g} to {high:g}, got "
            f"{depth_scale:g}"
        )
    options = Options(
        intrinsics=None if intrinsics is None else declared_intrinsics(intrinsics),
        depth_scale=None if depth_scale is None else DepthScale(depth_scale, "--depth-scale"),
        input=input,
        depth_topic=depth_topic,
        color_topic=color_topic,
    )
    place = _require_path(Path(path))
    try:
        name = layout or detect_layout(place)
        if name not in LAYOUTS:
            raise ConfigError(f"--layout {name}: unknown, choose one of {', '.join(LAYOUTS)}")
        sequence = _select(LAYOUTS[name].read(place, options), frames)
    except OSError as error:
        hint = "; make it readable, as by chmod -R u+rX" if isinstance(error, PermissionError) else ""
        what, why = error.filename or place, error.strerror or error
        raise InputError(f"{what}: cannot be read ({why}){hint}") from error
    notes = check_depth_scale(sequence) + suspicions(sequence)
    given = {"--depth-topic": depth_topic, "--color-topic": color_topic}
    if name != bag.LAYOUT and (unused := [option for option, topic in given.items() if topic]):
        notes += (f"{' and '.join(unused)} left out: {place} is no bag",)
    return sequence.with_notes(notes)


def detect_layout(path: Path) -> str:
    """Name of the only layout that a path looks like. Raises InputError if none or several do."""
    found = [name for name, layout in LAYOUTS.items() if layout.matches(path)]
    if not found:
        raise InputError(_unknown_message(path))
    if len(found) > 1:
        raise InputError(f"{path}: looks like {' and '.join(found)}; choose with --layout")
    return found[0]


def parse_frames(text: str) -> slice:
    """`START:STOP:STEP`, each part optional, counted from 0 without STOP. Raises ConfigError."""
    pattern = re.fullmatch(r"([0-9]{0,9}):([0-9]{0,9})(?::([0-9]{0,9}))?", text.strip(), re.ASCII)
    if pattern is None:
        raise ConfigError(
            f"--frames {text!r}: START:STOP:STEP with whole numbers expected, such as 100:500:2"
        )
    start, stop, step = (int(part) if part else None for part in pattern.groups())
    if step == 0:
        raise ConfigError(f"--frames {text!r}: the step must be at least 1")
    if start is not None and stop is not None and stop <= start:
        raise ConfigError(f"--frames {text!r}: no frames between start and stop")
    return slice(start, stop, step)


def check_depth_scale(sequence: ImageSequence) -> tuple[str, ...]:
    """Remarks on the median depth of the first usable frame. Raises InputError if no scene has such depth."""
    position, median = typical_depth(sequence)
    low, high = DEPTH_POSSIBLE_M
    number = int(sequence.numbers[position])
    found = f"median depth of frame {number} is {median:.3g} m at {sequence.depth_scale}"
    if not low <= median <= high:
        raise InputError(
            f"{found}: pass --depth-scale{_suggestion(median * sequence.depth_scale.units_per_metre)}"
        )
    if not DEPTH_USUAL_M[0] <= median <= DEPTH_USUAL_M[1]:
        return (f"{found}: is --depth-scale right?",)
    return ()


def suspicions(sequence: ImageSequence) -> tuple[str, ...]:
    """Remarks on a recording that may not be what it is taken for; each names what would mend it."""
    position, _ = typical_depth(sequence)
    depth = sequence.unclipped_depth(position)
    assert depth is not None, "a frame of typical depth has one"
    units = sequence.depth_scale.units_per_metre
    found = suspicions_of_depth(depth, units, sequence.input.depth_max, int(sequence.numbers[position]))
    if sequence.layout not in (tum.LAYOUT, bag.LAYOUT):  # others number their frames: their times are ours
        return found
    return found + suspicions_of_times(sequence.timestamps, sequence.numbers)


def typical_depth(sequence: ImageSequence) -> tuple[int, float]:
    """Position and median depth in metres of the first usable frame, without the range of the config.

    Raises InputError if none is found among the first frames and a sample of the others.
    """
    start = range(min(_LOOKED_AT, len(sequence)))
    sample = np.linspace(0, len(sequence) - 1, min(_LOOKED_AT, len(sequence))).astype(int)
    looked_at = [*start, *(int(position) for position in sample if position not in start)]
    for position in looked_at:
        depth = sequence.unclipped_depth(position)
        if depth is None:
            continue
        measured = depth[depth > 0]
        if measured.size >= max(1, USABLE_FRACTION * depth.size):
            return position, float(np.median(measured))
    raise InputError(f"{sequence.name}: no usable depth image among the {len(looked_at)} looked at")


def describe(sequence: Sequence) -> str:
    """A few lines about a sequence, for `--inspect`."""
    duration = sequence.timestamps[-1] - sequence.timestamps[0]
    step_ms = 1000 * float(np.median(np.diff(sequence.timestamps)))
    k = sequence.intrinsics
    lines = [
        f"layout        {sequence.layout} ({sequence.name})",
        f"frames        {len(sequence)} in {duration:.1f} s, {step_ms:.1f} ms apart",
        f"size          {k.width} x {k.height}{_decimation(sequence)}",
        f"intrinsics    fx {k.fx:.2f}, fy {k.fy:.2f}, cx {k.cx:.2f}, cy {k.cy:.2f}{_origin(sequence)}",
        f"depth         {_depth_text(sequence)}",
        f"ground truth  {_truth_text(sequence)}",
    ]
    return "\n".join(lines + [f"note          {note}" for note in sequence.notes])


def _require_path(path: Path) -> Path:
    """The absolute path. Raises InputError unless it is a readable folder, a `.seq` file or a bag."""
    try:
        if not path.exists():
            existing = next(parent for parent in path.absolute().parents if parent.exists())
            raise InputError(f"{path}: does not exist; the nearest folder that does is {existing}")
        if path.is_dir():
            # A folder that may not be read fails here, and not within a reader
            next(path.iterdir(), None)
        elif not (fastcamo.matches(path) or bag.matches(path)):
            raise InputError(f"{path}: is a file, a folder is expected")
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror or error})") from error
    # Links are not followed: the name of one may say which camera it was
    return Path(os.path.abspath(path))


def _select(sequence: ImageSequence, frames: slice) -> ImageSequence:
    selected = sequence.select(frames)
    if len(selected) < _MIN_FRAMES:
        raise InputError(
            f"{sequence.name}: {len(selected)} of {len(sequence)} frames selected, "
            f"at least {_MIN_FRAMES} are needed"
        )
    return selected


def _unknown_message(path: Path) -> str:
    looked_for = "; ".join(f"{name} ({layout.markers})" for name, layout in LAYOUTS.items())
    names = sorted(entry.name for entry in path.iterdir())
    seen = ", ".join(names[:_NAMES_SHOWN]) + (", ..." if len(names) > _NAMES_SHOWN else "")
    folders = (path / name for name in names[:_NAMES_SHOWN] if (path / name).is_dir())
    inside = [str(place) for place in folders if any(layout.matches(place) for layout in LAYOUTS.values())]
    hint = f"; did you mean {inside[0]}?" if inside else ""
    return f"{path}: no known layout; looked for {looked_for}; it contains: {seen or 'nothing'}{hint}"


def _suggestion(median_units: float) -> str:
    """A usual scale that would give a usual depth."""
    low, high = DEPTH_USUAL_M
    for scale in _COMMON_SCALES:
        if low <= median_units / scale <= high:
            return f" (units per metre); {scale:g} would make it {median_units / scale:.2g} m"
    return " (units per metre)"


def _decimation(sequence: Sequence) -> str:
    if not isinstance(sequence, ImageSequence) or sequence.shape.every_px == 1:
        return ""
    width, height = sequence.shape.depth_size
    return f", every {sequence.shape.every_px} pixels of {width} x {height}"


def _origin(sequence: Sequence) -> str:
    return f" (from {sequence.calibration.source})" if isinstance(sequence, ImageSequence) else ""


def _depth_text(sequence: Sequence) -> str:
    if not isinstance(sequence, ImageSequence):
        return "metres"
    position, median = typical_depth(sequence)
    number = int(sequence.numbers[position])
    return f"{sequence.depth_scale}, median {median:.2f} m in frame {number}"


def _truth_text(sequence: Sequence) -> str:
    if sequence.T_world_cam is None:
        return "none"
    known = int(known_poses(sequence.T_world_cam).sum())
    return f"poses of {known} of {len(sequence)} frames"
