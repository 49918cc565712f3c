"""The run as a whole is judged: whether its depth images agree with each other at the poses that were found."""

from __future__ import annotations

import logging

import numpy as np

from mipsjax.config.sections import Config, SensorConfig
from mipsjax.submaps.state import SlamState, thumbnail_stride, to_metres, world_pose
from mipsjax.uncertainty.agreement import LIMIT, MOST_VIEWS, Agreement, Noise, Part, Views, agreement

log = logging.getLogger(__name__)


def judged(state: SlamState, cfg: Config) -> Agreement | None:
    """What the small depth images of trusted frames say about the run, with indices of `state.records`; None where too
    few see the same. Warns where they contradict each other. No ground truth is needed."""
    # What has moved between two recordings contradicts neither
    own = range(state.first, len(state.records))
    seen = [i for i in own if state.records[i].status.trusted and state.records[i].depth is not None]
    # Evenly over the run, so that what was seen late is compared with what was seen early
    indices = seen[:: max(1, -(-len(seen) // MOST_VIEWS))]
    if not indices:
        return None
    records = [state.records[i] for i in indices]
    views = Views(
        np.stack([to_metres(record) for record in records]),
        np.stack([world_pose(state, record) for record in records]),
        state.camera.decimated(thumbnail_stride(state.camera)),
    )
    # Growth 0 says that all points count the same, not that the sensor is as good far away as close by
    growth = cfg.sensor.noise_growth or SensorConfig().noise_growth
    found = agreement(views, Noise(cfg.sensor.noise_floor, growth))
    if found is None:
        return None
    begins = None if found.begins is None else _in_records(found.begins, indices)
    found = found._replace(worst=_in_records(found.worst, indices), begins=begins)
    if begins is not None:
        log.warning("%s", contradiction(state, found))
    return found


def contradiction(state: SlamState, found: Agreement) -> str:
    """In words, where depth images contradict each other; empty where they agree."""
    if found.begins is None:
        return ""
    first, last = (state.records[index] for index in (found.begins.first, found.begins.last))
    return (
        f"depth images contradict each other: up to {100 * found.worst.share:.0f} % of what one frame measured is "
        f"looked through by another ({100 * LIMIT:.0f} % is allowed), first between frames {first.frame} and "
        f"{last.frame} ({first.timestamp:.2f} to {last.timestamp:.2f} s); poses are off, or the depth or the "
        "intrinsics are wrong, or much of what was seen has moved"
    )


def _in_records(part: Part, indices: list[int]) -> Part:
    return part._replace(first=indices[part.first], last=indices[part.last])
