"""Who may import whom, read from the source with `ast`; nothing is run."""

from __future__ import annotations

import ast
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import mipsjax

ROOT = Path(mipsjax.__file__).parent

# From the left; a module imports only from rooms before its own, and from its own room.
LAYERS: tuple[frozenset[str], ...] = (
    frozenset({"errors"}),
    frozenset({"files", "config"}),
    frozenset({"core"}),
    frozenset({"data", "images", "uncertainty"}),
    frozenset({"loops"}),
    frozenset({"submaps"}),
    frozenset({"slam", "mesh"}),
    frozenset({"metrics", "viewer"}),
    frozenset({"app"}),
    frozenset({"run", "evaluate", "view"}),
)
LEVEL = {part: level for level, layer in enumerate(LAYERS) for part in layer}

# Packages of the host side, kept out of the functional core
HOST_ONLY = {"gtsam", "cv2", "trimesh", "skimage", "matplotlib", "tyro", "tqdm", "viser"}


def name_of(file: Path) -> str:
    """`core.field` for core/field.py; the package's own name for its `__init__`; "" for mipsjax itself."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = {name_of(file): ast.parse(file.read_text(), str(file)) for file in sorted(ROOT.rglob("*.py"))}


def part_of(module: str) -> str:
    """`core` for `core.field`, `slam` for `slam`."""
    return module.split(".")[0]


def imported(tree: ast.AST) -> set[str]:
    """Absolute names of everything imported anywhere in a file, `from a import b` as a.b."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative imports are not used"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def modules_of_ours(tree: ast.AST) -> set[str]:
    """Modules of this package that a file imports, named without the package."""
    found = set()
    for name in imported(tree):
        if name.split(".")[0] != "mipsjax":
            continue
        inside = name.removeprefix("mipsjax").removeprefix(".")
        while inside and inside not in SOURCES:
            inside = inside.rpartition(".")[0]
        if inside:
            found.add(inside)
    return found


MODULES = [m for m in SOURCES if m]


def test_layers_are_those_of_the_package():
    assert LEVEL.keys() == {part_of(module) for module in MODULES}


@pytest.mark.parametrize("module", MODULES)
def test_imports_come_from_the_left(module):
    part = part_of(module)
    for other in modules_of_ours(SOURCES[module]):
        source = part_of(other)
        left = source in LEVEL and LEVEL[source] < LEVEL[part]
        allowed = source == part or left
        assert allowed, f"{module} imports {other}"


def test_no_module_imports_itself_in_a_circle():
    # A package's __init__ gathers names of its modules, which may use each other: only files count
    graph = {m: {o for o in modules_of_ours(SOURCES[m]) if o != m} for m in MODULES}
    tuple(TopologicalSorter(graph).static_order())  # raises CycleError


@pytest.mark.parametrize("module", [m for m in MODULES if part_of(m) in ("core", "config", "errors")])
def test_the_core_knows_no_host_package(module):
    assert not {name.split(".")[0] for name in imported(SOURCES[module])} & HOST_ONLY


@pytest.mark.parametrize("module", [m for m in MODULES if part_of(m) == "core"])
def test_the_core_reads_no_files_and_no_clock(module):
    outside = {"os", "io", "pathlib", "time", "datetime", "random", "logging", "threading"}
    assert not {name.split(".")[0] for name in imported(SOURCES[module])} & outside


def test_only_the_pose_graph_imports_gtsam():
    users = {m for m in SOURCES if "gtsam" in {name.split(".")[0] for name in imported(SOURCES[m])}}
    assert users <= {"loops.posegraph"}


@pytest.mark.parametrize("module", [m for m in MODULES if part_of(m) == "data"])
def test_readers_use_only_the_camera_of_the_core(module):
    assert {m for m in modules_of_ours(SOURCES[module]) if part_of(m) == "core"} <= {"core", "core.camera"}


def test_config_and_errors_use_the_standard_library_alone():
    for module in [m for m in MODULES if part_of(m) in ("config", "errors", "files")]:
        packages = {name.split(".")[0] for name in imported(SOURCES[module])} - {"mipsjax"}
        assert packages <= sys.stdlib_module_names, module


def test_compiled_code_does_not_know_the_seed():
    """Configurations that differ in it are equal, so that the first one compiled would serve the other."""
    for module, tree in SOURCES.items():
        if part_of(module) == "core":
            read = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
            assert "seed" not in read, f"core takes keys, {module} reads a seed"
