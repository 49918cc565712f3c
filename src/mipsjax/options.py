"""What a configuration may be: ranges, TOML files merged over presets, plain dictionaries."""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

from mipsjax.config import Config
from mipsjax.errors import ConfigError

Plain = dict[str, Any]
Section = TypeVar("Section")


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


POSITIVE = Range(0.0, above=True)
NOT_NEGATIVE = Range(0.0)
COUNT = Range(1)
SHARE = Range(0.0, 1.0)
SWITCH = Range(0.0, above=True, infinite=True)
SMALLEST_IMAGE = 16
"""Pixels; narrower images hold no scene."""
LARGEST_SEED = 2**32 - 1
"""Seeds are 32 bits."""
RIGHT_ANGLE = math.pi / 2
"""Radians; the surfaces of two normals farther apart face away from each other."""

RANGES: dict[str, Range] = {
    "input.depth_min": NOT_NEGATIVE,
    "input.depth_max": POSITIVE,
    "input.working_width": Range(SMALLEST_IMAGE),
    "input.max_bad_frames": NOT_NEGATIVE,
    "sensor.noise_floor": POSITIVE,
    "sensor.noise_growth": NOT_NEGATIVE,
    "field.truncation": POSITIVE,
    "field.classes": Range(2, 64),
    "field.coldness": POSITIVE,
    # Rounding of the angle loses a bit an octave: single precision has 24
    "field.octaves": Range(1, 16),
    "field.longest_wavelength": POSITIVE,
    "field.hidden": COUNT,
    "field.hash_levels": Range(1, 32),
    "field.hash_log2_entries": Range(1, 24),
    "field.hash_features": Range(1, 16),
    "field.hash_coarsest": POSITIVE,
    "field.hash_finest": POSITIVE,
    "field.hash_hidden": COUNT,
    "field.color_hidden": COUNT,
    "sample.uniform": NOT_NEGATIVE,
    "sample.truncation": COUNT,
    "sample.surface": NOT_NEGATIVE,
    "sample.surface_spread": POSITIVE,
    "loss.tr": NOT_NEGATIVE,
    "loss.fs": NOT_NEGATIVE,
    "loss.rgb": NOT_NEGATIVE,
    "loss.emd": NOT_NEGATIVE,
    "loss.cross_entropy": NOT_NEGATIVE,
    "loss.cross_entropy_free": NOT_NEGATIVE,
    "loss.color_samples": COUNT,
    "map.steps": NOT_NEGATIVE,
    "map.steps_slow": NOT_NEGATIVE,
    "map.submap_steps": NOT_NEGATIVE,
    "map.revisit_steps": NOT_NEGATIVE,
    "map.final_steps": NOT_NEGATIVE,
    "map.motion": POSITIVE,
    "map.first_steps": COUNT,
    "map.frames": Range(3),
    "map.pixels": COUNT,
    "map.learning_rate": POSITIVE,
    "map.momentum": Range(0.0, 0.999),
    "map.pose_learning_rate": NOT_NEGATIVE,
    "map.pose_rate_slow": SHARE,
    "map.width_px": Range(SMALLEST_IMAGE),
    "track.ro.particles": Range(2),
    "track.ro.pixels": COUNT,
    "track.ro.steps": COUNT,
    "track.ro.rotation": POSITIVE,
    "track.ro.translation": POSITIVE,
    "track.ro.widening": Range(1.0),
    "track.ro.widening_limit": Range(1.0),
    "track.ro.momentum": SHARE,
    "track.ro.epsilon": POSITIVE,
    "track.ro.entropy_floor": POSITIVE,
    "track.ro.residual": POSITIVE,
    "track.ro.residual_margin": POSITIVE,
    "track.ro.inliers": SHARE,
    "track.go.pixels": COUNT,
    "track.go.steps": NOT_NEGATIVE,
    "track.go.smooth_pixels": COUNT,
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
    "track.corners.count": NOT_NEGATIVE,
    "track.corners.keyframes": NOT_NEGATIVE,
    "track.corners.fewest": Range(4),
    "track.corners.noise_px": POSITIVE,
    "track.corners.robust": POSITIVE,
    "track.corners.weight": NOT_NEGATIVE,
    "track.brightness.weight": NOT_NEGATIVE,
    "track.brightness.pixels": COUNT,
    "track.brightness.noise": POSITIVE,
    "track.brightness.robust": POSITIVE,
    "track.brightness.coarse_steps": NOT_NEGATIVE,
    "track.held.points": POSITIVE,
    "track.held.corners": POSITIVE,
    "track.held.brightness": POSITIVE,
    "track.held.acceleration": POSITIVE,
    "track.held.turn": POSITIVE,
    "track.held.loose": POSITIVE,
    "track.held.weak": POSITIVE,
    "track.held.unsure": POSITIVE,
    "track.prior": POSITIVE,
    "track.rest": SHARE,
    "keyframe.error": POSITIVE,
    "keyframe.known": SHARE,
    "keyframe.every_frames": COUNT,
    "keyframe.translation": SWITCH,
    "keyframe.rotation": SWITCH,
    "guard.weak": SHARE,
    "guard.lost": SHARE,
    "guard.confirmed": SHARE,
    "guard.measured": SHARE,
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
    "loop.sigma": POSITIVE,
    "loop.sigma_rotation": POSITIVE,
    "loop.fewest_points": COUNT,
    "loop.points_sigma": POSITIVE,
    "loop.effective_points": POSITIVE,
    "loop.tolerance": POSITIVE,
    "pairs.before": NOT_NEGATIVE,
    "pairs.others": NOT_NEGATIVE,
    "pairs.oldest": NOT_NEGATIVE,
    "pairs.translation": POSITIVE,
    "pairs.rotation": POSITIVE,
    "pairs.pixels": COUNT,
    "pairs.robust": POSITIVE,
    "correspond.points": COUNT,
    "correspond.newton_steps": COUNT,
    "correspond.match_steps": COUNT,
    "correspond.max_distance": POSITIVE,
    "correspond.max_entropy": Range(0.0, 1.0, above=True),
    "correspond.min_gradient": POSITIVE,
    "correspond.max_gradient": POSITIVE,
    "correspond.max_angle": Range(0.0, RIGHT_ANGLE, above=True),
    "blend.entropy_floor": POSITIVE,
    "mesh.voxel": Range(1e-3),
    "mesh.margin": POSITIVE,
    "mesh.band": POSITIVE,
    "mesh.max_entropy": Range(0.0, 1.0, above=True),
    "mesh.depth_max": POSITIVE,
    "mesh.min_component_m2": NOT_NEGATIVE,
    "seed": Range(0, LARGEST_SEED),
}

