"""What a run needs to go on where it was, written beside the frames; `app/resume.py` reads it again.

A state is a value that nothing changes, so a thread can write it while the next frames are tracked. Each checkpoint is
a file of its own that is there whole or not at all, and the one before it stays.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from mipsjax.app.summary import FrameRow
from mipsjax.config.options import to_dict
from mipsjax.config.sections import CheckpointConfig, Config
from mipsjax.data.imagesequence import ImageSequence
from mipsjax.data.sequence import Sequence
from mipsjax.errors import OutputError
from mipsjax.files import UNFINISHED, write_atomically
from mipsjax.slam.info import FrameInfo
from mipsjax.submaps.saved import about, packed, unpacked
from mipsjax.submaps.state import SlamState

log = logging.getLogger(__name__)

FOLDER = "checkpoint"
"""In the folder of a run."""
CONTENT = "checkpoint"
HALF = re.compile(rf"\.[0-9]+\.npz\.[a-z0-9_]+{re.escape(UNFINISHED)}")
"""Name of one that is being written."""
PACKAGES = "jax", "jaxlib", "numpy", "optimistix", "lineax", "equinox"
"""Another version of one may round otherwise."""
KEPT = 2
"""Checkpoints, the last ones: where one turns out damaged, the one before it serves."""


class Progress(NamedTuple):
    """A run after some of its frames; of none at first."""

    state: SlamState | None = None
    waited: tuple[FrameRow, ...] = ()
    """Frames before the first usable one."""
    infos: tuple[FrameInfo, ...] = ()
    """Of the frames of this recording in the state's records."""
    read_s: tuple[float, ...] = ()
    step_s: tuple[float, ...] = ()
    bad: int = 0
    """Unusable frames."""
    remarks: tuple[str, ...] = ()
    """Warnings that came up."""


class Checkpoints:
    """Writes a checkpoint of a run now and then. The run waits for none but the last."""

    def __init__(
        self, folder: Path, identity: dict[str, Any], cfg: CheckpointConfig, remarks: list[str]
    ) -> None:
        """Into `folder`, that of the run, of which `identity` says what it is. Whoever hears of warnings adds them to
        `remarks`."""
        self._folder, self._identity, self._cfg = folder / FOLDER, identity, cfg
        self._remarks = remarks
        # A single thread writes them in their order, the last one last
        self._pool = ThreadPoolExecutor(1, "checkpoint")
        self._writing: Future[None] | None = None
        self._keyframes, self._began = 0, perf_counter()

    def after(self, keyframe: bool, progress: Callable[[], Progress]) -> float:
        """Begins to write one, if it is time for it; milliseconds that the run has waited for that.

        The last frame's info in the checkpoint has them, too. Where the disk is slower than the frames, the next one
        begins when the last is written.
        """
        began = perf_counter()
        self._keyframes += keyframe
        if not (self._due(began) and self._idle()):
            return 1e3 * (perf_counter() - began)
        self._keyframes, self._began = 0, began
        # Known only when the thread has what it is to write
        waited: Future[float] = Future()
        self._writing = self._pool.submit(self._write_waited, self._remarked(progress()), waited)
        waited_ms = 1e3 * (perf_counter() - began)
        waited.set_result(waited_ms)
        return waited_ms

    def last(self, progress: Progress) -> None:
        """Writes one, unless none are wanted, and waits until it is there."""
        if self._cfg.every_keyframes or self._cfg.every_seconds:
            self._pool.submit(self._write, self._remarked(progress)).result()

    def close(self) -> None:
        """Waits until what has begun is written."""
        self._pool.shutdown()

    def _remarked(self, progress: Progress) -> Progress:
        # A copy: the list may grow while the thread writes
        return progress._replace(remarks=tuple(self._remarks))

    def _due(self, now: float) -> bool:
        cfg = self._cfg
        by_keyframes = 0 < cfg.every_keyframes <= self._keyframes
        return by_keyframes or 0 < cfg.every_seconds <= now - self._began

    def _idle(self) -> bool:
        return self._writing is None or self._writing.done()

    def _write_waited(self, progress: Progress, waited: Future[float]) -> None:
        """Writes one in which the last frame's info says how many milliseconds the run waited for it."""
        info = progress.infos[-1]._replace(checkpoint_ms=waited.result())
        self._write(progress._replace(infos=(*progress.infos[:-1], info)))

    def _write(self, progress: Progress) -> None:
        """One that cannot be written ends no run."""
        frames = len(progress.read_s)
        try:
            self._make_folder()
            data = packed(_plain(progress), CONTENT, {**self._identity, "frames": frames})
            write_atomically(self._folder / f"{frames:06d}.npz", data)
            # Only now that the new one is there whole
            for path in written(self._folder.parent)[KEPT:]:
                path.unlink(missing_ok=True)
        except Exception as error:  # whatever it is: the run is worth more than its checkpoint
            log.warning("no checkpoint after %d frames: %s", frames, error)

    def _make_folder(self) -> None:
        try:
            self._folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make {self._folder}: {error.strerror or error}") from error


