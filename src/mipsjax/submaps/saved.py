"""A state in one file, which is whole or refused: `save`, `load`, and one more step gives the same bits.

The file is an `.npz` without pickle. All arrays of one type are one member, one after the other, and each array is
there once, in however many places it is: a frame that is a keyframe of several submaps has its images once, and so
after loading. The member `manifest` is JSON: the version of the format, where each array lies, and the structure they
are in. Zip keeps a checksum of each member.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mipsjax.core.camera import Intrinsics
from mipsjax.core.field import Field, Net
from mipsjax.core.mapping import Learned
from mipsjax.core.volume import Box
from mipsjax.errors import InputError
from mipsjax.files import write_atomically
from mipsjax.images.corners import Corners
from mipsjax.images.features import Features
from mipsjax.submaps.dormant import BFLOAT16, Packed
from mipsjax.submaps.records import Records
from mipsjax.submaps.state import (
    How,
    Keyframe,
    Loop,
    Motion,
    Record,
    Refinement,
    SlamState,
    Status,
    Submap,
    Word,
)
from mipsjax.uncertainty.held import Held
from mipsjax.uncertainty.trust import Differing

FORMAT = 3
"""Rises when what is written changes, so that no file is read as what it is not."""
MANIFEST = "manifest"
DATE = (1980, 1, 1, 0, 0, 0)
"""Of each member: the same state gives the same bytes."""
TUPLES = (
    Box, Corners, Differing, Features, Field, Held, Intrinsics, Keyframe, Learned, Loop, Motion, Net, Record,
    Refinement, SlamState, Submap, optax.EmptyState, optax.ScaleByAdamState,
)  # fmt: skip
DATACLASSES = (Packed, Records)
WORDS = (How, Status)
KINDS: Mapping[str, type] = {kind.__name__: kind for kind in (*TUPLES, *DATACLASSES, *WORDS)}
"""What a file may hold beside arrays, numbers, texts, tuples and dictionaries."""
PLAIN = (type(None), bool, int, float, str)
ARRAY, SCALAR, TUPLE = "array", "scalar", "tuple"
"""First words of what is no kind of the above."""


def save(state: SlamState, path: Path | str) -> None:
    """Writes a state into one file, which is there whole or not at all.

    Raises:
        OutputError: the folder is missing or not writable, or the disk is full.
    """
    write_atomically(Path(path), packed(state, "state", {}))


def load(path: Path | str) -> SlamState:
    """The state that was saved in a file.

    Raises:
        InputError: the file cannot be read, is damaged, or is none that this version of the format describes.
    """
    return unpacked(Path(path), "state").value


class Unpacked(NamedTuple):
    """What a file holds."""

    value: Any
    about: dict[str, Any]
    """What was said about it."""


class Place(NamedTuple):
    """Where an array lies in the file, as the manifest has it."""

    member: str
    """Its type."""
    begin: int
    """Entries of that type before it."""
    shape: list[int]
    column_first: bool
    """The first index goes fastest. Products of matrices may round otherwise for the other order."""
    on_device: bool
    """An array of JAX."""


def packed(value: Any, content: str, about: dict[str, Any]) -> memoryview:
    """The bytes of a file: a tree of what `KINDS` names, arrays, numbers and texts.

    `content` says what it is, `about` what a reader may want to know before it reads all, as JSON has it.
    """
    arrays = _Arrays()
    structure = arrays.described(value)
    manifest = {
        "format": FORMAT,
        "content": content,
        "mipsjax": version("mipsjax"),
        "about": about,
        "arrays": arrays.places,
        "structure": structure,
    }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        text = np.frombuffer(json.dumps(manifest, separators=(",", ":")).encode(), np.uint8)
        _write(archive, MANIFEST, [text])
        for name, parts in arrays.members.items():
            _write(archive, name, parts)
    return file.getbuffer()


def unpacked(path: Path, content: str) -> Unpacked:
    """What `packed` was given, from a file.

    Raises:
        InputError: the file cannot be read, is damaged, or is none that this version of the format describes.
    """
    with _opened(path) as archive:
        manifest = _manifest(path, archive, content)
        places = [Place(*place) for place in manifest["arrays"]]
        members = {name: _read(archive, name) for name in dict.fromkeys(place.member for place in places)}
        arrays = [_array(members[place.member], place) for place in places]
        return Unpacked(_built(manifest["structure"], arrays), manifest["about"])


def about(path: Path, content: str) -> dict[str, Any]:
    """What was said about the content of a file, which is not read itself. Raises InputError as `unpacked` does."""
    with _opened(path) as archive:
        return _manifest(path, archive, content)["about"]


class _Arrays:
    """Collects the arrays of a tree while it is described."""

    def __init__(self) -> None:
        self.places: list[Place] = []
        self.members: dict[str, list[np.ndarray]] = {}
        self._sizes: dict[str, int] = {}
        self._known: dict[int, tuple[Any, int]] = {}

    def described(self, value: Any) -> Any:
        """A part of the tree, as JSON has it."""
        # The very type: a bool is an int as well, and a NamedTuple a tuple
        kind = type(value)
        if kind in PLAIN:
            return value
        if kind is tuple:
            return [TUPLE, *map(self.described, value)]
        if kind is dict:
            return {key: self.described(part) for key, part in value.items()}
        if isinstance(value, np.generic):
            return [SCALAR, self._number(np.asarray(value))]
        if isinstance(value, np.ndarray | jax.Array):
            return [ARRAY, self._number(value)]
        if KINDS.get(kind.__name__) is not kind:
            raise TypeError(f"{kind.__name__} cannot be saved: it is not among what a file may hold")
        if isinstance(value, Word):
            return [kind.__name__, int(value)]
        parts = value if isinstance(value, tuple) else (getattr(value, item.name) for item in fields(value))
        return [kind.__name__, *map(self.described, parts)]

    def _number(self, array: np.ndarray | jax.Array) -> int:
        """Of an array in the file; one that was met before has the same."""
        if id(array) not in self._known:
            # It is kept, so that its id stays its own
            self._known[id(array)] = array, len(self.places)
            self._add(np.asarray(array), isinstance(array, jax.Array))
        return self._known[id(array)][1]

    def _add(self, array: np.ndarray, on_device: bool) -> None:
        name, column_first = array.dtype.name, array.flags.fnc
        begin = self._sizes.setdefault(name, 0)
        self.places.append(Place(name, begin, list(array.shape), column_first, on_device))
        self.members.setdefault(name, []).append(array.ravel("F" if column_first else "C"))
        self._sizes[name] = begin + array.size


def _write(archive: zipfile.ZipFile, name: str, parts: list[np.ndarray]) -> None:
    """One member: arrays of one type after each other, as one in NumPy's own format."""
    # NumPy's format has no name for bfloat16, so its bits go by as whole numbers
    kind = np.dtype(np.uint16) if parts[0].dtype == BFLOAT16 else parts[0].dtype
    header = {"descr": kind.str, "fortran_order": False, "shape": (sum(part.size for part in parts),)}
    # `zipfile` is not told the size when a member begins, and it may be beyond 2 GB
    with archive.open(zipfile.ZipInfo(f"{name}.npy", DATE), "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, header)  # pyright: ignore[reportArgumentType]  (any file will do)
        for part in parts:
            member.write(part.view(np.uint8).data)


def _read(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """One member, all of it, which checks its sum."""
    data = io.BytesIO(archive.read(f"{name}.npy"))
    array = np.lib.format.read_array(data, allow_pickle=False)
    if data.read(1):
        raise ValueError(f"more than the array {name}")
    return array


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """A file to be read; whatever is wrong with it comes out as InputError."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    # A flipped bit in the tables of a zip file raises nearly anything
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{path}: {_wrong(path)} ({reason})") from error


def _manifest(path: Path, archive: zipfile.ZipFile, content: str) -> dict[str, Any]:
    """The manifest. Raises InputError where a whole file is of another kind."""
    if f"{MANIFEST}.npy" not in archive.namelist():
        raise InputError(f"{path}: is no file of mipsjax")
    manifest = json.loads(_read(archive, MANIFEST).tobytes())
    if manifest["format"] != FORMAT:
        raise InputError(
            f"{path}: has version {manifest['format']} of the format, written by mipsjax {manifest['mipsjax']}; "
            f"this is mipsjax {version('mipsjax')}, which reads version {FORMAT}"
        )
    if manifest["content"] != content:
        raise InputError(f"{path}: is a {manifest['content']} and no {content}")
    return manifest


def _array(member: np.ndarray, place: Place) -> np.ndarray | jax.Array:
    end = place.begin + math.prod(place.shape)
    if end > len(member):
        raise ValueError(f"too few entries of {place.member}")
    # A copy, so that no array keeps all the others in memory
    flat = member[place.begin : end].copy()
    if place.member == BFLOAT16.name:
        flat = flat.view(BFLOAT16)
    array = flat.reshape(place.shape, order="F" if place.column_first else "C")
    return jnp.asarray(array) if place.on_device else array


def _built(node: Any, arrays: list[np.ndarray | jax.Array]) -> Any:
    """The part of a tree that this describes."""
    if isinstance(node, dict):
        return {key: _built(part, arrays) for key, part in node.items()}
    if not isinstance(node, list):
        return node
    kind, *parts = node
    if kind == ARRAY:
        return arrays[parts[0]]
    if kind == SCALAR:
        return arrays[parts[0]][()]
    if kind == TUPLE:
        return tuple(_built(part, arrays) for part in parts)
    return KINDS[kind](*(_built(part, arrays) for part in parts))


def _wrong(path: Path) -> str:
    """What a file is that cannot be read as one of ours."""
    with path.open("rb") as file:
        return "is damaged or cut short" if file.read(2) == b"PK" else "is no file of mipsjax"
