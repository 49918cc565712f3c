"""The folder of a run's results: chosen, guarded, and claimed before the first frame.

A folder that has the results of a run is never written into again, unless that run was cut short and goes on. What
somebody else put there is neither replaced nor removed, and of two runs only one holds a folder at a time, by a lock.
Halves of files that a killed run left are removed.
"""

from __future__ import annotations

import errno
import json
import os
import re
import socket
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mipsjax.app import checkpoint
from mipsjax.errors import OutputError

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

RUNS = Path("runs")
"""Where runs without --out go."""
LOCK = ".lock"
CONFIG = "config.json"
FILES = (
    CONFIG, "trajectory.txt", "trajectory_gt.txt", "status.csv", "events.jsonl", "loops.json", "metrics.json",
    "mesh.ply", "mesh.png",
)  # fmt: skip
"""All that a run writes."""
OF_OURS = {"schema_version", "options", "sequence", "config", "versions"}
"""Keys by which a config.json is known to be one of a run."""
LARGEST_CONFIG_BYTES = 1 << 20
HOLDER = b"process "
"""What a lock of a run begins with."""
HOLDER_BYTES = 100
"""Of a lock that are read."""
MAP = Path("map", "state.npz")
"""The map that a run keeps."""
FINISHED = ("metrics.json", "trajectory.txt", "mesh.ply", MAP)
"""A folder with one of these holds results."""


def choose_folder(name: str, out: Path | None, source: Path | None) -> Path:
    """The folder for a run's results: `out`, or `runs/<name>`, or the first free `runs/<name>-2` and so on.

    `source` is the input's folder or file, None for a built-in sequence.

    Raises:
        OutputError: `out` holds results or checkpoints already or files of somebody else, or lies in the input.
    """
    if out is None:
        base = RUNS / (name.replace(os.sep, "-") or "sequence")
        numbered = (base.with_name(f"{base.name}-{number}") for number in range(2, 1_000_000))
        out = base if _is_free(base) else next(folder for folder in numbered if _is_free(folder))
    elif checkpoint.written(out) and is_ours(out):
        raise OutputError(
            f"{out}: has a run that was cut short; go on with --resume {out} or choose another --out"
        )
    elif _is_taken(out):
        raise OutputError(f"{out}: has the results of a finished run; choose another --out or move them away")
    elif found := foreign(out):
        raise OutputError(f"{out}: has {found} that no run of ours wrote; choose another --out")
    if source is not None and _resolved(out).is_relative_to(source.resolve()):
        raise OutputError(
            f"{out}: lies in the input {source}, which is never written to; choose another --out"
        )
    return out


def _resolved(out: Path) -> Path:
    """Without links. Raises OutputError where these lead round in a circle."""
    try:
        # From Python 3.13 on `resolve` gives a path of such a circle, too
        if _is_circle(out):
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        return out.resolve()
    except (OSError, RuntimeError) as error:
        raise OutputError(f"{out}: its links lead nowhere ({error}); choose another --out") from error


def _is_circle(path: Path) -> bool:
    """Whether links lead from a path round in a circle."""
    try:
        path.stat()
    except OSError as error:
        return error.errno == errno.ELOOP
    return False


def is_ours(folder: Path) -> bool:
    """Whether a run has begun in a folder: it has a config.json as `outputs.write_config` writes it."""
    path = folder / CONFIG
    try:
        if path.is_symlink() or not path.is_file() or path.stat().st_size > LARGEST_CONFIG_BYTES:
            return False
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.keys() >= OF_OURS


def foreign(folder: Path) -> str:
    """The first name in a folder that a run would write to and must not, being somebody else's; empty if there is
    none. In a folder of ours all regular files of these names are ours."""
    ours = is_ours(folder)
    for name in FILES:
        path = folder / name
        if os.path.lexists(path) and not (ours and path.is_file() and not path.is_symlink()):
            return name
    for name in (checkpoint.FOLDER, str(MAP.parent)):
        inner = folder / name
        if os.path.lexists(inner) and not (ours and inner.is_dir() and not inner.is_symlink()):
            return name
    return "" if _may_be_a_lock(folder / LOCK) else LOCK


