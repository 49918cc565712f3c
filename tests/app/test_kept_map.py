"""`map/`, and other recordings that start in it: `--map`, `--localise-only`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mipsjax.app.kept_map import FILE, FOLDER
from mipsjax.data.trajectory import read_tum
from mipsjax.submaps.saved import load
from running import Program, program

__all__ = ["program"]

pytestmark = pytest.mark.slow

SECOND = "synth:room-fast"
OPTIONS = ("--input.working-width", "80", "--quiet")


@pytest.fixture
def learned(program: Program) -> Path:
    """The folder of a run that has kept its map."""
    result = program(SECOND, *OPTIONS, "--frames", ":12")
    assert result.code == 0 and (result.out / FOLDER / FILE).is_file()
    return result.out


def again(program: Program, learned: Path, *options: str, out: str = "second"):
    where = ("--map", str(learned), "--out", str(learned.parent / out))
    return program(SECOND, *OPTIONS, "--frames", "3:12", *where, *options)


def test_a_second_recording_is_found_in_the_map_and_goes_on_in_it(program: Program, learned: Path) -> None:
    before = (learned / FOLDER / FILE).read_bytes()
    result = again(program, learned)
    assert result.code == 0 and "lost" not in result.statuses and len(result.statuses) == 9
    # Poses are in the world of the first recording, the same frames at the same place
    first, second = (read_tum(out / "trajectory.txt").T_world_cam for out in (learned, result.out))
    assert np.linalg.norm(first[3:, :3, 3] - second[:, :3, 3], axis=1).max() < 0.03
    assert [event["event"] for event in result.events if "found" in event["event"]] == ["found again"]
    assert result.metrics["frames"] == 9 and result.metrics["loops_found"] == []
    assert (learned / FOLDER / FILE).read_bytes() == before
    grown = load(result.out / FOLDER / FILE)
    assert grown.first == 12 and len(grown.records) == 21


def test_a_map_that_only_answers_is_not_written_again(program: Program, learned: Path) -> None:
    before = (learned / FOLDER / FILE).read_bytes()
    result = again(program, learned, "--localise-only")
    assert result.code == 0 and "lost" not in result.statuses
    assert (learned / FOLDER / FILE).read_bytes() == before
    assert not (result.out / FOLDER).exists() and result.metrics["mesh"] == "none"


def test_a_map_need_not_be_kept(program: Program) -> None:
    assert not (program(SECOND, *OPTIONS, "--frames", ":3", "--no-map").out / FOLDER).exists()


def test_a_folder_named_map_of_somebody_else_is_left_alone(program: Program) -> None:
    (program.out / FOLDER).mkdir(parents=True)
    result = program(SECOND, *OPTIONS, "--frames", ":3")
    assert result.code == 5 and "map" in result.stderr and not list((program.out / FOLDER).iterdir())


def test_maps_that_cannot_be_started_in_are_refused_in_one_line(program: Program, learned: Path) -> None:
    def refused(path: Path, *options: str) -> tuple[int, str]:
        result = again(program, path, *options, out="refused")
        assert not result.out.exists()
        return result.code, result.stderr

    code, text = refused(learned.parent)
    assert code == 3 and "has no map" in text
    code, text = refused(learned, "--field.hash-levels", "3")
    assert code == 2 and "--field.hash-levels 4, and not 3" in text
    code, text = refused(learned, "--map.width-px", "40")
    assert code == 2 and "--map.width-px 160" in text
    code, text = refused(learned, "--input.working-width", "160")
    assert code == 3 and "one camera" in text
    damaged = learned.parent / "damaged.npz"
    data = bytearray((learned / FOLDER / FILE).read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    code, text = refused(damaged)
    assert code == 3 and "damaged" in text
    result = program(SECOND, *OPTIONS, "--localise-only", "--out", str(learned.parent / "refused"))
    assert result.code == 2 and "--map" in result.stderr
