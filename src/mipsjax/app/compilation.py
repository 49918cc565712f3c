"""A cache of compiled programs on disk."""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
import warnings
from importlib.metadata import version
from pathlib import Path

import jax

CACHE_FROM_S = 0.3
"""Compilations that take less are not worth a file."""


def enable_cache() -> None:
    """Lets JAX keep compiled programs in the user's cache folder; without a folder it does without.

    A cache that the user has chosen (JAX_COMPILATION_CACHE_DIR) stays.
    """
    # A damaged entry, or one that two processes write at once, is compiled anew: nothing that a user must know
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")
    if jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        return
    named = os.environ.get("XDG_CACHE_HOME", "")
    home = named if os.path.isabs(named) else os.path.expanduser("~/.cache")
    if not os.path.isabs(home):  # nobody's home: a folder `~` would be made in the current one
        return
    folder = Path(home) / "mipsjax" / f"xla-{version('jaxlib')}-{_machine()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A folder that is there may still be one that nobody can write to
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", CACHE_FROM_S)


def _machine() -> str:
    """A short name for this kind of processor and how many of its cores may be used.

    Compiled programs are for one kind only, and are divided among the cores of the process that compiled them: one
    compiled by a process held to a single core is a third slower on two.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
        kind = "\n".join(
            sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
        )
    except OSError:
        kind = platform.processor()
    return f"{hashlib.sha256(f'{platform.machine()} {kind}'.encode()).hexdigest()[:12]}-{_cores()}"


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
