"""`python -m mipsjax.run SEQUENCE`: from an RGB-D sequence to a trajectory and a mesh."""

from __future__ import annotations

import sys

from mipsjax.app.signals import end_at_once


def main() -> int:
    """The program; returns its exit code."""
    end_at_once()
    # Only now, since it takes seconds, in which a signal must end the program as at any other time
    from mipsjax.app.run import main as program

    return program()


if __name__ == "__main__":
    sys.exit(main())
