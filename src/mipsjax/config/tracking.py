"""The part of the configuration that concerns tracking: RO, GO, colour, what holds a frame, and when it is trusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


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
    """Factor on both radii for each frame just before that was lost or hardly held or known."""
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
    """On the smooth field."""
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
    """Keyframes nearest to the expected pose: points count in the steps only where these observed something, since
    elsewhere the field is certain of surfaces that it made up. 0: everywhere, as in the paper."""


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
    first_measured: float = 0.1
    """Share of pixels with depth below which a frame cannot begin a map, or a submap that hangs on nothing: what it
    shows is all that is known at first."""
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
class BrightnessConfig:
    """Differences in brightness between a frame and earlier ones, those of which corners are followed: another term of
    these steps. Coarser levels of their pyramids also lead from the expected pose to a better one."""

    weight: float = 0.2
    """Of a pixel, relative to a point of the map at the same standard deviation: neighbours err together. 0: none."""
    pixels: int = 3072
    """Parts of a frame, of each of which the pixel where brightness changes most is compared with one earlier frame."""
    noise: float = 0.01
    """Least standard deviation, of the brightness that there is; each image has the one that is measured."""
    robust: float = 3.0
    """Standard deviations, scale of the Cauchy weight."""
    coarse_steps: int = 5
    """At each of the coarser levels."""


@dataclass(frozen=True)
class HeldConfig:
    """How far a pose may be off, and what follows from that."""

    points: float = 4.0
    """Points of surfaces that err together, as neighbours on one surface do."""
    corners: float = 16.0
    """Corners of the image that do."""
    brightness: float = 16.0
    """Pixels whose brightness does."""
    acceleration: float = 3.0
    """m/s^2, standard deviation of a camera's, where nothing else says how it moves."""
    turn: float = 6.0
    """rad/s^2, the same."""
    loose: float = 0.01
    """Metres (or as many rad): along a direction that measurements leave open by more than this standard deviation, the
    pose is a mean of what was measured and of where the motion before led, by how well each is known."""
    weak: float = 0.03
    """Metres (or as many rad): a frame is weak where measurements leave a direction open by this standard deviation."""
    unsure: float = 0.1
    """Metres: a frame is also weak where the camera may be this far off from where the map began, standard deviation,
    after all that led there. Where it is that in its submap alone, keyframes that seem near may be elsewhere."""


@dataclass(frozen=True)
class MovingConfig:
    """Things that move are left out of tracking and of the map: what a frame shows where one of the `go.known` nearest
    keyframes looked through free space. Not in the paper."""

    margin: float = 0.1
    """Metres before what a keyframe saw, beside what noise makes, from which on something was not there then."""
    least: float = 0.02
    """Share of a frame's depth below which it is left in."""
    most: float = 0.5
    """The same above which the pose is taken to be wrong instead, and nothing is left out. 0: nothing ever."""


@dataclass(frozen=True)
class TrackConfig:
    """RO, then GO."""

    ro: SearchConfig = SearchConfig()
    go: RefineConfig = RefineConfig()
    corners: CornerConfig = CornerConfig()
    brightness: BrightnessConfig = BrightnessConfig()
    held: HeldConfig = HeldConfig()
    moving: MovingConfig = MovingConfig()
    prior: float = 0.1
    """Metres (or as many rad), standard deviation of the motion that is expected: so wide that a frame follows it only
    along a direction that nothing else holds, with `lm`."""
    rest: float = 0.9
    """A frame starts from constant velocity instead of the motion that its corners show, or without corners from no
    motion instead of constant velocity, only where its residual on the smooth field is there below this part of the
    other's; 1 takes whichever is less, 0 always the first. A camera that surfaces hardly hold fits almost alike at
    rest, and would be left there. After a gap of more than five intervals between frames no motion stands for constant
    velocity."""
