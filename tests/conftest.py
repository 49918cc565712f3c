"""Shared by all tests: strict JAX, a compilation cache, fixed hypothesis draws, real sequences."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import jax
import jaxlib
import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")

# A shape that broadcasts by accident is the commonest silent error in array code.
jax.config.update("jax_numpy_rank_promotion", "raise")

# Two processes that write the same entry at once may read a half-written one; JAX then compiles anew, with a
# warning that must not fail a test.
CACHE_WARNING = "ignore:Error (reading|writing) persistent compilation cache entry"


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("filterwarnings", CACHE_WARNING)
    folder = compilation_cache()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # a read-only home: the tests only take longer
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def compilation_cache() -> Path:
    """Folder under the user's cache, one for each version of jaxlib and kind of processor."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "mipsjax" / f"jaxlib-{jaxlib.__version__}-{platform.machine()}"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real sequences: $MIPSJAX_DATA, or `../shared/data` beside the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("MIPSJAX_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real sequences at {folder}; set MIPSJAX_DATA")
    return folder
