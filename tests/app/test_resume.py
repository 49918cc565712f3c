"""How a run ended, as `--resume` tells it from the results that the run left."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from mipsjax.app.resume import end_of
from mipsjax.errors import InputError, MipsjaxError, TrackingLostError

DONE: dict[str, Any] = {
    "end": "done",
    "mesh": "none",
    "status": "ok",
    "frames": 8,
    "status_counts": {"ok": 8, "weak": 0, "lost": 0, "skipped": 0},
}


def left(folder: Path, changes: dict[str, Any]) -> Path:
    """A folder with the part of metrics.json that tells how a run ended."""
    (folder / "metrics.json").write_text(json.dumps(DONE | changes))
    return folder


@pytest.mark.parametrize(
    ("changes", "failure", "why"),
    [
        ({}, None, "results are there"),
        ({"status": "degraded"}, None, "results are there"),
        (
            {"status": "failed", "status_counts": {"lost": 5, "skipped": 1}},
            TrackingLostError,
            "was lost in 5",
        ),
        ({"end": "bad frames", "status_counts": {"lost": 0, "skipped": 5}}, InputError, "5 were unusable"),
        ({"status": "failed", "status_counts": {"lost": 0, "skipped": 7}}, InputError, "7 were unusable"),
        # Both: what cannot be seen cannot be tracked
        (
            {"end": "bad frames", "status": "failed", "status_counts": {"lost": 2, "skipped": 5}},
            InputError,
            "5 were unusable",
        ),
    ],
)
def test_a_run_that_failed_fails_again(
    tmp_path: Path, changes: dict[str, Any], failure: type[MipsjaxError] | None, why: str
) -> None:
    ended = end_of(left(tmp_path, changes))
    assert ended is not None and ended.failure is failure
    assert why in ended.text and str(tmp_path) in ended.text and "\n" not in ended.text


@pytest.mark.parametrize(
    "changes",
    [
        {"end": "interrupted"},
        {"mesh": "unfinished"},
        {"status_counts": None},
        {"status_counts": {}},
        {"frames": "many"},
    ],
)
def test_a_run_that_was_cut_short_or_left_no_whole_metrics_has_not_ended(
    tmp_path: Path, changes: dict[str, Any]
) -> None:
    assert end_of(tmp_path) is None
    assert end_of(left(tmp_path, changes)) is None
    (tmp_path / "metrics.json").write_text("{")
    assert end_of(tmp_path) is None
