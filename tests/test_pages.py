"""Pages of docs/ that are made by a tool are those of the source."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("tool", ["reference.py", "faults.py"])
def test_the_page_is_up_to_date(tool):
    found = subprocess.run([sys.executable, ROOT / "tools" / tool, "--check"], check=False)
    assert found.returncode == 0, f"run python tools/{tool}"
