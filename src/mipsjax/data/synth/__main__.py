"""`python -m mipsjax.data.synth NAME OUT`: write a synthetic sequence to disk in the TUM layout."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn

from mipsjax.config import InputConfig
from mipsjax.data.open import parse_frames
from mipsjax.data.synth import open_synth, synth_names
from mipsjax.data.synth.export import export_tum
from mipsjax.errors import ConfigError, MipsjaxError


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0, or that of the error, whose one line goes to stderr."""
    try:
        options = _parser().parse_args(arguments)
        sequence = open_synth(options.name, parse_frames(options.frames), InputConfig())
        export_tum(sequence, options.out, None if options.no_mesh else options.voxel)
    except MipsjaxError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"{options.out}: {len(sequence)} frames of synth:{sequence.name}")
    return 0


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
