"""docs/faults.md: what may go wrong with a recording, a machine or a run, what happens then, and tests that show it.

    python tools/faults.py          # writes it
    python tools/faults.py --check  # exits with 1 where it is not up to date, or a case has no test

A test names its cases by `@pytest.mark.fault(5, 6)`. The tests are read with `ast`; nothing is imported.
"""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS = ROOT / "tests"
PAGE = ROOT / "docs" / "faults.md"

HEAD = """# What if

What may go wrong with a recording, a machine or a run, what happens then, and the tests that show it. Exit codes are
those of the [README](../README.md). Made by `python tools/faults.py`.

| | fault | what happens | shown by |
|---|---|---|---|
"""

CASES = {
    1: ("the folder is missing, or a file", "exit code 3; path and nearest folder that exists"),
    2: ("an empty folder, an unknown layout", "exit code 3; layouts looked for, the first ten names"),
    3: ("two layouts match", "exit code 3; both are named, `--layout` decides"),
    4: ("a colour image is missing", "the frame is tracked by depth alone and counted"),
    5: ("a depth image is missing", "the pose is predicted by the true interval, the frame is not mapped"),
    6: ("a PNG of no bytes", "the frame is skipped and counted"),
    7: ("a PNG that is cut", "the same"),
    8: ("a PNG with a flipped bit", "the same"),
    9: ("a JPEG that is cut, of which decoders make grey", "colour is dropped, depth is used"),
    10: ("one frame of another size", "skipped, both sizes are said"),
    11: ("all colour images of another size", "resampled with a notice, or exit code 3 where the aspect differs"),
    12: ("depth of 8 bits or of three channels", "exit code 3; says what depth must be, and names the file"),
    13: ("one frame without any depth", "skipped"),
    14: ("no depth in the first frames", "the map begins with the first usable frame"),
    15: ("hardly a pixel with depth", "`weak`, nothing is compiled anew"),
    16: ("NaN, infinity or negative numbers as depth", "no measurement"),
    17: ("depth saturated, or at the end of its range", "no measurement"),
    18: ("a wrong unit of depth", "a remark with the median; exit code 3 outside 0.05 to 50 m"),
    19: ("swapped or wrong intrinsics", "exit code 3, unless declared"),
    20: ("no times", "the number of the frame by its rate, said once"),
    21: ("equal times", "one of them is dropped; no division by zero"),
    22: ("times that go backwards, lists out of order", "sorted, with a remark"),
    23: ("clocks of colour and depth a second apart", "exit code 3; how many pairs, how far the nearest"),
    24: ("a gap of seconds", "the prior goes by the true interval, the search is wider"),
    25: ("names in the order 1, 10, 2", "read as 1, 2, 10"),
    26: ("truth with infinity, NaN or missing rows", "left out of the evaluation and counted"),
    27: ("rows of poses that are hardly rotations, or mirrored", "the nearest rotation, or unknown"),
    28: ("no truth", "no ATE, rather than 0"),
    29: ("a cut to another room", "lost; found again, or a submap that hangs on nothing"),
    30: ("a camera that stands still", "no keyframe and no submap more"),
    31: ("a turn on the spot, a bare wall", "no NaN; the frame is `weak` where nothing holds it"),
    32: ("a camera that is covered for seconds", "skipped or lost, then found in the same map"),
    33: ("somebody walks through the view", "an error of at most twice the one without"),
    34: ("NaN in the map", "found, the last good parameters are restored, said"),
    35: ("particles that are all alike, or NaN", "the pose before is kept"),
    36: ("a solver that fails", "the best finite pose is kept"),
    37: ("false loops, five of twelve", "rejected by the graph"),
    38: ("a graph in parts, or without an anchor", "each part has its own anchor"),
    39: ("a factor that is NaN or without a covariance", "refused, with the names of its submaps"),
    40: ("Ctrl-C, once and twice", "the frame is finished and all is written, exit code 130; at once"),
    41: ("SIGTERM, SIGHUP", "as Ctrl-C"),
    42: ("SIGKILL", "`--resume` goes on to the same bytes"),
    43: ("SIGKILL while a checkpoint is written", "the one before it is used"),
    44: ("a checkpoint that is cut, or with a flipped bit", "the one before it is used, said; else refused"),
    45: ("a checkpoint of another version, configuration or sequence", "refused, with what differs"),
    46: ("results cannot be written", "exit code 5 before the first frame"),
    47: ("the disk is full", "exit code 5, no half files"),
    48: ("results of a finished run are there", "a numbered folder, or refused"),
    49: ("two runs in one folder", "the second one: exit code 5"),
    50: ("too little memory", "`--volume.max-submaps` bounds the map; said"),
    51: ("an unknown option, a value of another type or out of range", "exit code 2, the nearest name or range"),
    52: ("no viewer is installed, or its port is taken", "the run goes on; one line how to install it; the next port"),
    53: ("an empty mesh, cells that are NaN", "an empty PLY and a warning"),
    54: ("one frame; a hundred thousand", "exit code 3; memory and time of a frame stay the same"),
    55: ("the cache of compiled programs cannot be used", "compiled again"),
    56: ("a bag without a topic of depth, or with several", "topics with types and counts; `--depth-topic` decides"),
    57: ("odd paths, links, input that is read-only", "works; nothing is written into the input"),
    58: ("the clock jumps; no terminal", "times are monotonic; plain lines now and then"),
}  # fmt: skip


def tests_by_case() -> dict[int, list[str]]:
    """Of each case the tests that name it, as `file: test`."""
    found: dict[int, list[str]] = defaultdict(list)
    for file in sorted(TESTS.rglob("test_*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                for number in _numbers(node):
                    found[number].append(f"`{file.relative_to(TESTS)}: {node.name}`")
    return found


def _numbers(test: ast.FunctionDef) -> list[int]:
    """The cases that a test is marked with."""
    calls = [mark for mark in test.decorator_list if isinstance(mark, ast.Call)]
    marks = [call for call in calls if ast.unparse(call.func) == "pytest.mark.fault"]
    return [ast.literal_eval(argument) for mark in marks for argument in mark.args]


def without_test() -> list[int]:
    """Cases that no test names."""
    return sorted(set(CASES) - set(tests_by_case()))


def page() -> str:
    """The text of docs/faults.md."""
    shown = tests_by_case()
    if unknown := sorted(set(shown) - set(CASES)):
        raise SystemExit(f"tests name cases that there are not: {unknown}")
    rows = [
        f"| {number} | {fault} | {outcome} | {', '.join(shown[number])} |"
        for number, (fault, outcome) in CASES.items()
    ]
    return HEAD + "\n".join(rows) + "\n"


def main(arguments: list[str]) -> int:
    if "--check" in arguments:
        return int(PAGE.read_text(encoding="utf-8") != page() or bool(without_test()))
    PAGE.write_text(page(), encoding="utf-8")
    if missing := without_test():
        print(f"cases without a test: {', '.join(map(str, missing))}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
