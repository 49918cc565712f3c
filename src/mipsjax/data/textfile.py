"""Text files of numbers: comments and blank lines dropped, errors that name the file and the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mipsjax.errors import InputError


def read_text(path: Path) -> str:
    """The whole file as text; bytes that are not UTF-8 are replaced. Raises InputError if unreadable."""
    try:
        return path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def content_lines(path: Path) -> list[tuple[int, str]]:
    """Lines with content, each with its number counted from 1; what follows a `#` is a comment."""
    lines = enumerate(read_text(path).split("\n"), start=1)
    stripped = ((number, line.split("#", 1)[0].strip()) for number, line in lines)
    return [(number, line) for number, line in stripped if line]


def parse_number(text: str, path: Path, line_number: int) -> float:
    """One number; `nan` and `inf` are numbers. Raises InputError with file and line."""
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{path}, line {line_number}: {text[:40]!r} is not a number") from error


def parse_numbers(line: str, count: int, path: Path, line_number: int) -> list[float]:
    """Exactly `count` numbers separated by blanks or commas. Raises InputError with file and line."""
    words = line.replace(",", " ").split()
    if len(words) != count:
        raise InputError(f"{path}, line {line_number}: {count} numbers expected, {len(words)} found")
    return [parse_number(word, path, line_number) for word in words]


def read_number_rows(path: Path, count: int) -> Float64[np.ndarray, "N C"]:
    """All rows of a file of `count` numbers a row. Raises InputError on any other row."""
    rows = [parse_numbers(line, count, path, number) for number, line in content_lines(path)]
    return np.array(rows, dtype=np.float64).reshape(len(rows), count)


def read_number_block(path: Path, rows: int, columns: int) -> Float64[np.ndarray, "R C"]:
    """One matrix written over any number of lines. Raises InputError unless the count of numbers fits."""
    words = [
        (number, word) for number, line in content_lines(path) for word in line.replace(",", " ").split()
    ]
    if len(words) != rows * columns:
        raise InputError(f"{path}: {rows * columns} numbers expected, {len(words)} found")
    return np.array([parse_number(word, path, number) for number, word in words]).reshape(rows, columns)
