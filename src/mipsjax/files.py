"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from mipsjax.errors import OutputError


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a file that is there whole or not at all, also after a crash or on a full disk.

    Raises:
        OutputError: the folder is missing or not writable, or the disk is full.
    """
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
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
