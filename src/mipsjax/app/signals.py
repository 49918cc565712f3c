"""Signals that end a run: Ctrl-C, and what the system sends to end a process or where a terminal is closed.

Imports nothing but the standard library, so that the doors of the programs can use it before they load the rest.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""
ENDING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)  # Windows has no SIGHUP
"""Signals that end a program."""

_Handler = Callable[[int, FrameType | None], None]


def end_at_once() -> None:
    """From now on such a signal ends the process with one line. For the time before there is anything to save.

    An exception would not do: whatever is being imported may swallow it, or print it.
    """
    for number in _heeded():
        signal.signal(number, _exit)


@contextmanager
def noted() -> Iterator[Callable[[], bool]]:
    """Whether such a signal has come. The next one then ends the process at once."""
    came: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        came.append(number)
        for other in _heeded():
            signal.signal(other, signal.SIG_DFL)

    with _handled(note):
        yield lambda: bool(came)


@contextmanager
def raising() -> Iterator[None]:
    """Such a signal is a KeyboardInterrupt. For work of which nothing is to be kept."""

    def interrupt(number: int, _: FrameType | None) -> None:
        raise KeyboardInterrupt

    with _handled(interrupt):
        yield


@contextmanager
def _handled(handler: _Handler) -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in _heeded()}
    try:
        for number in before:
            signal.signal(number, handler)
    except ValueError:  # not the main thread, where whoever runs it handles signals
        before = {}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _heeded() -> list[signal.Signals]:
    """All of them, but a closed terminal that the caller wants to outlive, as with `nohup`."""
    ignored = hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in ENDING if not (ignored and number == signal.SIGHUP)]


def _exit(number: int, _: FrameType | None) -> None:
    with suppress(OSError):  # where nobody listens
        os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)
