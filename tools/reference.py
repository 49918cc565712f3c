"""docs/reference.md from docstrings: every public name of the package, and the stages of the core.

    python tools/reference.py          # writes it
    python tools/reference.py --check  # exits with 1 where it is not up to date

The source is read with `ast`; nothing is imported, so that the page does not depend on the versions of other packages.
"""

from __future__ import annotations

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "mipsjax"
PAGE = ROOT / "docs" / "reference.md"

HEAD = """# Reference

Every public name of `mipsjax`, with the docstring of its source. Made by `python tools/reference.py`.
Shapes are those of [jaxtyping](https://docs.kidger.site/jaxtyping/): `Float[Array, "N 3"]` is an N x 3 array.
Units are metres, seconds and radians; see [conventions](development.md#conventions).
"""


def public_names() -> dict[str, tuple[str, str]]:
    """Module and attribute of each public name, as `mipsjax/__init__.py` has them."""
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "_PLACES":
            places: dict[str, str] = ast.literal_eval(node.value)
            return {name: (place.split(":")[0], place.split(":")[1]) for name, place in places.items()}
    raise SystemExit("mipsjax/__init__.py has no _PLACES")


def definition(module: str, name: str) -> ast.stmt:
    """The statement of a module that defines a name."""
    file = PACKAGE.joinpath(*module.split(".")).with_suffix(".py")
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return node
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            return node
    raise SystemExit(f"{file} does not define {name}")


def fields(node: ast.ClassDef) -> list[str]:
    """A line for each field of a class, with the docstring under it where there is one."""
    lines: list[str] = []
    for position, item in enumerate(node.body):
        if not isinstance(item, ast.AnnAssign):
            continue
        after = node.body[position + 1 :]
        text = _text_of(after[0]) if after else ""
        lines.append(f"- `{ast.unparse(item)}`" + (f": {' '.join(text.split())}" if text else ""))
    return lines


def _text_of(node: ast.stmt) -> str:
    if (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    ):
        return node.value.value
    return ""


def signature(node: ast.FunctionDef, name: str) -> str:
    """The head of a function, one argument a line."""
    arguments = ast.unparse(node.args)
    result = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"{name}({arguments}){result}"


def section(name: str, module: str, attribute: str) -> str:
    """The part of the page on one name."""
    node = definition(module, attribute)
    place = f"`{module.replace('.', '/')}.py`"
    parts = [f"## {name}", f"In {place}."]
    if isinstance(node, ast.FunctionDef):
        parts += ["```text\n" + signature(node, name) + "\n```", ast.get_docstring(node) or ""]
    elif isinstance(node, ast.ClassDef):
        parts += [ast.get_docstring(node) or "", "\n".join(fields(node))]
    else:
        parts.append("```text\n" + ast.unparse(node) + "\n```")
    return "\n\n".join(part for part in parts if part)


def page() -> str:
    names = public_names()
    sections = [section(name, *names[name]) for name in sorted(names, key=str.lower)]
    return "\n\n".join([HEAD.rstrip(), *sections]) + "\n"


def main(arguments: list[str]) -> int:
    if "--check" in arguments:
        return int(PAGE.read_text() != page())
    PAGE.write_text(page())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
