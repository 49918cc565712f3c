"""`python -m mipsjax.data.synth NAME OUT`: write a synthetic sequence to disk in the TUM layout."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from pathlib import Path
from typing import NoReturn

from mipsjax.config.sections import InputConfig
from mipsjax.data.open import parse_frames
from mipsjax.data.synth import open_synth, synth_names
from mipsjax.data.synth.export import export_tum
from mipsjax.errors import ConfigError, MipsjaxError

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
SMALLEST_VOXEL_M, LARGEST_VOXEL_M = 1e-3, 10.0
"""Of the true mesh: a room takes gigabytes with the one, and is lost between corners of the other."""


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0, or that of the error, whose one line goes to stderr."""
    try:
        options = _parser().parse_args(arguments)
        if not SMALLEST_VOXEL_M <= options.voxel <= LARGEST_VOXEL_M:
            raise ConfigError(
                f"--voxel must be from {SMALLEST_VOXEL_M:g} to {LARGEST_VOXEL_M:g} m, got {options.voxel:g}"
            )
        sequence = open_synth(options.name, parse_frames(options.frames), InputConfig())
        export_tum(sequence, options.out, None if options.no_mesh else options.voxel)
        _say(f"{options.out}: {len(sequence)} frames of synth:{sequence.name}")
    except MipsjaxError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("interrupted: the folder is not whole", file=sys.stderr)
        return INTERRUPTED
    return 0


def _say(text: str) -> None:
    """Prints where that is possible; the folder is written by then."""
    try:
        print(text, flush=True)
    except OSError:
        # What the stream still holds must fail at no exit
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Parser(argparse.ArgumentParser):
    """Wrong options are an error of one line."""

    def error(self, message: str) -> NoReturn:
        raise ConfigError(message)


def _parser() -> argparse.ArgumentParser:
    names = "; ".join(f"{name}: {about}" for name, about in synth_names().items())
    parser = _Parser(prog="python -m mipsjax.data.synth", description=__doc__)
    parser.add_argument(
        "name", help=f"{names}. With +noise or +blur or both behind it, a real camera's errors"
    )
    parser.add_argument("out", type=Path, help="new folder")
    parser.add_argument(
        "--frames", default=":", metavar="START:STOP:STEP", help="which frames (default: all)"
    )
    parser.add_argument(
        "--voxel", type=float, default=0.01, metavar="METRES", help="cells of mesh.ply (default: 0.01)"
    )
    parser.add_argument("--no-mesh", action="store_true", help="write no mesh.ply")
    return parser


if __name__ == "__main__":
    sys.exit(main())
