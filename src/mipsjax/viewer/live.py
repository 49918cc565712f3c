"""A page beside a run, in a process of its own. The run waits for it in nothing but a pause that a user asks for.

The run sends what is to be shown down the standard input of that process (`viewer/process.py`), which answers with a
line of JSON on its standard output for each thing it has to say. What cannot be sent soon enough is left out for what
is newer.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.config.sections import Config
from mipsjax.data.sequence import Frame
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.ids import RecordId
from mipsjax.submaps.state import SlamState
from mipsjax.viewer import PORT
from mipsjax.viewer.shown import Shown, bare, shown

log = logging.getLogger(__name__)

PACKAGE = "viser"
HOW_TO_GET_IT = "pip install 'mipsjax[viewer]'"
LEAST_S = 0.2
"""Seconds from one picture to the next."""
SHARE = 0.04
"""Largest share of the time that making and sending pictures takes."""
MESH_EVERY = 5
"""New keyframes after which the surface is made again."""
MESH_VOXEL_M = 0.06
"""Least edge of the cells of a surface that is made beside a run."""
END_S = 5.0
"""Seconds that the process, or a thread, has to end by itself."""
POLL_S = 0.1
# One thread, and whatever the run leaves of the processor; no share of the memory of a GPU
_LIGHT = {
    "JAX_PLATFORMS": "cpu",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "OMP_NUM_THREADS": "1",
}


class MeshRequest(NamedTuple):
    """A surface that the process is to make."""

    state: SlamState
    """Of what `bare` leaves."""
    cfg: Config
    voxel_m: float


Message = Shown | MeshRequest


class Viewer:
    """What a run tells of itself, and asks whether it is paused."""

    def __init__(
        self,
        process: subprocess.Popen[bytes],
        cfg: Config,
        tell: Callable[[str], None],
        T_truth_cam: Float64[np.ndarray, "N 4 4"] | None = None,
    ) -> None:
        """Of a process that was started. `tell` is told what a user should know; true poses are shown beside those that
        are found."""
        self._process, self._cfg, self._tell, self._truth = process, cfg, tell, T_truth_cam
        self._changed = threading.Condition()
        # All under this condition
        self._latest: tuple[SlamState, FrameInfo, Frame] | None = None
        self._paused, self._ended, self._mesh_due = False, False, True
        self._known: set[RecordId] = set()
        self._keyframes = 0
        self._sender = threading.Thread(target=self._send_all, daemon=True)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._sender.start()
        self._listener.start()

    def after(self, state: SlamState, info: FrameInfo, frame: Frame) -> None:
        """A frame was processed."""
        with self._changed:
            self._latest = state, info, frame
            self._changed.notify_all()

    def wait(self, stop: Callable[[], bool]) -> bool:
        """Waits while it is paused; then, or as soon as `stop` says so, what that says."""
        with self._changed:
            while self._paused and not stop():
                # A signal is no change of ours
                self._changed.wait(POLL_S)
        return stop()

    def close(self) -> None:
        """Ends the process, which may no longer listen."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        # It may be in the middle of a message that nobody reads: only an end of the process ends that
        self._sender.join(END_S)
        if self._sender.is_alive():
            self._process.kill()
            self._sender.join(END_S)
        assert self._process.stdin is not None and self._process.stdout is not None
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._listener.join(END_S)
        self._process.stdout.close()

    def _send_all(self) -> None:
        """Sends the latest, again and again, until the end."""
        try:
            while (latest := self._next()) is not None:
                began = perf_counter()
                self._show(*latest)
                self._rest(perf_counter() - began)
        except (OSError, ValueError):  # nobody reads any more, as the other thread will say
            return
        except Exception as error:  # a page is not worth a run
            log.warning("nothing more is shown: %s: %s", type(error).__name__, error)

    def _next(self) -> tuple[SlamState, FrameInfo, Frame] | None:
        """What came last, as soon as there is something new; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._latest is not None)
            latest, self._latest = self._latest, None
            return None if self._ended else latest

    def _rest(self, spent_s: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._ended, max(LEAST_S, spent_s / SHARE))

    def _show(self, state: SlamState, info: FrameInfo, frame: Frame) -> None:
        """Sends a picture, and now and then what a surface is made of."""
        picture = shown(state, info, frame, self._known)
        send(self._process.stdin, picture._replace(T_truth_cam=self._truth))
        self._truth = None
        self._known |= set(picture.images)
        with self._changed:
            due = self._mesh_due and len(self._known) >= self._keyframes + MESH_EVERY
            self._mesh_due &= not due
        if due:
            self._keyframes = len(self._known)
            voxel_m = max(self._cfg.mesh.voxel, MESH_VOXEL_M)
            send(self._process.stdin, MeshRequest(bare(state), self._cfg, voxel_m))

    def _listen(self) -> None:
        """Hears what the process says, until it ends."""
        assert self._process.stdout is not None
        try:
            for line in self._process.stdout:
                try:
                    said = json.loads(line)
                except ValueError:  # it was killed in the middle of a line
                    continue
                self._heed(said)
        finally:
            with self._changed:
                self._paused = False
                self._changed.notify_all()
        if not self._ended:
            log.warning("the viewer has ended; the run goes on without it")

    def _heed(self, said: dict[str, Any]) -> None:
        if "url" in said:
            self._tell(f"viewer at {said['url']}")
        if "problem" in said:
            log.warning("viewer: %s", said["problem"])
        if "paused" in said:
            self._tell("paused in the viewer" if said["paused"] else "goes on")
        with self._changed:
            self._paused = bool(said.get("paused", self._paused))
            self._mesh_due |= bool(said.get("mesh"))
            self._changed.notify_all()


def send(stream: Any, message: Message) -> None:
    """Writes one message, its length before it."""
    data = pickle.dumps(message, pickle.HIGHEST_PROTOCOL)
    stream.write(len(data).to_bytes(8, "little"))
    stream.write(data)
    stream.flush()


def received(stream: Any) -> Iterator[Message]:
    """The messages of a stream, until it ends."""
    while len(head := stream.read(8)) == 8:
        length = int.from_bytes(head, "little")
        data = stream.read(length)
        if len(data) < length:
            return
        yield pickle.loads(data)


def is_installed() -> bool:
    """Whether the package is there that a page takes."""
    return importlib.util.find_spec(PACKAGE) is not None


@contextmanager
def viewer(
    cfg: Config,
    tell: Callable[[str], None],
    port: int = PORT,
    T_truth_cam: Float64[np.ndarray, "N 4 4"] | None = None,
) -> Iterator[Viewer | None]:
    """A page beside a run, None where there cannot be one: the run does without. `tell` is told where it is."""
    if not is_installed():
        log.warning("--viewer takes another package: %s; the run goes on without it", HOW_TO_GET_IT)
        yield None
        return
    try:
        process = subprocess.Popen(
            [sys.executable, "-m", "mipsjax.viewer.process", str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | _LIGHT,
            # Ctrl-C is for the run, which ends this one
            start_new_session=True,
        )
    except OSError as error:
        log.warning("no viewer (%s); the run goes on without it", error.strerror or error)
        yield None
        return
    page = Viewer(process, cfg, tell, T_truth_cam)
    try:
        yield page
    finally:
        page.close()
