"""Work beside the frames: begun after one frame, taken over after a later one, inline or in a thread.

What work gives follows from the values that it is given alone, and the frames at which it begins and is taken over do
not depend on how long it takes. Both executors therefore give the same bits, and so does work that is begun anew, as
where a state with work under way was saved and loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Literal, Protocol, TypeVar

Kind = Literal["inline", "thread"]
Given = TypeVar("Given")
Result = TypeVar("Result")


class Executor(Protocol):
    """Calls pure functions with values. What it was never told to start is done when its result is asked for."""

    def start(self, function: Callable[[Given], Any], given: Given) -> None: ...

    def result(self, function: Callable[[Given], Result], given: Given) -> Result: ...


class Inline:
    """Does work when its result is asked for."""

    def start(self, function: Callable[[Given], Any], given: Given) -> None:
        """Nothing to do yet."""

    def result(self, function: Callable[[Given], Result], given: Given) -> Result:
        return function(given)


class Thread:
    """Does work beside the caller, one piece after the other."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self._started: dict[int, tuple[Any, Future[Any]]] = {}

    def start(self, function: Callable[[Given], Any], given: Given) -> None:
        # By the identity of the values, since two states may have begun different work after the same frame; they are
        # kept, so that their id stays their own
        self._started[id(given)] = given, self._pool.submit(function, given)

    def result(self, function: Callable[[Given], Result], given: Given) -> Result:
        """Waits for it. Raises what the function raised."""
        if id(given) not in self._started:
            return function(given)
        return self._started.pop(id(given))[1].result()


INLINE = Inline()


@contextmanager
def executor(kind: Kind) -> Iterator[Executor]:
    """An executor by name; work not begun by its end is dropped."""
    if kind == "inline":
        yield INLINE
        return
    pool = ThreadPoolExecutor(1, "mipsjax")
    try:
        yield Thread(pool)
    finally:
        pool.shutdown(cancel_futures=True)
