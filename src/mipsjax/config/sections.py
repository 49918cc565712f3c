"""Configuration: frozen dataclasses.

The numbers of the method. The `paper` preset holds the numbers of MIPS-Fusion (SIGGRAPH Asia
2023); where the paper gives none, and where a departure is better on two CPU cores, the docstring says why.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from mipsjax.config.submaps import BackgroundConfig, BlendConfig, CorrespondConfig, LoopConfig, VolumeConfig
from mipsjax.config.tracking import GuardConfig, TrackConfig

Encoding = Literal["frequency", "hash", "joint", "both"]


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
class SensorConfig:
    """How depth errs: points count by its inverse variance in second-order tracking, submaps in the blend. Not in the
    paper."""

    noise_floor: float = 0.01
    """Metres, standard deviation close by, with the map's own error."""
    noise_growth: float = 0.002
    """Metres, what the sensor adds at one metre, as for structured light; it grows with the square of the range. 0: all
    points and submaps count the same, as in the paper."""


@dataclass(frozen=True)
class FieldConfig:
    """One submap's networks."""

    encoding: Encoding = "both"
    """`frequency`: sinusoids and one network, as in the paper; `hash`: a multiresolution hash grid; `joint`: one
    network fed with both; `both`: a smooth sinusoidal field for the search and a hash-grid field for the
    refinement, learned side by side."""
    truncation: float = 0.1
    """Metres, the paper's tau."""
    classification: bool = True
    """Off: the distance is regressed (the paper's ablation "No C")."""
    classes: int = 5
    """Of the distance, evenly from -`truncation` to `truncation`."""
    coldness: float = 1.0
    """beta of the soft argmax (Eq. 2; paper: 10, on normalised outputs)."""
    normalised: bool = False
    """The outputs z are numbers in 0..1, each by a sigmoid, before the soft argmax: as the paper's "normalised" vector
    can be learned. Made to sum to 1, they saturate at one class (docs/method.md)."""
    octaves: int = 6
    """Of the sinusoids, for each coordinate."""
    longest_wavelength: float = 8.0
    """Metres, of the first octave; about the largest side of a submap."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers behind the sinusoids; the paper gives none."""
    hash_levels: int = 6
    """Grids, from the coarsest to the finest."""
    hash_log2_entries: int = 15
    """Each level has 2 to this many entries."""
    hash_features: int = 2
    """Numbers in an entry."""
    hash_coarsest: float = 0.44
    """Metres, edge of a cell of the first level."""
    hash_finest: float = 0.035
    """Metres, edge of a cell of the last level."""
    hash_hidden: tuple[int, ...] = (32, 32)
    """Widths of the hidden layers behind the hash grid."""
    color_hidden: tuple[int, ...] = (32,)
    """Widths of the hidden layers of the colour network."""


@dataclass(frozen=True)
class SampleConfig:
    """Samples along each ray (paper: 20 + 20 + 10)."""

    uniform: int = 1
    """Over free space and the truncation region. Few samples on many rays teach more than the reverse."""
    truncation: int = 3
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
    """Of the distance in the truncation region (Eq. 9)."""
    fs: float = 10.0
    """Of the distance in free space (Eq. 11)."""
    rgb: float = 1.0
    """Of colour (Eq. 12)."""
    emd: float = 0.01
    """Of both distribution terms; the paper gives none, its released code has 0.01."""
    cross_entropy: float = 3.0
    """Of the two-hot cross entropy in the truncation region; not in the paper. Its gradient does not vanish where the
    distribution is certain and wrong, which the squared terms' does: a new surface is learned in fewer steps."""
    cross_entropy_free: float = 0.3
    """The same in free space. With equal weights the free space in front of a new surface pushes it away, which
    turns the camera a little with every new view."""
    color_samples: int = 3
    """Samples of the truncation region on each ray on which colour is rendered (paper: all)."""


