"""How much memory the process has taken, and giving some of it back."""

from __future__ import annotations

import ctypes
import platform
from contextlib import suppress

try:
    import resource
except ImportError:  # not on Windows
    resource = None


def peak_memory() -> int | None:
    """Bytes of memory the process has used at most."""
    if resource is None:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else 1024 * peak  # bytes on macOS, kilobytes on Linux


def return_memory() -> None:
    """Hands back what glibc keeps although nothing uses it: over 100 MB after tracking, and the mesh needs more."""
    with suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).malloc_trim(0)
