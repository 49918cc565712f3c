"""How dense the code is: syntax nodes of a line, and comments among a hundred lines, of `src` and of each room.

    python tools/density.py

A line of a body is one inside of a function that is neither blank nor of its docstring; what counts is how many nodes
of the syntax tree begin on it. Lines on which none begins, as of a closing bracket, are left out. A comment is one
wherever it stands, at the end of a line, too. Blank lines are no lines.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path
from statistics import median
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent / "src" / "mipsjax"


class Density(NamedTuple):
    """What is counted, of one file or of many."""

    nodes: tuple[int, ...]
    """Of each line of a body."""
    comments: int
    lines: int

    @property
    def nodes_a_line(self) -> float:
        """The median."""
        return median(self.nodes) if self.nodes else 0.0

    @property
    def comments_in_100(self) -> float:
        """Lines with a comment in a hundred."""
        return 100 * self.comments / max(self.lines, 1)


def density(source: str) -> Density:
    """Of one file."""
    lines = source.splitlines()
    written = {number for number, line in enumerate(lines, 1) if line.strip()}
    tree = ast.parse(source)
    begun = Counter(node.lineno for node in ast.walk(tree) if hasattr(node, "lineno"))
    bodies = _body_lines(tree) & begun.keys()
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {token.start[0] for token in tokens if token.type == tokenize.COMMENT}
    return Density(tuple(begun[number] for number in sorted(bodies)), len(comments), len(written))


def _body_lines(tree: ast.Module) -> set[int]:
    """Lines of the statements of functions, without their docstrings."""
    found = set()
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            documented = ast.get_docstring(function, clean=False) is not None
            for statement in function.body[documented:]:
                assert statement.end_lineno is not None
                found |= set(range(statement.lineno, statement.end_lineno + 1))
    # A function within another has its docstring among the lines of the outer one
    for function in ast.walk(tree):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef) and ast.get_docstring(function):
            first = function.body[0]
            assert first.end_lineno is not None
            found -= set(range(first.lineno, first.end_lineno + 1))
    return found


def together(parts: list[Density]) -> Density:
    """Of several files as of one."""
    nodes = tuple(count for part in parts for count in part.nodes)
    return Density(nodes, sum(part.comments for part in parts), sum(part.lines for part in parts))


def by_room() -> dict[str, Density]:
    """Of each room, by its name, and of all as "src"."""
    rooms: dict[str, list[Density]] = {}
    for file in sorted(ROOT.rglob("*.py")):
        room = file.relative_to(ROOT).parts[0].removesuffix(".py")
        rooms.setdefault(room, []).append(density(file.read_text(encoding="utf-8")))
    found = {room: together(parts) for room, parts in rooms.items()}
    return {"src": together(list(found.values())), **found}


def main() -> None:
    print(f"{'room':12} {'nodes a line':>12} {'comments in 100 lines':>22}")
    for room, found in by_room().items():
        print(f"{room:12} {found.nodes_a_line:12.1f} {found.comments_in_100:22.1f}")


if __name__ == "__main__":
    main()
