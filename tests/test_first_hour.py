"""The Python of docs/first-hour.md and of the README does what they say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"

pytestmark = pytest.mark.slow


def test_a_first_hour_runs():
    blocks = re.findall(r"^```python\n(.*?)^```$", (DOCS / "first-hour.md").read_text(), re.S | re.M)
    assert len(blocks) >= 5
    names: dict[str, object] = {}
    for number, block in enumerate(blocks):
        exec(compile(block, f"first-hour.md, block {number + 1}", "exec"), names)
