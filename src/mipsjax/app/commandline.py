"""The command line: options by dotted names over a file over a preset, and how a program ends: with one line."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, TextIO, TypeVar

import tyro

from mipsjax.app.signals import INTERRUPTED
from mipsjax.config.options import flat, read_toml, suggestion, validate
from mipsjax.config.presets import PRESETS, preset
from mipsjax.config.sections import Config
from mipsjax.data.open import parse_frames
from mipsjax.errors import ConfigError, MipsjaxError
from mipsjax.viewer import PORT

_OUT_OF_MEMORY = "RESOURCE_EXHAUSTED"
"""What XLA says where memory is not enough."""
LARGEST_PORT = (1 << 16) - 1
"""There is a next one to each that may be asked for."""
PROGRAM = "python -m mipsjax.run"
AnyOptions = TypeVar("AnyOptions")
# An option that is given or not; the other switches have a `no-` form too
Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]


@dataclass(frozen=True)
class Options:
    """Turns an RGB-D sequence into a camera trajectory and a coloured mesh.

    The preset comes first, then the file of --config, then the options below. Exit codes: 0 done, 1 a bug of
    ours or too little memory, 2 wrong options, 3 unusable input, 4 tracking lost, 5 output cannot be written,
    130 interrupted.
    """

    sequence: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")]
    """Folder of a sequence, or synth:NAME for a built-in one, such as synth:room."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the results; runs/NAME if none is given, numbered where that has results."""
    preset: Annotated[str, tyro.conf.arg(metavar="|".join(PRESETS))] = "default"
    """Starting point of all options of the method."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """Options of the method from a file, in the sections named below."""
    frames: Annotated[str, tyro.conf.arg(metavar="START:STOP:STEP")] = ":"
    """Which frames, counted from 0, without STOP."""
    layout: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Layout of the folder, where it cannot be told by looking."""
    intrinsics: Annotated[tuple[float, ...] | None, tyro.conf.arg(metavar="FX FY CX CY [W H]")] = None
    """Pixels of the depth image, or of an image of W x H."""
    depth_scale: Annotated[float | None, tyro.conf.arg(metavar="UNITS")] = None
    """Depth units per metre."""
    depth_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Depth images of a bag that has several."""
    color_topic: Annotated[str | None, tyro.conf.arg(metavar="TOPIC")] = None
    """Colour images of a bag that has several."""
    resume: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Goes on with the run in this folder that was cut short; beside it stands nothing but --quiet, --viewer and
    --no-mesh."""
    map: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Starts in the map of an earlier run: the camera is found in it, and it goes on growing."""
    localise_only: Flag = False
    """With --map: the camera is found in the map, of which nothing changes. No mesh is made."""
    no_map: Flag = False
    """The map is not kept."""
    no_mesh: Flag = False
    """No mesh is made."""
    no_loop: Flag = False
    """No loop is closed: the same as --loop.no-enabled."""
    viewer: Flag = False
    """Shows the run in a browser as it goes, with a button that pauses it."""
    viewer_port: int = PORT
    """Port of that page, or the next one that is free."""
    quiet: Flag = False
    """Prints nothing but errors."""
    inspect: Flag = False
    """Only says what the sequence is."""
    settings: Annotated[Config, tyro.conf.arg(name="")] = Config()  # noqa: RUF009 (frozen)


def parse(arguments: list[str]) -> Options:
    """Options of a command line, checked. `--help` exits on its own.

    Raises:
        ConfigError: an option, the preset or the config file is wrong.
    """
    names = ["--" + name for name, _ in flat(Config())]
    names += ["--" + item.name for item in fields(Options) if item.name not in ("sequence", "settings")]
    # Preset and file are read first, since the options go over them
    default = Options(sequence=tyro.MISSING, settings=_base(arguments))
    missing = "no sequence given; pass a folder, or synth:room for a built-in one"
    options = read_options(Options, PROGRAM, arguments, names, missing, default)
    if options.no_loop:
        loop = replace(options.settings.loop, enabled=False)
        options = replace(options, settings=replace(options.settings, loop=loop))
    validate(options.settings)
    if options.localise_only and options.map is None:
        raise ConfigError("--localise-only needs --map DIR, the map in which the camera is to be found")
    check_port(options.viewer_port, "--viewer-port")
    # For its errors alone: frames are chosen where the sequence is opened
    parse_frames(options.frames)
    return options


def check_port(port: int, option: str) -> None:
    """Raises ConfigError for a number that is no port."""
    if not 0 < port < LARGEST_PORT:
        raise ConfigError(f"{option} {port}: a port is a number from 1 to {LARGEST_PORT - 1}")


def read_options(
    kind: type[AnyOptions],
    program: str,
    arguments: list[str],
    names: Iterable[str],
    missing: str,
    default: AnyOptions | None = None,
) -> AnyOptions:
    """The command line over `default`. `names` are those of all options, `missing` what to say where what is not
    optional lacks.

    Raises:
        ConfigError: with one line.
    """
    # What tyro prints of an error fills a screen; a user gets one line of it
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            if default is None:
                return tyro.cli(kind, prog=program, args=arguments)
            return tyro.cli(kind, prog=program, args=arguments, default=default)
    except OSError:  # nobody can read the help
        say("")
        raise SystemExit(0) from None
    except SystemExit as exit:
        if exit.code in (0, None):
            raise
        raise ConfigError(_one_line(arguments, errors.getvalue(), names, missing)) from None


def ended(program: Callable[[], int]) -> int:
    """Calls a program and returns its exit code. Its errors are one line on stderr."""
    _open_streams()
    try:
        with bugs_saved_in(None):
            return program()
    except MipsjaxError as error:
        complain(f"error: {' '.join(str(error).split())}")
        return error.exit_code
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED


def complain(text: str) -> None:
    """Prints to stderr, as long as anyone listens."""
    _print(text, sys.stderr)


def _open_streams() -> None:
    """Gives a process whose streams are closed ones that lead nowhere, and lets all of them print any text."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or stream.closed:
            # Never closed: it is the stream of the process from here on
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def bugs_saved_in(folder: Path | None) -> Iterator[None]:
    """Turns an unforeseen exception into one line and a file with its traceback, in the folder for temporary files if
    None; one of too little memory, which is no bug, into what makes a run smaller."""
    try:
        yield
    except MipsjaxError:
        raise
    except Exception as error:
        if isinstance(error, MemoryError) or _OUT_OF_MEMORY in str(error):
            goes_on = "" if folder is None else f", and --resume {folder} goes on if a checkpoint is there"
            raise _MemoryError(
                f"too little memory ({str(error).splitlines()[0] if str(error) else 'no more is given'}): "
                f"--volume.max-submaps bounds the map, --input.working-width the images{goes_on}"
            ) from error
        text = f"{type(error).__name__}: {error}".splitlines()[0]
        try:
            # Only here, since without any folder for temporary files it fails
            place = Path(tempfile.gettempdir()) if folder is None else folder
            path = place / f"mipsjax-error-{os.getpid()}.txt"
            path.write_text(traceback.format_exc(), encoding="utf-8", errors="backslashreplace")
            where = f"its traceback is in {path}"
        except OSError as failure:
            where = f"its traceback cannot be written ({failure.strerror})"
        raise _BugError(f"a bug of mipsjax, please report it: {text}; {where}") from error


