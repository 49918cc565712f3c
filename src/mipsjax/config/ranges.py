"""What each number of a configuration may be, and how those that belong together relate.

A configuration comes here as its dotted names and values; `config/options.py: validate` takes a whole one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from mipsjax.errors import ConfigError


class Range(NamedTuple):
    """The values a field may have."""

    low: float
    high: float = math.inf
    above: bool = False
    """`low` itself is not allowed."""
    infinite: bool = False
    """Infinity is allowed: it switches something off."""

    def holds(self, value: float) -> bool:
        """Whether a number is allowed; NaN never is."""
        finite = math.isfinite(value) or (self.infinite and value > 0)
        return finite and self.low <= value <= self.high and not (self.above and value == self.low)

    def __str__(self) -> str:
        low = f"above {self.low:g}" if self.above else f"at least {self.low:g}"
        return low if self.high == math.inf else f"{low} and at most {self.high:.10g}"


SMALLEST_IMAGE = 16
"""Pixels; narrower images hold no scene."""
LARGEST_SEED = 2**32 - 1
"""Seeds are 32 bits."""
LARGEST_COUNT = 2**31 - 1
"""Of any whole number: compiled code counts in 32 bits."""
LARGEST_NUMBER, SMALLEST_NUMBER = 1e9, 1e-12
"""Of any other number above zero: what is far beyond is infinity or zero in single precision, and makes NaN."""
LARGEST_LAYER, MOST_LAYERS = 1024, 8
"""Wider and deeper networks than any of this field, and still megabytes."""
MOST_SAMPLES = 1 << 20
"""Pixels, points or particles of one call: each takes kilobytes in it."""
SMALLEST_SIGMA = 1e-6
"""Radians or metres, as in `loops/factors.py`, which refuses a factor of less and cannot be imported from here."""
LARGEST_TABLE = 1 << 28
"""Numbers in all levels of a hash grid: a gigabyte, and Adam keeps two more of them."""
DIGITS_SHOWN = 40
"""Of a value in a message."""
POSITIVE = Range(0.0, above=True)
SIGMA = Range(SMALLEST_SIGMA)
NOT_NEGATIVE = Range(0.0)
COUNT = Range(1)
SAMPLES = Range(1, MOST_SAMPLES)
LAYER = Range(1, LARGEST_LAYER)
SHARE = Range(0.0, 1.0)
SWITCH = Range(0.0, above=True, infinite=True)
RIGHT_ANGLE = math.pi / 2
"""Radians; the surfaces of two normals farther apart face away from each other."""

RANGES: dict[str, Range] = {
    "input.depth_min": NOT_NEGATIVE,
    "input.depth_max": POSITIVE,
    "input.working_width": Range(SMALLEST_IMAGE),
    "input.max_bad_frames": NOT_NEGATIVE,
    # Precisions are relative to this one: they are divided by it
    "sensor.noise_floor": POSITIVE,
    "sensor.noise_growth": NOT_NEGATIVE,
    "field.truncation": POSITIVE,
    # Distances of classes are 2 truncation / (classes - 1) apart
    "field.classes": Range(2, 64),
    "field.coldness": POSITIVE,
    # Rounding of the angle loses a bit an octave: single precision has 24
    "field.octaves": Range(1, 16),
    "field.longest_wavelength": POSITIVE,
    "field.hidden": LAYER,
    "field.hash_levels": Range(1, 32),
    "field.hash_log2_entries": Range(1, 24),
    "field.hash_features": Range(1, 16),
    "field.hash_coarsest": POSITIVE,
    "field.hash_finest": POSITIVE,
    "field.hash_hidden": LAYER,
    "field.color_hidden": LAYER,
    "sample.uniform": Range(0, MOST_SAMPLES),
    # Colour is rendered on these: one at least
    "sample.truncation": SAMPLES,
    "sample.surface": Range(0, MOST_SAMPLES),
    "sample.surface_spread": POSITIVE,
    "loss.tr": NOT_NEGATIVE,
    "loss.fs": NOT_NEGATIVE,
    "loss.rgb": NOT_NEGATIVE,
    "loss.emd": NOT_NEGATIVE,
    "loss.cross_entropy": NOT_NEGATIVE,
    "loss.cross_entropy_free": NOT_NEGATIVE,
    "loss.color_samples": SAMPLES,
    "map.steps": NOT_NEGATIVE,
    "map.steps_slow": NOT_NEGATIVE,
    "map.submap_steps": NOT_NEGATIVE,
    "map.revisit_steps": NOT_NEGATIVE,
    "map.final_steps": NOT_NEGATIVE,
    "map.motion": POSITIVE,
    # The first map must know something before the second frame; later ones may do without (No SI)
    "map.first_steps": COUNT,
    # The current frame, the anchor, and a random one
    "map.frames": Range(3),
    "map.pixels": SAMPLES,
    "map.learning_rate": POSITIVE,
    # Adam divides by 1 less a power of it
    "map.momentum": Range(0.0, 0.999),
    "map.pose_learning_rate": NOT_NEGATIVE,
    "map.pose_rate_slow": SHARE,
    "map.width_px": Range(SMALLEST_IMAGE),
    # Particle 0 is the centre of the swarm: alone it would find nothing
    "track.ro.particles": Range(2, MOST_SAMPLES),
    "track.ro.pixels": SAMPLES,
    "track.ro.steps": COUNT,
    "track.ro.rotation": POSITIVE,
    "track.ro.translation": POSITIVE,
    # Below 1 the search would narrow while the camera is lost
    "track.ro.widening": Range(1.0),
    "track.ro.widening_limit": Range(1.0),
    "track.ro.momentum": SHARE,
    "track.ro.epsilon": POSITIVE,
    "track.ro.entropy_floor": POSITIVE,
    "track.ro.residual": POSITIVE,
    "track.ro.residual_margin": POSITIVE,
    "track.ro.inliers": SHARE,
    "track.go.pixels": SAMPLES,
    "track.go.steps": NOT_NEGATIVE,
    "track.go.smooth_pixels": SAMPLES,
    "track.go.smooth_steps": NOT_NEGATIVE,
    "track.go.final_steps": NOT_NEGATIVE,
    "track.go.learning_rate": POSITIVE,
    "track.go.rgb": NOT_NEGATIVE,
    "track.go.robust": POSITIVE,
    "track.go.entropy_floor": POSITIVE,
    "track.go.views": NOT_NEGATIVE,
    "track.go.view_weight": NOT_NEGATIVE,
    "track.go.view_robust": POSITIVE,
    "track.go.view_translation": NOT_NEGATIVE,
    "track.go.known": NOT_NEGATIVE,
    "track.go.view_rotation": NOT_NEGATIVE,
    "track.corners.count": Range(0, MOST_SAMPLES),
    "track.corners.keyframes": NOT_NEGATIVE,
    # RANSAC draws a motion from four of them
    "track.corners.fewest": Range(4),
    "track.corners.noise_px": POSITIVE,
    "track.corners.robust": POSITIVE,
    "track.corners.weight": NOT_NEGATIVE,
    "track.brightness.weight": NOT_NEGATIVE,
    "track.brightness.pixels": SAMPLES,
    "track.brightness.noise": POSITIVE,
    "track.brightness.robust": POSITIVE,
    "track.brightness.coarse_steps": NOT_NEGATIVE,
    # Information is divided by these: so many that err together count as one
    "track.held.points": POSITIVE,
    "track.held.corners": POSITIVE,
    "track.held.brightness": POSITIVE,
    "track.held.acceleration": POSITIVE,
    "track.held.turn": POSITIVE,
    "track.held.loose": POSITIVE,
    "track.held.weak": POSITIVE,
    "track.held.unsure": POSITIVE,
    "track.moving.margin": POSITIVE,
    "track.moving.least": SHARE,
    "track.moving.most": SHARE,
    "track.prior": POSITIVE,
    "track.rest": SHARE,
    "keyframe.error": POSITIVE,
    "keyframe.known": SHARE,
    "keyframe.every_frames": COUNT,
    # Infinite: no keyframe by motion, as in the paper
    "keyframe.translation": SWITCH,
    "keyframe.rotation": SWITCH,
    "guard.weak": SHARE,
    "guard.lost": SHARE,
    "guard.confirmed": SHARE,
    "guard.measured": SHARE,
    "guard.first_measured": SHARE,
    # Infinite: no frame is lost by its residual
    "guard.residual": SWITCH,
    "guard.residual_unsure": SWITCH,
    "guard.residual_lost": SWITCH,
    "guard.lost_frames": COUNT,
    "guard.noise": POSITIVE,
    "volume.far": POSITIVE,
    "volume.max_side": POSITIVE,
    "volume.overlap": SHARE,
    "volume.hysteresis": SHARE,
    "volume.support": NOT_NEGATIVE,
    "volume.margin": NOT_NEGATIVE,
    "volume.max_submaps": NOT_NEGATIVE,
    "background.every_frames": NOT_NEGATIVE,
    "background.steps": NOT_NEGATIVE,
    "background.together": COUNT,
    "background.rate": SHARE,
    "background.pose_rate": SHARE,
    "loop.patience": COUNT,
    "loop.apart": COUNT,
    "loop.candidates": COUNT,
    "loop.overlap": SHARE,
    "loop.inliers": SHARE,
    "loop.held": NOT_NEGATIVE,
    "loop.drift": POSITIVE,
    "loop.drift_rotation": POSITIVE,
    # A measurement with next to no deviation would outweigh all others in the pose graph
    "loop.sigma": SIGMA,
    "loop.sigma_rotation": SIGMA,
    "loop.fewest_points": COUNT,
    "loop.points_sigma": SIGMA,
    "loop.effective_points": POSITIVE,
    "loop.tolerance": POSITIVE,
    "pairs.before": NOT_NEGATIVE,
    "pairs.others": NOT_NEGATIVE,
    "pairs.oldest": NOT_NEGATIVE,
    "pairs.translation": POSITIVE,
    "pairs.rotation": POSITIVE,
    "pairs.pixels": SAMPLES,
    "pairs.robust": POSITIVE,
    "correspond.points": SAMPLES,
    "correspond.newton_steps": COUNT,
    "correspond.match_steps": COUNT,
    "correspond.max_distance": POSITIVE,
    "correspond.max_entropy": Range(0.0, 1.0, above=True),
    "correspond.min_gradient": POSITIVE,
    "correspond.max_gradient": POSITIVE,
    "correspond.max_angle": Range(0.0, RIGHT_ANGLE, above=True),
    "blend.entropy_floor": POSITIVE,
    "mesh.voxel": Range(1e-3, 10.0),
    "mesh.margin": Range(0.0, 10.0, above=True),
    "mesh.band": POSITIVE,
    "mesh.max_entropy": Range(0.0, 1.0, above=True),
    "mesh.depth_max": POSITIVE,
    "mesh.min_component_m2": NOT_NEGATIVE,
    "checkpoint.every_keyframes": NOT_NEGATIVE,
    "checkpoint.every_seconds": NOT_NEGATIVE,
    "seed": Range(0, LARGEST_SEED),
}

NOT_BELOW = (
    ("input.depth_max", "input.depth_min"),
    ("field.hash_coarsest", "field.hash_finest"),
    # A band beyond the truncation has the jump behind a surface in it, which would be meshed
    ("field.truncation", "mesh.band"),
    # What is lost must be weak as well
    ("guard.weak", "guard.lost"),
    # The less certain it is where the camera is, the less a frame may be off
    ("guard.residual", "guard.residual_unsure"),
    ("guard.residual_unsure", "guard.residual_lost"),
    ("correspond.max_gradient", "correspond.min_gradient"),
    # A direction that makes a frame weak must follow the motion before, too
    ("track.held.weak", "track.held.loose"),
)
"""Pairs whose first field must not be below the second."""


def check(values: Mapping[str, Any]) -> None:
    """Raises ConfigError for the first impossible field: its dotted name, its value, what is allowed.

    `values` has every field of a configuration by its dotted name.
    """
    for name, value in values.items():
        if name in RANGES:
            _check_field(name, value)
    _check_table(values)
    for larger, smaller in NOT_BELOW:
        if values[larger] < values[smaller]:
            raise ConfigError(
                f"{larger} must be at least {smaller}, got {values[larger]:g} and {values[smaller]:g}"
            )


def shown(value: object) -> str:
    """A value for a message, cut where it is long."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # an integer of thousands of digits, or lists in lists
        return "one too long to show"
    return text if len(text) <= DIGITS_SHOWN else f"{text[:DIGITS_SHOWN]}..."


