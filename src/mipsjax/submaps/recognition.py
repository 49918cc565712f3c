"""A frame recognised in a submap by its image, without any knowledge of where it should lie."""

from __future__ import annotations

from mipsjax.config.sections import Config
from mipsjax.images.features import Features, similar
from mipsjax.loops.registration import Match, relative_pose
from mipsjax.submaps.chance import Purpose, generator_for
from mipsjax.submaps.ids import RecordId, SubmapId
from mipsjax.submaps.proposals import Expected, Sighting, sight
from mipsjax.submaps.state import Keyframe, SlamState

DEVIATIONS = 3.0  # standard deviations of a pose from features by which the field may correct it


def recognise(
    state: SlamState, keyframe: Keyframe, submap_ids: list[SubmapId], cfg: Config
) -> Sighting | None:
    """The frame in one of some submaps, by its image: similar keyframes, matched features, then the field itself.

    Returns the first that fits, from the most similar keyframe on, or None.
    """
    # By id: a frame that several of the submaps share counts once
    stored: dict[RecordId, tuple[SubmapId, Keyframe, Features]] = {}
    for submap_id in submap_ids:
        for other in state.submaps[submap_id].keyframes:
            if other.features is not None:
                stored[other.id] = submap_id, other, other.features
    if keyframe.features is None or not stored:
        return None
    candidates = list(stored.values())
    database = [features for _, _, features in candidates]
    for i in similar(keyframe.features, database, cfg.loop.candidates):
        submap_id, other, features = candidates[i]
        seed = int(generator_for(cfg, Purpose.MATCH, keyframe.id, i).integers(2**31))
        match = relative_pose(keyframe.features, features, state.camera, seed)
        if not match.ok:
            continue
        found = sight(state, submap_id, keyframe, _expected(other, match, cfg), cfg, measured=True)
        if found is not None:
            return found
    return None


def _expected(other: Keyframe, match: Match, cfg: Config) -> Expected:
    """Where the features put the frame. The field must too: things of one kind in two rooms match, the rooms do not."""
    loop = cfg.loop
    return Expected(
        other.T_sub_cam @ match.T_other_current,
        loop.sigma + DEVIATIONS * match.deviation_m,
        loop.sigma_rotation + DEVIATIONS * match.deviation_rad,
    )
