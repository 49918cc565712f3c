"""Sequences damaged by chance, the same for the same seed: files cut, flipped, renamed, exchanged, numbers replaced."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from running import image, read, write

Random = np.random.Generator

MOST = 4
"""Mutations of one sequence."""
NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")
ODD_NUMBERS = (b"nan", b"inf", b"-1", b"0", b"1e308", b"1e-308", b"x", b"", b"9" * 40, b"-7.5", b"1e9")
TEXTS = (".txt", ".json")


def as_folder(tum: Path, target: Path) -> Path:
    """The same sequence in our own layout."""
    content = json.loads((tum / "camera.json").read_text()) | {"depth_scale": 5000.0, "fps": 30.0}
    for kind, name in (("rgb", "color"), ("depth", "depth")):
        (target / name).mkdir(parents=True)
        for number in range(_count(tum)):
            shutil.copy(image(tum, kind, number), target / name / f"{number:06d}.png")
    (target / "camera.json").write_text(json.dumps(content))
    np.savetxt(target / "poses.txt", np.tile(np.eye(4).ravel(), (_count(tum), 1)))
    return target


def as_sevenscenes(tum: Path, target: Path) -> Path:
    """The same sequence in the layout of 7-Scenes, with depth in millimetres."""
    target.mkdir()
    for number in range(_count(tum)):
        stem = target / f"frame-{number:06d}"
        shutil.copy(image(tum, "rgb", number), f"{stem}.color.png")
        write(Path(f"{stem}.depth.png"), (read(image(tum, "depth", number)) // 5).astype(np.uint16))
        np.savetxt(f"{stem}.pose.txt", np.eye(4))
    shutil.copy(tum / "camera.json", target / "camera.json")
    return target


def as_tum(tum: Path, target: Path) -> Path:
    """A copy."""
    return shutil.copytree(tum, target)


LAYOUTS: dict[str, Callable[[Path, Path], Path]] = {
    "tum": as_tum,
    "folder": as_folder,
    "sevenscenes": as_sevenscenes,
}


def mutated(folder: Path, seed: int) -> list[str]:
    """Damages a sequence in place, and says how."""
    rng = np.random.default_rng(seed)
    said = []
    for _ in range(rng.integers(1, MOST + 1)):
        files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
        if not files:
            break
        # As often one of the few texts as one of the many images
        texts = [path for path in files if path.suffix in TEXTS]
        path = _one_of(rng, texts if texts and rng.random() < 0.4 else files)
        kinds = ANY + (OF_TEXTS if path.suffix in TEXTS else OF_IMAGES)
        mutate = _one_of(rng, kinds)
        mutate(path, files, rng)
        said.append(f"{mutate.__name__} {path.relative_to(folder)}")
    return said


def truncate(path: Path, files: list[Path], rng: Random) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: rng.integers(0, len(data) + 1)])


def flip(path: Path, files: list[Path], rng: Random) -> None:
    data = bytearray(path.read_bytes())
    for _ in range(rng.integers(1, 9) if data else 0):
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    path.write_bytes(bytes(data))


def zero(path: Path, files: list[Path], rng: Random) -> None:
    data = bytearray(path.read_bytes())
    start = rng.integers(0, len(data) + 1)
    end = rng.integers(start, len(data) + 1)
    data[start:end] = bytes(end - start)
    path.write_bytes(bytes(data))


def append(path: Path, files: list[Path], rng: Random) -> None:
    path.write_bytes(path.read_bytes() + rng.bytes(rng.integers(1, 200)))


def delete(path: Path, files: list[Path], rng: Random) -> None:
    path.unlink()


def rename(path: Path, files: list[Path], rng: Random) -> None:
    name = _one_of(rng, ("x" + path.name, path.name + ".bak", path.stem, "ü " + path.name, "." + path.name))
    if not path.with_name(name).exists():
        path.rename(path.with_name(name))


def duplicate(path: Path, files: list[Path], rng: Random) -> None:
    shutil.copy(path, path.with_name("0" + path.name))


def replace(path: Path, files: list[Path], rng: Random) -> None:
    other = _one_of(rng, files)
    if other != path:
        shutil.copy(other, path)


def exchange(path: Path, files: list[Path], rng: Random) -> None:
    other = _one_of(rng, files)
    here, there = path.read_bytes(), other.read_bytes()
    path.write_bytes(there)
    other.write_bytes(here)


def to_folder(path: Path, files: list[Path], rng: Random) -> None:
    path.unlink()
    path.mkdir()


def to_circle(path: Path, files: list[Path], rng: Random) -> None:
    """A link to itself."""
    path.unlink()
    path.symlink_to(path)


def to_pipe(path: Path, files: list[Path], rng: Random) -> None:
    """Which nobody writes into."""
    path.unlink()
    os.mkfifo(path)


def odd_number(path: Path, files: list[Path], rng: Random) -> None:
    data = path.read_bytes()
    found = list(NUMBER.finditer(data))
    if found:
        one = _one_of(rng, found)
        path.write_bytes(data[: one.start()] + _one_of(rng, ODD_NUMBERS) + data[one.end() :])


def shuffle_lines(path: Path, files: list[Path], rng: Random) -> None:
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(lines[i] for i in rng.permutation(len(lines))))


def repeat_line(path: Path, files: list[Path], rng: Random) -> None:
    lines = path.read_bytes().splitlines(keepends=True)
    if lines:
        place = int(rng.integers(len(lines)))
        path.write_bytes(b"".join([*lines[:place], lines[place], *lines[place:]]))


def drop_lines(path: Path, files: list[Path], rng: Random) -> None:
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(line for line in lines if rng.random() < 0.7))


def other_size(path: Path, files: list[Path], rng: Random) -> None:
    pixels = _pixels(path)
    if pixels is not None:
        write(path, cv2.resize(pixels, tuple(int(side) for side in rng.integers(1, 200, 2))))


def other_type(path: Path, files: list[Path], rng: Random) -> None:
    pixels = _pixels(path)
    if pixels is not None:
        write(path, pixels.astype(np.uint8 if pixels.dtype == np.uint16 else np.uint16))


def one_value(path: Path, files: list[Path], rng: Random) -> None:
    pixels = _pixels(path)
    if pixels is not None:
        write(path, np.full_like(pixels, _one_of(rng, (0, 1, np.iinfo(pixels.dtype).max))))


def noise(path: Path, files: list[Path], rng: Random) -> None:
    pixels = _pixels(path)
    if pixels is not None:
        write(path, rng.integers(0, np.iinfo(pixels.dtype).max, pixels.shape, pixels.dtype, endpoint=True))


Mutation = Callable[[Path, list[Path], Random], None]

ANY: tuple[Mutation, ...] = (
    *(truncate, flip, zero, append, delete, rename),
    *(duplicate, replace, exchange, to_folder, to_circle, to_pipe),
)
OF_TEXTS: tuple[Mutation, ...] = (odd_number, odd_number, odd_number, shuffle_lines, repeat_line, drop_lines)
OF_IMAGES: tuple[Mutation, ...] = (other_size, other_type, one_value, noise)


def _one_of(rng: Random, choices):
    return choices[int(rng.integers(len(choices)))]


def _pixels(path: Path) -> np.ndarray | None:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.suffix == ".png" else None


def _count(tum: Path) -> int:
    return len(list((tum / "rgb").iterdir()))
