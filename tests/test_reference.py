"""docs/reference.md is that of the source."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_reference_is_up_to_date():
    found = subprocess.run([sys.executable, ROOT / "tools" / "reference.py", "--check"], check=False)
    assert found.returncode == 0, "run python tools/reference.py"
