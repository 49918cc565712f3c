"""How programs end where the streams or the folders that errors go to have failed themselves."""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path
from typing import NoReturn

import pytest

from mipsjax.app.commandline import complain, ended, say
from mipsjax.app.run import main
from mipsjax.errors import InputError

FULL = Path("/dev/full")


def broken() -> NoReturn:
    raise ValueError("of ours")


def refused() -> NoReturn:
    raise InputError("no \udcff such \u2603 folder")


def without_temporary_folder() -> NoReturn:
    raise FileNotFoundError(2, "No usable temporary directory found")


@pytest.fixture
def full(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both streams on a device without room."""
    if not FULL.exists():
        pytest.skip(f"no {FULL}")
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, FULL.open("w"))


def test_without_a_temporary_folder_all_is_as_with_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tempfile, "gettempdir", without_temporary_folder)
    assert main(["synth:tiny", "--inspect"]) == 0
    assert main(["synth:nothing"]) == 3
    assert ended(broken) == 1
    assert "ValueError: of ours; its traceback cannot be written" in capsys.readouterr().err


@pytest.mark.usefixtures("full")
def test_streams_without_room_change_no_exit_code() -> None:
    assert ended(lambda: say("a line") or 0) == 0
    assert ended(refused) == 3
    with pytest.raises(SystemExit) as caught:
        main(["--help"])
    assert caught.value.code == 0
    sys.stdout.flush()  # what the stream held has gone


def test_closed_streams_change_no_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, None)
    assert ended(lambda: say("a line") or 0) == 0
    for name in ("stdout", "stderr"):
        getattr(sys, name).close()
    assert ended(refused) == 3


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_names_that_a_stream_cannot_encode_are_escaped(
    monkeypatch: pytest.MonkeyPatch, encoding: str
) -> None:
    raw = io.BytesIO()
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(raw, encoding))
    assert ended(refused) == 3
    complain("\udcff")
    assert b"\\udcff such" in raw.getvalue()
