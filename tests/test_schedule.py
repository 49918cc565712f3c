"""Jobs inline and in a thread."""

from __future__ import annotations

import threading
import time

import pytest

from mipsjax.schedule import INLINE, Job, executor


def test_inline_does_a_job_when_it_is_asked_for():
    done = []
    job = Job(lambda x: done.append(x) or 2 * x, (3,))
    INLINE.start(job)
    assert not done
    assert INLINE.result(job) == 6 and done == [3]


def test_a_thread_does_jobs_beside_the_caller_and_in_order():
    done = []

    def note(i: int) -> int:
        time.sleep(0.01 * (3 - i))  # a job that did not wait for the one before it would overtake it
        done.append((i, threading.get_ident()))
        return i

    with executor("thread") as beside:
        jobs = [Job(note, (i,)) for i in range(3)]
        for job in jobs:
            beside.start(job)
        assert [beside.result(job) for job in reversed(jobs)] == [2, 1, 0]
    assert [i for i, _ in done] == [0, 1, 2]
    threads = {thread for _, thread in done}
    assert len(threads) == 1 and threading.get_ident() not in threads


def test_a_job_that_was_never_begun_is_done_when_asked_for():
    """A state that was saved and loaded holds such jobs."""
    with executor("thread") as beside:
        assert beside.result(Job(max, (2, 5))) == 5


def test_a_failed_job_raises_where_it_is_taken_over():
    with executor("thread") as beside:
        job = Job(int, ("no number",))
        beside.start(job)
        with pytest.raises(ValueError, match="no number"):
            beside.result(job)


def test_jobs_do_not_outlive_the_executor():
    begun, done = threading.Event(), []

    def slow() -> None:
        begun.set()
        time.sleep(0.2)
        done.append(1)

    with executor("thread") as beside:
        beside.start(Job(slow, ()))
        begun.wait()
        for _ in range(100):
            beside.start(Job(time.sleep, (10,)))
    assert done, "what has begun is finished"
    assert not any(thread.name.startswith("mipsjax") for thread in threading.enumerate())
