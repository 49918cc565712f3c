"""Work beside the frames: begun after one frame, taken over after a later one, inline or in a thread.

What a job gives follows from the job alone, and the frames at which it begins and is taken over do not depend on how
long it takes. Both executors therefore give the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple, Protocol

Kind = Literal["inline", "thread"]


class Job(NamedTuple):
    """A pure function and what it is called with."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]

    def run(self) -> Any:
        return self.function(*self.arguments)


class Executor(Protocol):
    """Does jobs. One that it was never told to start is done when its result is asked for."""

    def start(self, job: Job) -> None: ...

    def result(self, job: Job) -> Any: ...


class Inline:
    """Does a job when its result is asked for."""

    def start(self, job: Job) -> None:
        """Nothing to do yet."""

    def result(self, job: Job) -> Any:
        return job.run()


class Thread:
    """Does jobs one after the other beside the caller."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self._started: dict[int, tuple[Job, Future[Any]]] = {}

    def start(self, job: Job) -> None:
        self._started[id(job)] = job, self._pool.submit(job.run)  # the job is kept, so that its id is its own

    def result(self, job: Job) -> Any:
        """Waits for it. Raises what the job raised."""
        if id(job) not in self._started:
            return job.run()
        return self._started.pop(id(job))[1].result()


INLINE = Inline()


@contextmanager
def executor(kind: Kind) -> Iterator[Executor]:
    """An executor by name; jobs not begun by its end are dropped."""
    if kind == "inline":
        yield INLINE
        return
    pool = ThreadPoolExecutor(1, "mipsjax")
    try:
        yield Thread(pool)
    finally:
        pool.shutdown(cancel_futures=True)
