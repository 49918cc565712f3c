"""Signals before, during and around a run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import mipsjax
from mipsjax.app import signals

ASLEEP = "import sys, time; from mipsjax.app.signals import end_at_once; end_at_once(); "
LISTENING = "print('ready', flush=True); "
# Naps are short: a signal between two lines of Python is heeded only when the nap that follows it is over
SWALLOWING = """
while True:
    try:
        time.sleep(0.1)
    except BaseException:
        pass
"""


@pytest.mark.parametrize("number", signals.ENDING)
@pytest.mark.fault(40, 41)
def test_a_signal_while_the_program_is_loaded_ends_it_with_one_line(number: signal.Signals) -> None:
    environment = os.environ | {"PYTHONPATH": str(Path(mipsjax.__file__).parents[1])}
    script = ASLEEP + LISTENING + SWALLOWING
    process = subprocess.Popen(
        [sys.executable, "-c", script], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None
    process.stdout.readline()
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    assert (process.returncode, stderr) == (signals.INTERRUPTED, b"interrupted\n")


def test_a_run_outlives_its_terminal_where_the_caller_wants_it() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.noted() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop() and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_raising_ends_what_is_inside() -> None:
    before = [signal.getsignal(number) for number in signals.ENDING]
    with pytest.raises(KeyboardInterrupt), signals.raising():
        signal.raise_signal(signal.SIGTERM)
    assert [signal.getsignal(number) for number in signals.ENDING] == before