def sibling(folder: Path) -> Path:
    """A new folder beside another, with a number behind its name. Raises OutputError."""
    for number in range(2, 1_000_000):
        path = folder.with_name(f"{folder.name}-{number}")
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            continue
        except OSError as error:
            raise OutputError(f"{path}: cannot be made ({error.strerror or error})") from error
    raise OutputError(f"{folder}: too many folders of this name")


@contextmanager
def claimed(folder: Path) -> Iterator[Callable[[], bool]]:
    """Makes a folder and holds its lock, which the system frees however the process ends.

    Gives a function that says whether the folder of this name is still the one that was claimed: it may be deleted,
    and made again by another run, at any time.

    Raises:
        OutputError: the folder cannot be made or written, or another run has it.
    """
    made = not os.path.exists(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = _lock(folder / LOCK)
        _remove_parts(folder)
    except OSError as error:
        reason = error.strerror or error
        raise OutputError(f"{folder}: cannot be written ({reason}); choose another --out") from error
    try:
        yield lambda: _same_file(lock, folder / LOCK)
    finally:
        # While it is still held: once it is free, a file of this name may be another run's
        if _same_file(lock, folder / LOCK):
            (folder / LOCK).unlink(missing_ok=True)
        os.close(lock)
        if made:
            _remove_if_empty(folder)


def _lock(path: Path) -> int:
    """An open, locked file that says who holds it. Raises OutputError if another run does."""
    while True:
        if not _may_be_a_lock(path):
            raise OutputError(f"{path}: is no lock of a run; choose another --out or move it away")
        # A link is not followed, not even one made a moment ago
        handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
        try:
            if fcntl is not None:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(handle, HOLDER_BYTES).decode(errors="replace").strip()
            os.close(handle)
            raise OutputError(
                f"{path.parent}: in use by another run ({holder}); choose another --out"
            ) from error
        except OSError:  # a file system without locks: two runs at once cannot be told there
            pass
        # The last holder may have removed the file after it was opened here
        if _same_file(handle, path):
            os.ftruncate(handle, 0)
            os.write(handle, HOLDER + f"{os.getpid()} on {socket.gethostname()}\n".encode())
            return handle
        os.close(handle)


def _may_be_a_lock(path: Path) -> bool:
    """Whether there is nothing of this name, or a file that a run has locked once."""
    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            return False
        with path.open("rb") as file:
            start = file.read(HOLDER_BYTES)
    except OSError:  # there is none, or opening it will say why
        return True
    return not start or start.startswith(HOLDER)


def _same_file(handle: int, path: Path) -> bool:
    """Whether an open file is still the one of this name."""
    try:
        return os.path.samestat(os.fstat(handle), path.lstat())
    except OSError:
        return False


def _remove_parts(folder: Path) -> None:
    """Halves of our files, which a process that was killed left. Nobody else writes here now."""
    names = "|".join(re.escape(name) for name in FILES)
    pattern = re.compile(rf"\.({names})\.[a-z0-9_]{{8}}\.part")
    of_map = (folder / MAP.parent).glob(f".{MAP.name}.*.part") if (folder / MAP.parent).is_dir() else ()
    ours = [path for path in folder.iterdir() if pattern.fullmatch(path.name)]
    for path in (*ours, *of_map):
        if stat.S_ISREG(path.lstat().st_mode):
            path.unlink(missing_ok=True)


def _is_free(folder: Path) -> bool:
    """Whether it has nothing that a run would overwrite."""
    return not (_is_taken(folder) or foreign(folder))


def _is_taken(folder: Path) -> bool:
    """Whether it has what another run would overwrite."""
    return _has_results(folder) or bool(checkpoint.written(folder))


def _has_results(folder: Path) -> bool:
    return any(os.path.exists(folder / name) for name in FINISHED)


def _remove_if_empty(folder: Path) -> None:
    """A run that ended before any result leaves no empty folder behind."""
    try:
        folder.rmdir()
    except OSError:
        return
