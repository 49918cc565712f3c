"""Configuration: frozen dataclasses, presets and validation.

Every number of the method is a field here. The `paper` preset holds the numbers of MIPS-Fusion (SIGGRAPH Asia
2023); where the paper gives none, and where a departure is better on two CPU cores, the docstring says why.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Encoding = Literal["frequency", "hash", "both"]


@dataclass(frozen=True)
class InputConfig:
    """What is taken from the sensor."""

    depth_min: float = 0.1
    """Metres; nearer measurements count as none."""
    depth_max: float = 8.0
    """Metres; farther measurements count as none."""
    working_width: int = 320
    """Pixels; wider images are decimated by a whole factor to about this width before anything else."""
    max_bad_frames: int = 100
    """Number of unusable frames after which a run stops with exit code 3."""


@dataclass(frozen=True)
class FieldConfig:
    """One submap's networks."""

    encoding: Encoding = "both"
    """`frequency`: sinusoids and one network, as in the paper; `hash`: a multiresolution hash grid; `both`: a
    smooth sinusoidal field for the search and a hash-grid field for the refinement, learned side by side."""
    truncation: float = 0.1
    """Metres, the paper's tau."""
    classification: bool = True
    """Off: the distance is regressed (the paper's ablation "No C")."""
    classes: int = 5
    coldness: float = 10.0
    """beta of the soft argmax (Eq. 2)."""
    normalised: bool = True
    """The outputs z are normalised to sum to 1 before the soft argmax, as in the paper; without it, coldness 10
    saturates the distribution at the start and the squared losses have no gradient."""
    octaves: int = 6
    longest_wavelength: float = 8.0
    """Metres, of the first octave; about the largest side of a submap."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers behind the sinusoids; the paper gives none."""
    hash_levels: int = 6
    hash_log2_entries: int = 15
    """Each level has 2 to this many entries."""
    hash_features: int = 2
    hash_coarsest: float = 0.44
    """Metres, edge of a cell of the first level."""
    hash_finest: float = 0.035
    """Metres, edge of a cell of the last level."""
    hash_hidden: tuple[int, ...] = (32, 32)
    color_hidden: tuple[int, ...] = (32,)


@dataclass(frozen=True)
class SampleConfig:
    """Samples along each ray (paper: 20 + 20 + 10)."""

    uniform: int = 8
    """Over free space and the truncation region."""
    truncation: int = 12
    """Within the truncation region."""
    surface: int = 0
    """Around the sample with the smallest distance, in a second phase."""
    surface_spread: float = 0.05
    """Metres, half length of that second interval; the paper gives none."""
    perpendicular: bool = True
    """Targets are distances across the surface, by the normal of the depth image, not along the ray."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the mapping loss."""

    tr: float = 1000.0
    fs: float = 10.0
    rgb: float = 1.0
    cross_entropy: float = 0.0
    """Of the two-hot cross entropy in both regions; not in the paper."""
    color_samples: int = 4
    """Samples of the truncation region on each ray on which colour is rendered."""
    emd: float = 0.01
    """Of both distribution terms, relative to tr and fs; the paper gives none, its released code has 0.01."""


@dataclass(frozen=True)
class MapConfig:
    """Local bundle adjustment."""

    steps: int = 8
    """Each frame, once a submap is initialised (paper: 15 in one place, 10 in another)."""
    first_steps: int = 200
    """On the anchor of a new submap (paper: 500)."""
    frames: int = 5
    """The current frame, the anchor, and randomly chosen keyframes."""
    pixels: int = 200
    """Of each frame in each step (paper: 384)."""
    learning_rate: float = 1e-2
    pose_learning_rate: float = 1e-3
    width_px: int = 160
    """Images are decimated to about this width for mapping; it bounds the memory of a keyframe."""


@dataclass(frozen=True)
class SearchConfig:
    """Randomized optimisation (RO)."""

    when: Literal["always", "needed", "never"] = "needed"
    """`needed`: only when gradient-based optimisation alone has not converged."""
    particles: int = 2048
    pixels: int = 160
    steps: int = 10
    rotation: float = 0.12
    """First radius of the swarm in the imaginary part of the quaternion, half the angle in radians."""
    translation: float = 0.25
    """Metres, first radius of the swarm."""
    momentum: float = 0.1
    """alpha of Eq. 14: the share of the last radii in the new ones."""
    epsilon: float = 1e-3
    """Smallest radius (Eq. 13)."""
    entropy_floor: float = 0.3
    """Nats; bounds the weight 1 / h^2 of a certain point."""
    residual: float = 0.018
    """Metres; gradient-based optimisation that ends above it has not converged."""
    inliers: float = 0.7
    """Share of pixels within 5 cm; gradient-based optimisation that ends below it has not converged."""
    uncertainty: bool = True
    """Off: the fitness is not weighted (the paper's ablation "No U")."""


@dataclass(frozen=True)
class RefineConfig:
    """Gradient-based optimisation (GO) of the pose."""

    method: Literal["adam", "lm", "never"] = "lm"
    """`adam` on d2t + rgb as in the paper; `lm`: robust second-order steps on d2t."""
    pixels: int = 768
    steps: int = 15
    learning_rate: float = 1e-2
    """Of Adam."""
    rgb: float = 1.0
    """Weight of the colour term of Adam (omega in Eq. 15)."""
    robust: float = 0.02
    """Metres, scale of the Cauchy weight."""


@dataclass(frozen=True)
class TrackConfig:
    """RO, then GO."""

    ro: SearchConfig = SearchConfig()
    go: RefineConfig = RefineConfig()


@dataclass(frozen=True)
class Config:
    """All of it."""

    input: InputConfig = InputConfig()
    field: FieldConfig = FieldConfig()
    sample: SampleConfig = SampleConfig()
    loss: LossConfig = LossConfig()
    map: MapConfig = MapConfig()
    track: TrackConfig = TrackConfig()
    seed: int = 0