class _MemoryError(MipsjaxError):
    """This machine has too little for the run."""

    exit_code = 1


class _BugError(MipsjaxError):
    """A bug of ours, with its traceback saved."""

    exit_code = 1


def say(text: str) -> None:
    """Prints, as long as anyone reads: neither a closed pipe nor a full disk ends a run."""
    _print(text, sys.stdout)


def _print(text: str, stream: TextIO | None) -> None:
    """Prints a line. A stream that fails leads nowhere from then on, so that what it still holds fails at no exit."""
    if stream is None:
        return
    try:
        print(text, file=stream, flush=True)
    except UnicodeError:
        print(text.encode("ascii", "backslashreplace").decode(), file=stream, flush=True)
    except ValueError:  # closed
        return
    except OSError:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _base(arguments: list[str]) -> Config:
    """The config that the command line names, before its own options. Raises ConfigError."""
    names = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    names.add_argument("--preset", default="default")
    names.add_argument("--config", type=Path)
    try:
        named, _ = names.parse_known_args(arguments)
    except argparse.ArgumentError:  # one without a value, of which the whole command line complains
        return preset("default")
    base = preset(named.preset)
    return base if named.config is None else read_toml(named.config, base)


def _one_line(arguments: list[str], text: str, names: Iterable[str], missing: str) -> str:
    """What is wrong with a command line, from the message of tyro, which fills a screen."""
    known = {name.replace("_", "-") for name in names} | {"--help"}
    for argument in arguments:
        name = argument.split("=", 1)[0].replace("_", "-")
        # A switch may be turned off by its whole name or by the last part of it: `--loop.no-enabled`
        plain = re.sub(r"(^--|\.)no-", r"\1", name)
        if name.startswith("--") and name not in known and plain not in known:
            return f"unknown option {name}{suggestion(name, sorted(known))}"
    if "Missing from" in text:
        return missing
    return _first_block(text) or "wrong options"


def _first_block(text: str) -> str:
    """What a framed message says between its title and the next rule, as one line."""
    lines = [line.strip(" │╭╮╰╯─-") for line in text.strip().splitlines()]
    # A plain message has a rule below its title, one in a box has the title in the frame
    start = 1 if text.lstrip().startswith("╭") else lines.index("") + 1 if "" in lines else 0
    body = lines[start:]
    end = body.index("") if "" in body else len(body)
    return " ".join(" ".join(body[:end]).split())
