"""The folder of a run: chosen, claimed by one run at a time, and never that of somebody else."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from mipsjax.app.outputs import write_config
from mipsjax.app.results_folder import FILES, LOCK, choose_folder, claimed, is_ours, sibling
from mipsjax.config.presets import preset
from mipsjax.data.open import open_sequence
from mipsjax.errors import OutputError


@pytest.mark.fault(48)
def test_numbered_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for expected in ("a", "a-2", "a-3"):
        folder = choose_folder("a", None, None)
        assert folder == Path("runs") / expected
        folder.mkdir(parents=True)
        (folder / "metrics.json").touch()
    with pytest.raises(OutputError, match="finished run"):
        choose_folder("a", folder, None)
    assert choose_folder("a/b", None, None) == Path("runs/a-b")


@pytest.mark.fault(49)
def test_lock(tmp_path: Path) -> None:
    folder = tmp_path / "new"
    with claimed(folder):
        with (
            pytest.raises(OutputError, match=f"in use by another run.*{os.getpid()}"),
            claimed(folder),
        ):
            pass
        (folder / "result").touch()
    assert [path.name for path in folder.iterdir()] == ["result"]
    (folder / ".lock").write_text("process 1 on a machine that died\n")
    with claimed(folder):
        assert str(os.getpid()) in (folder / ".lock").read_text()


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("content", ["theirs", "{}", None])
def test_files_of_others_are_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: str | None
) -> None:
    """Files, and links to files elsewhere."""
    monkeypatch.chdir(tmp_path)
    folder, elsewhere = tmp_path / "runs" / "a", tmp_path / "elsewhere"
    folder.mkdir(parents=True)
    elsewhere.write_text("theirs")
    if content is None:
        (folder / name).symlink_to(elsewhere)
    else:
        (folder / name).write_text(content)
    with pytest.raises(OutputError, match="choose another --out"):
        choose_folder("a", folder, None)
    assert choose_folder("a", None, None) == Path("runs/a-2")
    assert not is_ours(folder)


def test_a_folder_of_ours_without_results_is_used_again(tmp_path: Path) -> None:
    write_config(tmp_path, preset("tiny"), {"sequence": "synth:tiny"}, open_sequence("synth:tiny"))
    (tmp_path / "status.csv").write_text("index")
    for name in (".status.csv.abcdefgh.part", ".status.csv.part", "status.csv.part"):
        (tmp_path / name).touch()
    assert is_ours(tmp_path) and choose_folder("a", tmp_path, None) == tmp_path
    with claimed(tmp_path):
        left = {path.name for path in tmp_path.glob("*.part")}
    assert left == {".status.csv.part", "status.csv.part"}, "only halves of our files are removed"
    (tmp_path / "events.jsonl").symlink_to(tmp_path / "status.csv")
    with pytest.raises(OutputError, match=r"events\.jsonl"):
        choose_folder("a", tmp_path, None)


def test_a_lock_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (tmp_path / "elsewhere").write_text("process of theirs")
    for make in (
        lambda path: path.write_text("theirs"),
        lambda path: path.symlink_to(tmp_path / "elsewhere"),
        lambda path: path.symlink_to(tmp_path / "nothing"),
        os.mkfifo,
    ):
        make(folder / LOCK)
        with pytest.raises(OutputError, match="choose another --out"):
            choose_folder("a", folder, None)
        with pytest.raises(OutputError, match="no lock of a run"), claimed(folder):
            pass
        (folder / LOCK).unlink()
    assert (tmp_path / "elsewhere").read_text() == "process of theirs"
    assert not (tmp_path / "nothing").exists()


def test_a_folder_deleted_and_made_again_is_known_to_be_another(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with claimed(folder) as held:
        assert held()
        shutil.rmtree(folder)
        assert not held()
        with claimed(folder) as theirs:
            assert theirs() and not held()
            assert sibling(folder) == tmp_path / "out-2"
            assert sibling(folder) == tmp_path / "out-3"
        folder.mkdir()
        (folder / LOCK).touch()
    assert (folder / LOCK).exists(), "it is not ours to remove"


def test_an_empty_folder_is_not_left_behind(tmp_path: Path) -> None:
    with claimed(tmp_path / "new"):
        pass
    assert list(tmp_path.iterdir()) == []
    with claimed(tmp_path):
        pass
    assert tmp_path.exists()


def test_output_in_the_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="lies in the input"):
        choose_folder("a", tmp_path / "deep" / "out", tmp_path)


def test_output_in_a_circle_of_links_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(OutputError, match="links"):
        choose_folder("a", tmp_path / "a" / "out", tmp_path / "in")
    with pytest.raises(OutputError), claimed(tmp_path / "a"):
        pass
