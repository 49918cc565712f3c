"""Shared by all tests: fixed hypothesis draws, and real sequences where this machine has them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real sequences: $MIPSJAX_DATA, or `../shared/data` beside the repository."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("MIPSJAX_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no real sequences at {folder}; set MIPSJAX_DATA")
    return folder
