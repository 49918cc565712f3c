"""`python -m mipsjax.view DIR`: the results of a run in a browser."""

from __future__ import annotations

import sys

from mipsjax.app.signals import end_at_once


def main() -> int:
    """The program; returns its exit code."""
    end_at_once()
    # Only now, since it takes seconds, in which a signal must end the program as at any other time
    from mipsjax.app.view import main as program

    return program()


if __name__ == "__main__":
    sys.exit(main())