@dataclass(frozen=True)
class MapConfig:
    """Local bundle adjustment."""

    steps: int = 32
    """Each frame of a fast camera, once a submap is initialised (paper: 15 in one place, 10 in another, always)."""
    steps_slow: int = 8
    """The same where the camera has hardly moved since the last frame; in between, in proportion to the motion."""
    motion: float = 0.1
    """Metres (or as many times 1 rad) of motion between frames that deserve all `steps`."""
    first_steps: int = 200
    """On the anchor of a new submap (paper: 500)."""
    submap_steps: int = 200
    """The same for later submaps, on the anchor and the keyframes before it; 0 is the paper's ablation "No SI"."""
    revisit_steps: int = 10
    """Of an inactive submap on the frame with which it becomes active again, together with keyframes of its own; 0
    is the paper's ablation "No SR"."""
    final_steps: int = 600
    """After the last frame, over all keyframes of each submap, with a falling learning rate; 0 is none, as in the
    paper, whose background thread has refined each submap many times over by then."""
    frames: int = 5
    """The current frame, the anchor, and randomly chosen keyframes."""
    pixels: int = 256
    """Of each frame in each step (paper: 384)."""
    learning_rate: float = 1e-2
    """Of Adam on the networks."""
    momentum: float = 0.8
    """beta 1 of Adam on the networks (paper: none given, 0.9 is usual)."""
    pose_learning_rate: float = 0.0
    """Of the twist of each frame, metres and radians (paper: 1e-3); 0 leaves poses as tracked. They are moved by the
    smooth field, whose surface is 4 to 10 mm off: a moving camera is turned by it, always the same way."""
    pose_rate_slow: float = 0.0
    """Share of that rate where the camera has hardly moved, and after the last frame: Adam's steps are as long as
    its rate however small the gradient, and would shake poses that are known to a millimetre. 1 is the paper."""
    width_px: int = 160
    """Images are decimated to about this width for mapping; it bounds the memory of a keyframe."""


@dataclass(frozen=True)
class KeyframeConfig:
    """Which frames are kept."""

    error: float = 0.05
    """Metres; a pixel with a smaller error is known already."""
    known: float = 0.65
    """A frame with a smaller share of known pixels is a keyframe."""
    every_frames: int = 1
    """Least distance between two keyframes (paper: 30, which starves a fast camera)."""
    translation: float = 0.15
    """Metres of motion since the last keyframe that make one; not in the paper."""
    rotation: float = 0.14
    """Radians of motion since the last keyframe that make one; not in the paper."""


@dataclass(frozen=True)
class PairConfig:
    """Keyframes measured against each other after the last frame, by corners, brightness and depth images of both and
    by no map: what says that a submap has turned or bent within itself. Only where `map.final_steps` learn the map
    there, and where two pairs for each keyframe lie near enough; not at all where `before`, `others` and `oldest` are
    0. Not in the paper."""

    before: int = 3
    """Keyframes just before each one that it is measured against."""
    others: int = 3
    """Earlier ones beside these, the nearest."""
    oldest: int = 3
    """Earlier ones beside these, the oldest: they hold what has drifted since."""
    translation: float = 1.0
    """Metres between the poses of two keyframes that may see the same."""
    rotation: float = 0.7
    """Radians, the same."""
    pixels: int = 9216
    """Of the later keyframe, that are held against the surfaces of the earlier one."""
    robust: float = 6.0
    """Standard deviations, scale of the Cauchy weight of a pair."""

    @property
    def wanted(self) -> bool:
        """Whether any keyframes are measured against each other."""
        return self.before + self.others + self.oldest > 0


@dataclass(frozen=True)
class MeshConfig:
    """The surface that is written at the end."""

    voxel: float = 0.02
    """Metres, edge of a cell of marching cubes."""
    margin: float = 0.04
    """Metres; surface is sought this far from measured points, at least two voxels. Farther out the field goes on past
    what was seen."""
    band: float = 0.08
    """Metres; a cell is meshed where a corner is nearer to the surface. Below the truncation, so that the jump
    of the truncated distance behind a surface is none."""
    max_entropy: float = 0.96
    """Share of the entropy of an even class distribution; where the field is less certain nothing is meshed."""
    depth_max: float = 5.0
    """Metres; measurements farther away do not count as observed surface."""
    min_component_m2: float = 0.05
    """Square metres; smaller detached pieces are dropped."""


@dataclass(frozen=True)
class CheckpointConfig:
    """What a run that is cut short can go on from; both 0: none is written."""

    every_keyframes: int = 50
    """Keyframes after which one is written; 0: however many there are."""
    every_seconds: float = 60.0
    """Seconds of wall time after which one is written; 0: however long it takes."""


@dataclass(frozen=True)
class Config:
    """All of it."""

    input: InputConfig = InputConfig()
    sensor: SensorConfig = SensorConfig()
    field: FieldConfig = FieldConfig()
    sample: SampleConfig = SampleConfig()
    loss: LossConfig = LossConfig()
    map: MapConfig = MapConfig()
    track: TrackConfig = TrackConfig()
    keyframe: KeyframeConfig = KeyframeConfig()
    guard: GuardConfig = GuardConfig()
    volume: VolumeConfig = VolumeConfig()
    background: BackgroundConfig = BackgroundConfig()
    loop: LoopConfig = LoopConfig()
    pairs: PairConfig = PairConfig()
    correspond: CorrespondConfig = CorrespondConfig()
    blend: BlendConfig = BlendConfig()
    mesh: MeshConfig = MeshConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()
    seed: int = dataclasses.field(default=0, compare=False)
    """Of all random draws. Configurations that differ in it alone are equal, so that what was compiled for one serves
    the other: compiled code is given keys."""
