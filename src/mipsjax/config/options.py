"""Configurations from outside and back: TOML files merged over presets, plain dictionaries, and whether one is
possible.

The numbers that are possible are in `config/ranges.py`.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from mipsjax.config.ranges import check, shown
from mipsjax.config.sections import Config
from mipsjax.errors import ConfigError

Plain = dict[str, Any]
Section = TypeVar("Section")
LARGEST_FILE_BYTES = 1 << 20
"""Of a config file, a hundred times that of one with all options."""


def validate(cfg: Config) -> None:
    """Raises ConfigError for the first impossible field: its dotted name, its value, what is allowed."""
    check(dict(flat(cfg)))


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
                raise ConfigError(f"{name} is a section of options, got {shown(value)}")
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
        content = tomllib.loads(_read_small(path).decode("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--config {path}: cannot be read ({error})") from error
    except RecursionError as error:
        raise ConfigError(f"--config {path}: nested too deep; options have a section and a name") from error
    except ValueError as error:  # no TOML, or a number of thousands of digits
        raise ConfigError(f"--config {path}: not valid TOML ({error})") from error
    try:
        return merged(base, content)
    except ConfigError as error:
        raise ConfigError(f"--config {path}: {error}") from error


def _read_small(path: Path) -> bytes:
    """The bytes of a file that can be a config. Raises ConfigError for a pipe, a device or anything huge."""
    # Opening a pipe would wait for somebody to write into it
    if path.exists() and not path.is_file():
        raise ConfigError(f"--config {path}: is no regular file; name a TOML file")
    with path.open("rb") as file:
        # One byte more, which tells a larger file from one of just that size
        data = file.read(LARGEST_FILE_BYTES + 1)
    if len(data) > LARGEST_FILE_BYTES:
        raise ConfigError(
            f"--config {path}: more than {LARGEST_FILE_BYTES} bytes; name a TOML file of options"
        )
    return data


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
    # Sections are two deep at most, as `track.ro`
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
        if not isinstance(value, str) or value not in get_args(wanted):
            raise ConfigError(f"{name} must be one of {', '.join(get_args(wanted))}, got {shown(value)}")
        return value
    if get_origin(wanted) is tuple:
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{name} must be a list, got {shown(value)}")
        return tuple(_typed(name, item, get_args(wanted)[0]) for item in value)
    # As `to_dict` writes what JSON has no number for
    if wanted is float and value in ("inf", "-inf", "nan"):
        return float(value)
    allowed = (int, float) if wanted is float else (wanted,)
    # In Python true is a whole number
    if not isinstance(value, allowed) or (isinstance(value, bool) and wanted is not bool):
        raise ConfigError(f"{name} must be {_TYPE_NAMES[wanted]}, got {shown(value)}")
    try:
        return wanted(value)
    except OverflowError as error:  # a whole number beyond the range of floats
        raise ConfigError(f"{name} must be {_TYPE_NAMES[wanted]}, got {shown(value)}") from error


_TYPE_NAMES = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