def _check_field(name: str, value: Any) -> None:
    """Raises ConfigError for a field with a number outside its range."""
    # A field with several numbers has the widths of layers
    numbers = value if isinstance(value, tuple) else (value,)
    if len(numbers) > MOST_LAYERS:
        raise ConfigError(f"{name} may have {MOST_LAYERS} layers, got {len(numbers)}")
    for number in numbers:
        _check_number(name, number)


def _check_number(name: str, number: float) -> None:
    """Raises ConfigError for a number outside the range of its field, or outside what compiled code can hold."""
    allowed = RANGES[name]
    # First, since an integer may be too large even to be compared with infinity
    if isinstance(number, int):
        # Seeds go up to 32 bits without a sign: they are drawn from, not counted with
        most = LARGEST_COUNT if allowed.high == math.inf else max(LARGEST_COUNT, int(allowed.high))
        if abs(number) > most:
            raise ConfigError(f"{name} must be at most {most}, got {shown(number)}")
    # 0 and infinity switch things off: the range says whether they may
    elif math.isfinite(number) and number > 0 and not SMALLEST_NUMBER <= number <= LARGEST_NUMBER:
        raise ConfigError(
            f"{name} must be between {SMALLEST_NUMBER:g} and {LARGEST_NUMBER:g}, got {number:g}"
        )
    if not allowed.holds(number):
        raise ConfigError(f"{name} must be {allowed}, got {number:g}")


def _check_table(values: Mapping[str, Any]) -> None:
    """Raises ConfigError for a hash grid beyond any memory, which it can be with each of its factors in range."""
    levels, features = values["field.hash_levels"], values["field.hash_features"]
    numbers = levels * 2 ** values["field.hash_log2_entries"] * features
    if numbers > LARGEST_TABLE:
        raise ConfigError(
            f"field.hash_levels, .hash_log2_entries and .hash_features make a table of {numbers:g} numbers, at most "
            f"{LARGEST_TABLE:g} are possible; choose smaller ones"
        )
