"""Warnings: an error in a test where our own code causes one, shown where a package underneath does, none for users."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import pytest

from mipsjax.app.compilation import CACHE_FROM_S

TESTS = Path(__file__).parent
OURS = ["mipsjax", "mipsjax.core.field", *sorted({file.stem for file in TESTS.rglob("*.py")})]

LIBRARY = """
import mipsjax

cfg = mipsjax.preset("tiny")
sequence = mipsjax.open_sequence("synth:tiny", frames=slice(0, 3))
state, _ = mipsjax.start(sequence[0], sequence.intrinsics, cfg)
for position in range(1, len(sequence)):
    state, _ = mipsjax.step(state, sequence[position], cfg)
state = mipsjax.finish(state, cfg)
assert len(mipsjax.trajectory(state)) == 3
assert len(mipsjax.reconstruct_mesh(state, cfg).vertices)
"""


def warn(category: type[Warning], module: str, message: str = "a test") -> None:
    warnings.warn_explicit(message, category, f"{module}.py", 1, module)


@pytest.mark.parametrize("module", OURS)
@pytest.mark.parametrize("category", [UserWarning, DeprecationWarning])
def test_a_warning_of_our_own_is_an_error(category: type[Warning], module: str) -> None:
    with pytest.raises(category):
        warn(category, module)


def test_a_warning_of_another_package_is_shown() -> None:
    with warnings.catch_warnings(record=True) as shown:
        warn(DeprecationWarning, "skimage.measure")
    assert len(shown) == 1


@pytest.mark.parametrize(
    ("category", "message"),
    [
        (RuntimeWarning, "overflow encountered in cast"),
        (UserWarning, "Explicitly requested dtype float64 is not available"),
        (FutureWarning, "scatter inputs have incompatible types: cannot safely cast"),
    ],
)
def test_one_that_means_a_wrong_result_is_an_error_from_anywhere(
    category: type[Warning], message: str
) -> None:
    with pytest.raises(category):
        warn(category, "jax._src.dtypes", message)


def silent(*arguments: str, folder: Path) -> None:
    """Runs Python as a user does, with its own filters, and checks that nothing is said on standard error."""
    # JAX, which the tests import before mipsjax, sets the second for this process
    own = ("PYTHONWARNINGS", "TF_CPP_MIN_LOG_LEVEL")
    environment = {name: value for name, value in os.environ.items() if name not in own}
    cache = jax.config.jax_compilation_cache_dir
    if cache:  # library callers choose one by these, too
        environment["JAX_COMPILATION_CACHE_DIR"] = cache
        environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = str(CACHE_FROM_S)
    done = subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, cwd=folder, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


def test_a_clean_run_of_the_program_prints_no_warning(exported: Path, tmp_path: Path) -> None:
    options = ["--preset", "tiny", "--frames", ":3", "--out", str(tmp_path / "out")]
    silent("-m", "mipsjax.run", str(exported), *options, folder=tmp_path)


def test_a_clean_use_of_the_library_prints_no_warning(tmp_path: Path) -> None:
    silent("-c", LIBRARY, folder=tmp_path)
