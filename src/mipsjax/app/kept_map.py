"""The map that a finished run keeps in its folder, and that other recordings start in: `--map`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import jax

from mipsjax.app.results_folder import MAP
from mipsjax.config.options import flat, to_dict
from mipsjax.config.sections import Config
from mipsjax.core import mapping
from mipsjax.data.sequence import Sequence
from mipsjax.errors import ConfigError, InputError, OutputError
from mipsjax.files import write_atomically
from mipsjax.slam.localise import continued
from mipsjax.submaps.saved import packed, unpacked
from mipsjax.submaps.state import SlamState

log = logging.getLogger(__name__)

FOLDER, FILE = str(MAP.parent), MAP.name
CONTENT = "state"
"""As of `mipsjax.save`, so that `mipsjax.load` reads it."""
SHAPING = ("field.", "map.width_px")
"""How the options begin that say what a map consists of: they cannot change while it grows."""


def write_map(folder: Path, state: SlamState, cfg: Config) -> None:
    """Writes the map of a run into its folder. Raises OutputError."""
    inner = folder / FOLDER
    try:
        inner.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make {inner}: {error.strerror or error}") from error
    write_atomically(inner / FILE, packed(state, CONTENT, {"config": to_dict(cfg)}))


def opened_map(path: Path, cfg: Config, sequence: Sequence) -> SlamState:
    """The map of a run, of its folder, or of a file of `mipsjax.save`, as a sequence finds it that begins in it.

    Raises:
        InputError: there is no map, it is damaged, or the sequence is of another camera.
        ConfigError: it was learned with other options than these.
    """
    state, about = read_map(path)
    _check(path, about, state, cfg)
    return continued(state, sequence.intrinsics)


def read_map(path: Path) -> tuple[SlamState, dict[str, Any]]:
    """The map of a run, of its folder, or of a file of `mipsjax.save`, and what is said about it.

    Raises:
        InputError: there is none, or it is damaged.
    """
    content = unpacked(_file(path), CONTENT)
    return content.value, content.about


def _file(path: Path) -> Path:
    for candidate in (path / FOLDER / FILE, path / FILE, path):
        if candidate.is_file():
            return candidate
    raise InputError(
        f"{path}: has no map; --map takes the folder of a finished run, or a file of mipsjax.save"
    )


def _check(path: Path, about: dict[str, Any], state: SlamState, cfg: Config) -> None:
    """Raises ConfigError where a map consists of something else than what `cfg` learns."""
    known, wanted = about.get("config"), to_dict(cfg)
    if known is None:
        log.warning(
            "%s does not say with which options of --field it was learned: they must be the same", path
        )
    else:
        for name, value in flat(cfg):
            if name.startswith(SHAPING) and (before := _value(known, name)) != _value(wanted, name):
                raise ConfigError(
                    f"{path}: was learned with --{name.replace('_', '-')} {before}, and not {value}: give the same, or "
                    "the same --preset"
                )
    shapes = jax.eval_shape(lambda: mapping.create(jax.random.key(0), cfg).field)
    found = jax.tree.map(lambda leaf: leaf.shape, state.submap.learned.field)
    if found != jax.tree.map(lambda leaf: leaf.shape, shapes):
        raise ConfigError(f"{path}: was learned with other options of --field than these: give the same")


def _value(content: Any, name: str) -> Any:
    """An option by its dotted name; None where there is none."""
    for part in name.split("."):
        content = content.get(part) if isinstance(content, dict) else None
    return content
