"""Writes constraints.txt: the versions in an environment of the oldest Python and in one of the newest, both tested.

python .ci/constraints.py OLD/bin/python NEW/bin/python > constraints.txt
"""

from __future__ import annotations

import json
import subprocess
import sys

BORDER = "3.12"
"""Several packages leave out Python 3.11 in their newest versions, so that from here on pip resolves others."""

NOT_OURS = {"mipsjax", "pip", "setuptools", "wheel"}


def installed(python: str) -> dict[str, str]:
    """Version of each package in an environment, by its normalised name."""
    listed = subprocess.run(
        [python, "-m", "pip", "list", "--format", "json"], capture_output=True, text=True, check=True
    )
    names = {row["name"].lower().replace("_", "-"): row["version"] for row in json.loads(listed.stdout)}
    return {name: version for name, version in names.items() if name not in NOT_OURS}


def lines(old: dict[str, str], new: dict[str, str]) -> list[str]:
    """One line for a package of the same version in both, else one for each environment that has it."""
    found = []
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) == new.get(name):
            found.append(f"{name}=={old[name]}")
            continue
        if name in old:
            found.append(f'{name}=={old[name]}; python_version < "{BORDER}"')
        if name in new:
            found.append(f'{name}=={new[name]}; python_version >= "{BORDER}"')
    return found


def main(old_python: str, new_python: str) -> None:
    print("# Versions that were tested together (Linux, x86-64), test extra included:")
    print('#     pip install -e ".[test]" -c constraints.txt')
    print("# Written by .ci/constraints.py from environments of the oldest and of the newest Python.")
    print("\n".join(lines(installed(old_python), installed(new_python))))


if __name__ == "__main__":
    main(*sys.argv[1:])
