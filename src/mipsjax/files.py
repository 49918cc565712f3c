"""Files that are there whole or not at all, and files that are read no further than they can be meant."""

from __future__ import annotations

import errno
import os
import stat
import tempfile
from pathlib import Path

from mipsjax.errors import OutputError

UNFINISHED = ".part"
"""End of the name of a file that is being written."""


def write_atomically(path: Path, data: bytes | memoryview) -> None:
    """Writes a file that is there whole or not at all, also after a crash or on a full disk.

    Raises:
        OutputError: the folder is missing or not writable, or the disk is full.
    """
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=UNFINISHED, dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
        raise OutputError(
            f"cannot write {path}: {error.strerror}; check the folder and free space"
        ) from error


def read_regular(path: Path, most_bytes: int) -> bytes:
    """The whole content of a regular file, and never more than `most_bytes`.

    A pipe would block for ever and a device may never end; neither is opened for long.

    Raises:
        OSError: the file is missing, unreadable, no regular file, or larger.
    """
    try:
        # Without waiting for somebody to write into a pipe
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except ValueError as error:  # a NUL in the name
        raise OSError(errno.EINVAL, "is no name of a file") from error
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "is no regular file")
    with os.fdopen(handle, "rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"has more than {most_bytes} bytes")
    return data
