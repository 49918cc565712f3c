"""Sequences without a download: analytic rooms, camera paths, a sensor model."""

from __future__ import annotations

from mipsjax.config.sections import InputConfig
from mipsjax.data.synth.catalog import HOMES, SPECS, find
from mipsjax.data.synth.sequence import Degradations, SynthSequence
from mipsjax.errors import InputError

__all__ = ["Degradations", "SynthSequence", "open_synth", "synth_names"]


def synth_names() -> dict[str, str]:
    """Every sequence, with a line about it; each also takes `+noise` and `+blur` at the end of its name.

    A name with SEED in it stands for those of all whole numbers there.
    """
    return {name: spec.about for name, spec in SPECS.items()} | HOMES


def open_synth(name: str, frames: slice, input: InputConfig) -> SynthSequence:
    """The synthetic sequence `name` (without `synth:`), such as `room-fast+noise+blur`.

    `frames` selects START:STOP:STEP of its frames. Images wider than the working width are decimated by a
    whole factor, and depth outside the range of `input` is 0. Raises InputError for unknown names and
    for empty selections.
    """
    base, *suffixes = name.split("+")
    spec = find(base)
    # A suffix twice would be a second name of the same sequence
    if spec is None or not set(suffixes) <= set(Degradations._fields) or len(set(suffixes)) < len(suffixes):
        raise InputError(
            f"synth:{name}: no such sequence; choose one of {', '.join(synth_names())} "
            "(SEED: a whole number from 0, as in home-7), with +noise or +blur or both behind it"
        )
    indices = range(spec.frames)[frames]
    if len(indices) == 0 or indices.step < 0:
        raise InputError(
            f"synth:{name}: no frames in {_text(frames)}; it has {spec.frames}, numbered from 0, "
            "in the order of time"
        )
    degradations = Degradations(**dict.fromkeys(suffixes, True))
    every_px = max(1, round(spec.intrinsics.width / input.working_width))
    intrinsics = spec.intrinsics.decimated(every_px)
    return SynthSequence(name, spec, degradations, indices, intrinsics, (input.depth_min, input.depth_max))


def _text(frames: slice) -> str:
    return ":".join("" if part is None else str(part) for part in (frames.start, frames.stop, frames.step))