@contextmanager
def checkpoints(
    folder: Path, identity: dict[str, Any], cfg: CheckpointConfig, remarks: list[str]
) -> Iterator[Checkpoints]:
    """Of a run in a folder. What was begun is written at the end, however that comes."""
    kept = Checkpoints(folder, identity, cfg, remarks)
    try:
        yield kept
    finally:
        kept.close()


def written(folder: Path) -> list[Path]:
    """The checkpoints in the folder of a run, the last first; none of a folder that is not there or cannot be read."""
    try:
        found = [path for path in (folder / FOLDER).glob("*.npz") if path.stem.isdecimal()]
    except OSError:  # as where its name is too long: whoever makes the folder will say so
        return []
    return sorted(found, key=lambda path: int(path.stem), reverse=True)


def read(path: Path) -> Progress:
    """A checkpoint. Raises InputError where it is not whole."""
    content = unpacked(path, CONTENT).value
    return Progress(
        state=content["state"],
        waited=tuple(
            FrameRow(number, timestamp, status, FrameInfo(*info))
            for number, timestamp, status, info in content["waited"]
        ),
        infos=tuple(FrameInfo(*info) for info in content["infos"]),
        read_s=content["read_s"],
        step_s=content["step_s"],
        bad=content["bad"],
        remarks=content["remarks"],
    )


def identity_in(path: Path) -> dict[str, Any]:
    """What a checkpoint says that it is of. Raises InputError where it cannot be read."""
    return about(path, CONTENT)


def remove(folder: Path) -> None:
    """Removes the checkpoints of a run, which has all its results, and nothing else that lies beside them."""
    tidy(folder)
    with suppress(OSError):
        for path in written(folder):
            path.unlink(missing_ok=True)
        # Fails, and is to, where anything else lies in it
        (folder / FOLDER).rmdir()


def tidy(folder: Path) -> None:
    """Removes the halves of checkpoints that a process left which was killed while it wrote them."""
    with suppress(OSError):
        for path in (folder / FOLDER).iterdir():
            if HALF.fullmatch(path.name) and path.is_file():
                path.unlink(missing_ok=True)


def identity(cfg: Config, sequence: Sequence) -> dict[str, Any]:
    """What a run is of: where this differs, it cannot go on to what it would have become."""
    return {
        "mipsjax": version("mipsjax"),
        "packages": {name: version(name) for name in PACKAGES},
        "code": _code(),
        "config": _digest(json.dumps(to_dict(cfg), sort_keys=True).encode()),
        "sequence": fingerprint(sequence),
    }


def fingerprint(sequence: Sequence) -> dict[str, Any]:
    """What tells a sequence from others without reading it: its numbers, and its first and last files."""
    poses = np.zeros(0) if sequence.T_world_cam is None else sequence.T_world_cam
    ends = (0, len(sequence) - 1)
    files, images = (lambda _: ()), {}
    if isinstance(sequence, ImageSequence):
        files = sequence.files
        names = [[path.name for path in files(position)] for position in range(len(sequence))]
        images = {
            "names of files": _digest(json.dumps(names).encode()),
            "depth scale": float(sequence.depth_scale.units_per_metre),
            "camera": _digest(repr(sequence.calibration).encode()),
            "sizes": [*sequence.shape.color_size, *sequence.shape.depth_size, sequence.shape.every_px],
        }
    return {
        "name": sequence.name,
        "layout": sequence.layout,
        "frames": len(sequence),
        "intrinsics": [float(value) for value in sequence.intrinsics],
        "timestamps": _digest(np.ascontiguousarray(sequence.timestamps).tobytes()),
        "true poses": _digest(np.ascontiguousarray(poses).tobytes()),
        "files": [_file(path) for position in ends for path in files(position)],
        **images,
    }


def _file(path: Path) -> list[Any]:
    """Its name, size and time; only the name of one that cannot be read, which is a bad frame."""
    try:
        found = path.stat()
    except (OSError, ValueError):  # the name may hold a NUL
        return [path.name]
    return [path.name, found.st_size, found.st_mtime_ns]


def _code() -> str:
    """A digest of the package's source: a checkout goes on changing while its version stays."""
    root = Path(__file__).parents[1]
    # In one order: that of a folder is up to the file system
    parts = [
        f"{path.relative_to(root)}\n".encode() + path.read_bytes() for path in sorted(root.rglob("*.py"))
    ]
    return _digest(b"".join(parts))


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _plain(progress: Progress) -> dict[str, Any]:
    """As what a file may hold."""
    plain = progress._asdict()
    plain["waited"] = tuple(
        (row.frame, row.timestamp, row.status, tuple(row.info)) for row in progress.waited
    )
    plain["infos"] = tuple(tuple(info) for info in progress.infos)
    return plain
