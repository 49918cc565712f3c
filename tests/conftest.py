"""Shared by all tests: strict JAX, a compilation cache, fixed hypothesis draws, sequences."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

# The same bits twice are promised on a CPU only. JAX reads this once, when it is first imported.
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import pytest
from hypothesis import settings

from mipsjax.app.compilation import enable_cache

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")

# A shape that broadcasts by accident is the commonest silent error in array code.
jax.config.update("jax_numpy_rank_promotion", "raise")


MAPPINGS = 30_000
"""Pieces of memory of a process from which compiled programs are dropped: each has a few, and at 65,530 Linux gives no
more, which ends the process where the next program is loaded."""


def pytest_configure() -> None:
    enable_cache()


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """After a module, none where there are many; others come from the cache again."""
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > MAPPINGS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real sequences: $MIPSJAX_DATA, or `../shared/data` beside the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("MIPSJAX_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real sequences at {folder}; set MIPSJAX_DATA")
    return folder


@pytest.fixture(scope="session")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`synth:tiny` in the TUM layout, once for all modules."""
    import running  # here, since it loads the whole program

    return running.export(tmp_path_factory.mktemp("exported") / "tiny")
