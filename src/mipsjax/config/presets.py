"""Whole configurations by name: `default` for two CPU cores, `paper` with the paper's numbers, `tiny` for tests."""

from __future__ import annotations

from mipsjax.config.sections import (
    Config,
    FieldConfig,
    KeyframeConfig,
    LossConfig,
    MapConfig,
    MeshConfig,
    PairConfig,
    SampleConfig,
    SensorConfig,
)
from mipsjax.config.submaps import BackgroundConfig, LoopConfig, VolumeConfig
from mipsjax.config.tracking import (
    BrightnessConfig,
    CornerConfig,
    GuardConfig,
    HeldConfig,
    RefineConfig,
    SearchConfig,
    TrackConfig,
)
from mipsjax.errors import ConfigError

UNLIMITED = 1e3
"""Metres or rad: no frame is that loose."""
UNGUARDED = GuardConfig(
    weak=0.6,
    lost=0.4,
    confirmed=0.0,
    residual=float("inf"),
    residual_unsure=float("inf"),
    residual_lost=float("inf"),
)
"""Judges a pose by its pixels that are known, and that have depth, alone: a map of `tiny` is certain of nothing. The
paper has no guard; `paper` has ours, so that a camera that is metres off is not called `ok`."""

PAPER = Config(
    sensor=SensorConfig(noise_growth=0.0),
    field=FieldConfig(encoding="frequency", coldness=10.0, normalised=True),
    sample=SampleConfig(uniform=20, truncation=20, surface=10, perpendicular=False),
    # All 20 + 20 + 10 samples of a ray carry colour
    loss=LossConfig(cross_entropy=0.0, cross_entropy_free=0.0, color_samples=50),
    map=MapConfig(
        # In one place of the paper; 10 in another. Effort and rate of poses do not follow the motion
        steps=15,
        steps_slow=15,
        pose_rate_slow=1.0,
        first_steps=500,
        submap_steps=500,
        final_steps=0,
        pixels=384,
        # Not given there: the usual one
        momentum=0.9,
        pose_learning_rate=1e-3,
    ),
    track=TrackConfig(
        ro=SearchConfig(when="always", particles=2048, pixels=384, steps=10, epsilon=1e-3),
        # Depth and colour are compared with the map alone, never with keyframes
        go=RefineConfig(
            method="adam", pixels=384, steps=10, final_steps=0, uncertainty=False, views=0, known=0
        ),
        # The colour term of Adam (Eq. 17) is in the place of both
        corners=CornerConfig(count=0),
        brightness=BrightnessConfig(weight=0.0),
        # How far a pose may be off is still stated; nothing follows from it
        held=HeldConfig(loose=UNLIMITED, weak=UNLIMITED, unsure=UNLIMITED),
    ),
    keyframe=KeyframeConfig(every_frames=30, translation=float("inf"), rotation=float("inf")),
    volume=VolumeConfig(governs="frustum", hysteresis=0.0, support=0, margin=0.0),
    # The nearest to a second process that refines all the time
    background=BackgroundConfig(every_frames=1, rate=1.0, pose_rate=1.0),
    loop=LoopConfig(relocalise=False),
    pairs=PairConfig(before=0, others=0, oldest=0),
)
TINY = Config(
    field=FieldConfig(
        hidden=(16,), hash_levels=4, hash_log2_entries=12, hash_hidden=(16,), color_hidden=(16,)
    ),
    # Its images are too coarse for normals
    sample=SampleConfig(uniform=4, truncation=6, perpendicular=False),
    loss=LossConfig(cross_entropy_free=3.0),
    map=MapConfig(
        pose_learning_rate=1e-3,
        steps=4,
        steps_slow=4,
        first_steps=60,
        submap_steps=60,
        final_steps=40,
        pixels=64,
    ),
    track=TrackConfig(
        ro=SearchConfig(particles=128, pixels=48, steps=4),
        go=RefineConfig(pixels=192, steps=8, smooth_pixels=192, smooth_steps=4),
        held=HeldConfig(loose=UNLIMITED, weak=UNLIMITED, unsure=UNLIMITED),
    ),
    guard=UNGUARDED,
    pairs=PairConfig(pixels=192),
    mesh=MeshConfig(voxel=0.05),
)
PRESETS = {"default": Config(), "paper": PAPER, "tiny": TINY}


def preset(name: str) -> Config:
    """One of PRESETS."""
    if name not in PRESETS:
        raise ConfigError(f"unknown preset '{name}'; there are {', '.join(PRESETS)}")
    return PRESETS[name]