NOT_BELOW = (
    ("input.depth_max", "input.depth_min"),
    ("field.hash_coarsest", "field.hash_finest"),
    ("field.truncation", "mesh.band"),
    ("guard.weak", "guard.lost"),
    ("guard.residual", "guard.residual_unsure"),
    ("guard.residual_unsure", "guard.residual_lost"),
    ("correspond.max_gradient", "correspond.min_gradient"),
    ("track.held.weak", "track.held.loose"),
)
"""Pairs whose first field must not be below the second."""


def validate(cfg: Config) -> None:
    """Raises ConfigError for the first impossible field: its dotted name, its value, what is allowed."""
    values = dict(flat(cfg))
    for name, value in values.items():
        if name in RANGES:
            for number in value if isinstance(value, tuple) else (value,):
                if not RANGES[name].holds(number):
                    raise ConfigError(f"{name} must be {RANGES[name]}, got {number:g}")
    for larger, smaller in NOT_BELOW:
        if values[larger] < values[smaller]:
            raise ConfigError(
                f"{larger} must be at least {smaller}, got {values[larger]:g} and {values[smaller]:g}"
            )


def flat(section: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of all fields of a config, in the order of their definition."""
    for item in fields(section):
        value = getattr(section, item.name)
        if is_dataclass(value):
            yield from flat(value, f"{prefix}{item.name}.")
        else:
            yield prefix + item.name, value


def to_dict(section: Any) -> Plain:
    """A config as nested dictionaries of numbers, strings and lists; infinity is the string `inf`."""
    return {item.name: _plain(getattr(section, item.name)) for item in fields(section)}


def merged(base: Section, overrides: Plain, prefix: str = "") -> Section:
    """`base`, a config or a part of one, with the fields that nested dictionaries name replaced.

    Raises:
        ConfigError: an unknown key, with the nearest known one, or a value of a wrong type.
    """
    types = get_type_hints(type(base))
    changes: Plain = {}
    for key, value in overrides.items():
        name = prefix + key
        if key not in types:
            raise ConfigError(f"unknown key {name}{suggestion(name, _known_names())}")
        if is_dataclass(types[key]):
            if not isinstance(value, dict):
                raise ConfigError(f"{name} is a section of options, got {value!r}")
            changes[key] = merged(getattr(base, key), value, f"{name}.")
        else:
            changes[key] = _typed(name, value, types[key])
    return replace(base, **changes)  # pyright: ignore[reportArgumentType, reportCallIssue, reportUnknownVariableType]


def read_toml(path: Path, base: Config) -> Config:
    """`base` with the fields that a TOML file names replaced.

    Raises:
        ConfigError: the file is unreadable, no TOML, or names an unknown field or a wrong value.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--config {path}: cannot be read ({error})") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"--config {path}: not valid TOML ({error})") from error
    try:
        return merged(base, content)
    except ConfigError as error:
        raise ConfigError(f"--config {path}: {error}") from error


def suggestion(name: str, known: Iterable[str]) -> str:
    """`; did you mean X?` for the known name most like `name`, or nothing. A last part alone is enough."""
    known = list(known)
    last = name.rsplit(".", 1)[-1].lstrip("-")
    same_last = [other for other in known if other.rsplit(".", 1)[-1].lstrip("-") == last]
    near = same_last or difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"; did you mean {' or '.join(near)}?" if near else ""


def _known_names() -> list[str]:
    """Dotted names of all fields and sections."""
    leaves = [name for name, _ in flat(Config())]
    sections = {name.rsplit(".", depth)[0] for name in leaves for depth in (1, 2) if "." in name}
    return leaves + sorted(sections - set(leaves))


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return to_dict(value)
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _typed(name: str, value: Any, wanted: Any) -> Any:
    """A value from TOML or JSON as the type of its field. Raises ConfigError."""
    if get_origin(wanted) is Literal:
        if value not in get_args(wanted):
            raise ConfigError(f"{name} must be one of {', '.join(get_args(wanted))}, got {value!r}")
        return value
    if get_origin(wanted) is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{name} must be a list, got {value!r}")
        return tuple(_typed(name, item, get_args(wanted)[0]) for item in value)
    if wanted is float and value in ("inf", "-inf", "nan"):
        return float(value)
    allowed = (int, float) if wanted is float else (wanted,)
    if not isinstance(value, allowed) or (isinstance(value, bool) and wanted is not bool):
        raise ConfigError(f"{name} must be {_TYPE_NAMES[wanted]}, got {value!r}")
    return wanted(value)


_TYPE_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
