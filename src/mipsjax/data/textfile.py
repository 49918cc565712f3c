"""Text files of numbers: comments and blank lines dropped, errors that name the file and the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from mipsjax.errors import InputError
from mipsjax.files import read_regular

LARGEST_TEXT_BYTES = 1 << 28
"""Of a list or a trajectory: millions of rows."""


def read_text(path: Path) -> str:
    """The whole file as text; bytes that are not UTF-8 are replaced. Raises InputError if unreadable."""
    try:
        # `-sig`: editors on Windows begin a file with a mark of its byte order
        text = read_regular(path, LARGEST_TEXT_BYTES).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


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


def read_true_rows(path: Path, count: int) -> tuple[Float64[np.ndarray, "N C"], tuple[str, ...]]:
    """The same of a file of truth, which must not stop a run: a malformed row is one of NaN, and remarked on.

    Without any row where the file cannot be read at all.
    """
    try:
        lines = content_lines(path)
    except InputError as error:
        return np.zeros((0, count)), (f"truth left out: {error}",)
    rows = np.full((len(lines), count), np.nan)
    reasons = []
    for place, (number, line) in enumerate(lines):
        try:
            rows[place] = parse_numbers(line, count, path, number)
        except InputError as error:
            reasons.append(str(error))
    if not reasons:
        return rows, ()
    remark = f"{path.name}: {len(reasons)} of {len(rows)} rows are malformed, left unknown; the first: {reasons[0]}"
    return rows, (remark,)


def read_number_block(path: Path, rows: int, columns: int) -> Float64[np.ndarray, "R C"]:
    """One matrix written over any number of lines. Raises InputError unless the count of numbers fits."""
    words = [
        (number, word) for number, line in content_lines(path) for word in line.replace(",", " ").split()
    ]
    if len(words) != rows * columns:
        raise InputError(f"{path}: {rows * columns} numbers expected, {len(words)} found")
    return np.array([parse_number(word, path, number) for number, word in words]).reshape(rows, columns)
