"""The process of a page beside a run, as `viewer/live.py` starts it: `python -m mipsjax.viewer.process PORT`."""

from __future__ import annotations

import json
import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

Say = Callable[..., None]


def main(arguments: list[str]) -> int:
    """Serves until the run closes our standard input."""
    with suppress(AttributeError, OSError):  # not on Windows
        os.nice(10)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    # Whatever others print is no answer
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    one_at_a_time = threading.Lock()

    def say(**what: Any) -> None:
        # The run may have ended
        with one_at_a_time, suppress(OSError):
            answers.write(json.dumps(what) + "\n")
            answers.flush()

    try:
        _serve(int(arguments[0]), say)
    except Exception as error:  # the run says it, which has a terminal
        say(problem=f"{type(error).__name__}: {error}")
        os._exit(1)
    # Without waiting for a surface that is under way
    os._exit(0)


def _serve(port: int, say: Say) -> None:
    # What is missing or does not fit is said as any other problem
    from mipsjax.viewer.live import MeshRequest, received
    from mipsjax.viewer.stage import Stage

    stage = Stage(port, on_pause=lambda paused: say(paused=paused))
    say(url=stage.url)
    for message in received(sys.stdin.buffer):
        if isinstance(message, MeshRequest):
            # Beside the pictures, which go on meanwhile
            threading.Thread(target=_draw, args=(stage, message, say), daemon=True).start()
        else:
            stage.show(message)


def _draw(stage: Any, request: Any, say: Say) -> None:
    from mipsjax.viewer.shown import shown_mesh

    try:
        stage.show_mesh(shown_mesh(*request))
    except Exception as error:  # the next one may be better
        say(problem=f"no surface: {type(error).__name__}: {error}")
    finally:
        say(mesh=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
