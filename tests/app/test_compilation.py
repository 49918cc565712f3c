"""Where compiled programs are kept."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

from mipsjax.app.compilation import enable_cache

FOLDER = "jax_compilation_cache_dir"


@pytest.fixture(autouse=True)
def no_cache_yet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A home of its own, and the cache of all tests afterwards."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = chosen(), jax.config.jax_persistent_cache_min_compile_time_secs  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update(FOLDER, None)
    yield
    jax.config.update(FOLDER, before[0])
    jax.config.update("jax_persistent_cache_min_compile_time_secs", before[1])


def chosen() -> str | None:
    return jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]


def test_lies_in_the_users_cache(tmp_path: Path) -> None:
    enable_cache()
    folder = Path(chosen() or "")
    assert folder.is_dir() and folder.parent == tmp_path / "mipsjax"


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system tells no usable cores")
@pytest.mark.fault(55)
def test_is_another_one_for_fewer_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a process that is held to one core compiles is not divided among several."""
    folders = []
    for cores in ({0}, {0, 1}, {2, 3}):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=cores: cores)
        jax.config.update(FOLDER, None)
        enable_cache()
        folders.append(chosen())
    assert folders[0] != folders[1] == folders[2]


def test_that_the_user_has_chosen_stays(tmp_path: Path) -> None:
    jax.config.update(FOLDER, str(tmp_path / "mine"))
    enable_cache()
    assert chosen() == str(tmp_path / "mine")


def test_without_a_home_no_folder_is_made_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as where no home is known
    for cache in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", cache)
        enable_cache()
    assert chosen() is None and not list(tmp_path.iterdir())


@pytest.mark.fault(55)
def test_is_done_without_where_there_is_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    enable_cache()
    assert chosen() is None
