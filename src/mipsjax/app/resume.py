"""`python -m mipsjax.run --resume DIR`: a run goes on where its last whole checkpoint is, to the same bits."""

from __future__ import annotations

import argparse
import json
import logging
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

from mipsjax.app.checkpoint import Progress, identity_in, read, written
from mipsjax.app.commandline import Options, check_port
from mipsjax.app.summary import failure
from mipsjax.config.options import merged, validate
from mipsjax.config.sections import Config
from mipsjax.errors import ConfigError, InputError, MipsjaxError, TrackingLostError
from mipsjax.submaps.state import Status
from mipsjax.viewer import PORT

log = logging.getLogger(__name__)


def resumed_options(arguments: list[str]) -> Options | None:
    """The options of the run that a command line goes on with, as they were when it began; None if it goes on with
    none.

    Raises:
        ConfigError: beside `--resume` stands what was decided when the run began.
        InputError: the folder is none of a run.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--resume", type=Path)
    parser.add_argument("--quiet", action="store_true")
    parser.add_argument("--viewer", action="store_true")
    parser.add_argument("--viewer-port", type=int, default=PORT)
    parser.add_argument("--no-mesh", action="store_true")
    try:
        given, others = parser.parse_known_args(arguments)
    except argparse.ArgumentError as error:
        if error.argument_name == "--resume":
            raise ConfigError("--resume takes the folder of a run") from error
        # What else is wrong is said where the whole command line is read
        return None
    if given.resume is None or "--help" in others:
        return None
    if others:
        raise ConfigError(
            f"{others[0]} cannot be given beside --resume: a run goes on as it was begun, by "
            f"{given.resume / 'config.json'}; only --quiet, --viewer, --viewer-port and --no-mesh can be"
        )
    check_port(given.viewer_port, "--viewer-port")
    options = options_in(given.resume)
    no_mesh = options.no_mesh or given.no_mesh
    return replace(
        options, quiet=given.quiet, viewer=given.viewer, viewer_port=given.viewer_port, no_mesh=no_mesh
    )


def options_in(folder: Path) -> Options:
    """The options of a run, from its config.json. Raises InputError."""
    path = folder / "config.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        plain = dict(content["options"], sequence=content["sequence"]["source"], resume=folder, inspect=False)
        # Over the default, whatever the preset was: all fields are in it
        cfg = merged(Config(), content["config"])
        validate(cfg)
        known = {item.name for item in fields(Options)} - {"settings"}
        options = Options(settings=cfg, **{name: plain[name] for name in known})
    except FileNotFoundError as error:
        raise InputError(f"{folder}: no run to go on with, it has no config.json") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, TypeError, ConfigError) as error:
        raise InputError(f"{path}: is not as a run writes it ({error}); begin the run again") from error
    intrinsics = None if options.intrinsics is None else tuple(options.intrinsics)
    started_in = None if options.map is None else Path(options.map)
    return replace(options, out=folder, intrinsics=intrinsics, map=started_in)


class Ended(NamedTuple):
    """A run that came to its end, so that there is nothing to go on with."""

    text: str
    """What to tell whoever wants to go on with it: how it ended, in one line."""
    failure: type[MipsjaxError] | None
    """The kind of error that it ended with; None if it ended well."""


def end_of(folder: Path) -> Ended | None:
    """How the run in a folder ended, as its metrics.json says; None where it was cut short, or its mesh was."""
    try:
        content = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        end, mesh = content["end"], content["mesh"]
        frames, counts = content["frames"], content["status_counts"]
        skipped, lost = counts[str(Status.SKIPPED)], counts[str(Status.LOST)]
        failed = failure(end, content["status"], frames - skipped)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if end == "interrupted" or mesh == "unfinished":
        return None
    text = f"{folder}: this run has ended ({end}), its results are there"
    if failed is None:
        return Ended(text, None)
    why = f"tracking was lost in {lost}" if failed is TrackingLostError else f"{skipped} were unusable"
    return Ended(f"{text}; of {frames} frames {why}: begin it again with other options", failed)


def progress_in(folder: Path, identity: dict[str, Any]) -> Progress:
    """The last whole checkpoint in the folder of a run, which is `identity`; damaged ones after it are removed.

    Raises:
        InputError: there is none, or it is of another run.
    """
    damaged: list[tuple[Path, InputError]] = []
    for path in written(folder):
        try:
            found = identity_in(path)
            _check(path, found, identity)
            progress = read(path)
        except _OtherRunError:  # it is whole, and an older one would be of that run too
            raise
        except InputError as error:
            damaged.append((path, error))
            continue
        # Only now that there is one to go on with: where all are damaged, all stay
        for other, error in damaged:
            log.warning("%s; the run goes on after frame %d", error, found["frames"])
            with suppress(OSError):
                other.unlink(missing_ok=True)
        return progress
    if damaged:
        raise InputError(f"no checkpoint to go on with: {damaged[0][1]}")
    raise InputError(f"{folder}: has no checkpoint to go on with; begin the run again")


class _OtherRunError(InputError):
    """A checkpoint is whole, and of another run."""


def _check(path: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    """Raises _OtherRunError where a checkpoint is not of this version, configuration or sequence."""
    if found["mipsjax"] != wanted["mipsjax"]:
        raise _OtherRunError(
            f"{path}: was written by mipsjax {found['mipsjax']} and this is {wanted['mipsjax']}, which may give other "
            "results: go on with that one, or begin the run again"
        )
    if (found["packages"], found["code"]) != (wanted["packages"], wanted["code"]):
        raise _OtherRunError(
            f"{path}: was written by another state of mipsjax's source or with other versions of "
            f"{', '.join(wanted['packages'])} than these, which may give other results: begin the run again"
        )
    if found["config"] != wanted["config"]:
        raise _OtherRunError(
            f"{path}: the run was begun with another configuration than config.json has now; begin it again"
        )
    differing = [name for name, value in wanted["sequence"].items() if found["sequence"].get(name) != value]
    if differing:
        raise _OtherRunError(
            f"{path}: the sequence is not the one that the run was begun with: it differs in "
            f"{', '.join(differing)}; begin the run again"
        )
