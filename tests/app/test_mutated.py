"""Sequences that are damaged by chance: whatever comes of them is said in one line, and what is written is whole.

A few in every run of the tests; more by `MIPSJAX_MUTATIONS=500 python -m pytest tests/app/test_mutated.py`.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

import running
from mutations import LAYOUTS, mutated
from running import Program

pytestmark = pytest.mark.slow

program = running.program

COUNT = int(os.environ.get("MIPSJAX_MUTATIONS", "36"))
FOUND = 225, 243
"""What once ended in a traceback: NUL in a list of file names."""
ALLOWED = {0: "done", 3: "unusable input", 4: "tracking lost"}


@pytest.fixture(scope="module")
def layouts(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("layouts")
    return {name: convert(exported, folder / name) for name, convert in LAYOUTS.items()}


@pytest.mark.parametrize("seed", sorted({*range(COUNT), *FOUND}))
def test_a_sequence_that_is_damaged_by_chance(
    program: Program, layouts: dict[str, Path], tmp_path: Path, seed: int
) -> None:
    """`Program` finds any traceback, and outputs that are half, not readable or not finite."""
    name = list(LAYOUTS)[seed % len(LAYOUTS)]
    sequence = shutil.copytree(layouts[name], tmp_path / name)
    how = mutated(sequence, seed)
    result = program(sequence, mesh=seed % 5 == 0)
    assert result.code in ALLOWED, f"{name}, {how}: {result.stderr}"


@pytest.mark.parametrize("name", LAYOUTS)
def test_undamaged_it_is_tracked(program: Program, layouts: dict[str, Path], name: str) -> None:
    assert program(layouts[name]).code == 0
