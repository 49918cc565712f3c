"""How far a run is: a bar on a terminal, otherwise a line now and then."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from tqdm import tqdm

from mipsjax.app.commandline import say
from mipsjax.submaps.state import Status

LINE_EVERY = 50
"""Frames between two lines of progress where there is no terminal."""


def teller(quiet: bool) -> Callable[[str], None]:
    """What prints a line, or nothing."""
    return (lambda text: None) if quiet else say


@contextmanager
def progress(count: int, before: int, quiet: bool) -> Iterator[Callable[[Status], None]]:
    """A function that is told of each frame after those before."""
    if not quiet and sys.stderr.isatty():
        bar = tqdm(total=count, initial=before, unit="frame", file=sys.stderr)
        try:
            yield lambda status: _advance(bar, status)
        finally:
            with suppress(OSError):
                bar.close()
        return
    done, tell_line = [before], teller(quiet)

    def tell(status: Status) -> None:
        done[0] += 1
        if done[0] % LINE_EVERY == 0 or done[0] == count:
            tell_line(f"frame {done[0]} of {count}: {status}")

    yield tell


def _advance(bar: tqdm, status: Status) -> None:
    with suppress(OSError):  # where the terminal is closed
        bar.set_postfix_str(str(status), refresh=False)
        bar.update()
