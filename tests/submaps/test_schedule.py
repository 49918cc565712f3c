"""Work inline and in a thread."""

from __future__ import annotations

import threading
import time

import pytest

from mipsjax.submaps.schedule import INLINE, executor


def test_inline_does_work_when_it_is_asked_for():
    done = []

    def double(values: tuple[int, ...]) -> int:
        done.append(values)
        return 2 * values[0]

    given = (3,)
    INLINE.start(double, given)
    assert not done
    assert INLINE.result(double, given) == 6 and done == [given]


def test_a_thread_works_beside_the_caller_and_in_order():
    done = []

    def note(values: list[int]) -> int:
        time.sleep(0.01 * (3 - values[0]))  # what did not wait for the work before it would overtake it
        done.append((values[0], threading.get_ident()))
        return values[0]

    with executor("thread") as beside:
        all_values = [[i] for i in range(3)]
        for values in all_values:
            beside.start(note, values)
        assert [beside.result(note, values) for values in reversed(all_values)] == [2, 1, 0]
    assert [i for i, _ in done] == [0, 1, 2]
    threads = {thread for _, thread in done}
    assert len(threads) == 1 and threading.get_ident() not in threads


def test_work_that_was_never_begun_is_done_when_asked_for():
    """As where a state was saved and loaded with work under way; the copy is not what was begun."""
    begun = [2, 5]
    with executor("thread") as beside:
        beside.start(max, begun)
        assert beside.result(max, list(begun)) == 5
        assert beside.result(max, begun) == 5


def test_failed_work_raises_where_it_is_taken_over():
    with executor("thread") as beside:
        beside.start(int, "no number")
        with pytest.raises(ValueError, match="no number"):
            beside.result(int, "no number")


def test_work_does_not_outlive_the_executor():
    begun, done = threading.Event(), []

    def slow(seconds: float) -> None:
        begun.set()
        time.sleep(seconds)
        done.append(1)

    with executor("thread") as beside:
        beside.start(slow, 0.2)
        begun.wait()
        for _ in range(100):
            beside.start(time.sleep, 10)
    assert done, "what has begun is finished"
    assert not any(thread.name.startswith("mipsjax") for thread in threading.enumerate())
