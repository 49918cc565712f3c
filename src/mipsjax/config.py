"""Configuration: frozen dataclasses.

The numbers of the method. The `paper` preset holds the numbers of MIPS-Fusion (SIGGRAPH Asia
2023); where the paper gives none, and where a departure is better on two CPU cores, the docstring says why.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from mipsjax.config_submaps import BackgroundConfig, BlendConfig, CorrespondConfig, LoopConfig, VolumeConfig

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
    """beta of the soft argmax (Eq. 2; paper: 10, on outputs that sum to 1)."""
    normalised: bool = False
    """The outputs z are normalised to sum to 1 before the soft argmax, as in the paper. Its two softmaxes in a
    row saturate: the sinusoidal field then stays at one class (docs/method.md)."""
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
class SearchConfig:
    """Randomized optimisation (RO)."""

    when: Literal["always", "needed", "never"] = "needed"
    """`needed`: only when gradient-based optimisation alone has not converged."""
    particles: int = 1024
    """Poses in the swarm (paper: 2048)."""
    pixels: int = 96
    """On which each is judged (paper: 384)."""
    steps: int = 8
    """Of the swarm (paper: 10)."""
    rotation: float = 0.12
    """First radius of the swarm in the imaginary part of the quaternion, half the angle in radians."""
    translation: float = 0.25
    """Metres, first radius of the swarm."""
    widening: float = 1.5
    """Factor on both radii for each weak or lost frame just before."""
    widening_limit: float = 3.0
    """Largest such factor."""
    momentum: float = 0.1
    """alpha of Eq. 16: the share of the last radii in the new ones."""
    epsilon: float = 1e-3
    """Smallest radius (Eq. 15)."""
    uncertainty: bool = True
    """Off: the fitness is not weighted (the paper's ablation "No U")."""
    entropy_floor: float = 0.3
    """Nats; bounds the weight 1 / h^2 of a certain point."""
    residual: float = 0.012
    """Metres; gradient-based optimisation that ends above it has not converged."""
    residual_margin: float = 1.3
    """Above this many times the least residual of late it has not converged either, where that is more: no frame fits
    better than the sensor's noise. At most twice `residual`."""
    inliers: float = 0.7
    """Share of pixels within 5 cm; gradient-based optimisation that ends below it has not converged."""


@dataclass(frozen=True)
class RefineConfig:
    """Gradient-based optimisation (GO) of the pose."""

    method: Literal["adam", "lm", "never"] = "lm"
    """`adam` on d2t + rgb as in the paper; `lm`: robust second-order steps on d2t."""
    pixels: int = 2304
    """Of the steps on the fine field, and of the status (paper: 384)."""
    steps: int = 10
    """On the fine field."""
    smooth_pixels: int = 768
    """For the choice among the candidates of the motion prior, and for steps on the smooth field where there is one
    besides the fine one: before the others, where those alone have not converged."""
    smooth_steps: int = 7
    final_steps: int = 4
    """Of a last alignment of every frame to the finished map, with `lm`; 0 is none, as in the paper."""
    learning_rate: float = 1e-2
    """Of Adam."""
    rgb: float = 1.0
    """Weight of the colour term of Adam (omega in Eq. 17)."""
    robust: float = 0.02
    """Metres, scale of the Cauchy weight."""
    uncertainty: bool = True
    """Points are weighted by their uncertainty, with `lm`; the paper does so in RO only."""
    entropy_floor: float = 0.3
    """Nats; bounds that weight of a certain point."""
    views: int = 3
    """Keyframes near the last pose to whose depth images a frame is aligned as well, with `lm`; 0 is none, as in
    the paper. They hold a new view before the networks have learned it."""
    view_weight: float = 0.3
    """Of a point in each of these, relative to a certain one in the map."""
    view_robust: float = 0.01
    """Metres, scale of their Cauchy weight."""
    view_translation: float = 0.5
    """Metres from the last pose within which such keyframes lie."""
    view_rotation: float = 0.5
    """Radians, the same."""
    known: int = 8
    """Keyframes nearest to the expected pose: the steps trust the field only where these observed something, since
    elsewhere it is certain of surfaces that it made up. 0: everywhere, as in the paper."""


@dataclass(frozen=True)
class GuardConfig:
    """When a tracked pose is not trusted."""

    weak: float = 0.75
    """Share of known pixels below which a frame is weak: mapped, but the next search is wider."""
    lost: float = 0.6
    """Share of known pixels below which a frame is lost: never mapped. Frames of sequences that are tracked well have
    0.85 to 1; another room, wherever it fits best, commonly 0.4 to 0.7."""
    confirmed: float = 0.25
    """The same, of known pixels of which the map is certain: in space that was never observed everything looks like
    surface. Frames that are tracked well have 0.5 to 1."""
    measured: float = 0.05
    """Share of pixels with depth below which a frame that is not lost is weak, and nothing is learned from it: so few
    pixels leave its pose open."""
    residual: float = 0.024
    """Metres; a frame with a larger residual is lost, if also `noise` times the least of late is less. Frames that are
    tracked well have at most 18 mm, another room 18 to 30, the less the more often it is tried."""
    residual_unsure: float = 0.018
    """The same after a lost or skipped frame: what fits somewhere may be another place."""
    residual_lost: float = 0.012
    """The same after `lost_frames` lost frames or more, if `loop.relocalise` looks for them by their images: of so many
    wide searches one ends where another place fits by chance. As much as `track.ro.residual`, what needs no search."""
    lost_frames: int = 10
    """In a row."""
    noise: float = 1.5
    """Factor on the least residual of late, below which a residual is the sensor's."""


@dataclass(frozen=True)
class CornerConfig:
    """Corners of the image, a term beside d2t in the second-order steps on the fine field: they hold the camera where
    surfaces leave a direction free. In place of the photometric term of the paper."""

    count: int = 400
    """Followed from each earlier frame; 0 is none."""
    keyframes: int = 3
    """From which corners are followed beside the last frame: the newest one, and the oldest that are still seen."""
    fewest: int = 12
    """Corners of one frame that must agree on a motion; fewer are not used."""
    noise_px: float = 0.35
    """Standard deviation of a followed corner: 0.13 to 0.38 in recordings, real and rendered, of images 320 wide."""
    robust: float = 2.0
    """Such deviations, scale of the Cauchy weight."""
    weight: float = 0.5
    """Of a corner, relative to a point of the map at the same standard deviation: neighbours err together."""


@dataclass(frozen=True)
class HeldConfig:
    """What is said of how far a pose may be off."""

    points: float = 4.0
    """Points of surfaces that err together, as neighbours on one surface do."""
    corners: float = 16.0
    """Corners of the image that do."""
    acceleration: float = 3.0
    """m/s^2, standard deviation of a camera's, where nothing else says how it moves."""
    turn: float = 6.0
    """rad/s^2, the same."""
    weak: float = 0.03
    """Metres (or as many rad): a frame is weak where measurements leave a direction open by this standard deviation.
    Along a bare corridor noise alone seems to hold a frame by 0.03 to 0.07."""


@dataclass(frozen=True)
class TrackConfig:
    """RO, then GO."""

    ro: SearchConfig = SearchConfig()
    go: RefineConfig = RefineConfig()
    corners: CornerConfig = CornerConfig()
    held: HeldConfig = HeldConfig()
    prior: float = 0.1
    """Metres (or as many rad), standard deviation of the motion that is expected: so wide that a frame follows it only
    along a direction that nothing else holds, with `lm`."""
    rest: float = 0.9
    """A frame starts from no motion only where its residual on the smooth field is below this part of that at constant
    velocity; 1 takes whichever is less, 0 never rest. A camera that surfaces hardly hold fits almost alike at rest, and
    would be left there. After a gap of more than five intervals between frames it is the other way round."""


@dataclass(frozen=True)
class PairConfig:
    """Keyframes measured against each other after the last frame, by corners and depth images of both and by no map:
    what says that a submap has turned or bent within itself. Only where `map.final_steps` learn the map there; not at
    all where `before`, `others` and `oldest` are 0. Not in the paper."""

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
    seed: int = dataclasses.field(default=0, compare=False)
    """Of all random draws. Configurations that differ in it alone are equal, so that what was compiled for one serves
    the other: compiled code is given keys."""
