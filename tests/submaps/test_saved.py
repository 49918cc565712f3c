"""Saved and loaded: the same bits, each array once, and whatever is not whole is refused with one line."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import mipsjax
from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import InputConfig
from mipsjax.config.submaps import BackgroundConfig
from mipsjax.data.sequence import Frame
from mipsjax.data.synth import open_synth
from mipsjax.errors import InputError, OutputError
from mipsjax.slam import step as slam
from mipsjax.submaps import saved
from mipsjax.submaps.dormant import packed
from mipsjax.submaps.records import Records
from mipsjax.submaps.schedule import executor
from mipsjax.submaps.state import SlamState

CFG = replace(PRESETS["tiny"], background=BackgroundConfig(every_frames=2, steps=2))
FRAMES = 6
FLIPS = 100
"""Bits of a file that are flipped, each in a file of its own."""


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    sequence = open_synth("tiny", slice(FRAMES), InputConfig())
    return [sequence[position] for position in range(FRAMES)]


@pytest.fixture(scope="module")
def state(frames: list[Frame]) -> SlamState:
    """After all frames but two, with a second submap of the same keyframes, and its refinement under way."""
    state, _ = slam.start(frames[0], open_synth("tiny", slice(1), InputConfig()).intrinsics, CFG)
    beside = state.submap._replace(learned=packed(state.submap.learned), parent=0)
    state = state._replace(submaps=(*state.submaps, beside))
    for frame in frames[1:-2]:
        state, _ = slam.step(state, frame, CFG)
    assert state.refinement is not None and state.refinement.places == (1,)
    return state


@pytest.fixture
def file(state: SlamState, tmp_path: Path) -> Path:
    mipsjax.save(state, tmp_path / "state.npz")
    return tmp_path / "state.npz"


def assert_same(one: Any, other: Any) -> None:
    """The same types, structure and bits, and arrays on the same side."""
    (leaves, tree), (others, other_tree) = jax.tree.flatten(one), jax.tree.flatten(other)
    assert tree == other_tree
    for a, b in zip(leaves, others, strict=True):
        assert type(a) is type(b)
        a, b = np.asarray(a), np.asarray(b)
        assert (a.dtype, a.shape, a.flags.fnc) == (b.dtype, b.shape, b.flags.fnc)
        assert a.tobytes() == b.tobytes()


def test_a_loaded_state_is_the_same(state: SlamState, file: Path) -> None:
    loaded = mipsjax.load(file)
    assert_same(loaded, state)
    weak = [leaf for leaf in jax.tree.leaves(state) if isinstance(leaf, jax.Array) and leaf.weak_type]
    assert not weak, "they would come back as another type to compiled code"


@pytest.mark.parametrize("kind", ["inline", "thread"])
def test_one_more_step_gives_the_same_bits(
    state: SlamState, file: Path, frames: list[Frame], kind: Any
) -> None:
    """The refinement under way is taken over in the second step; a thread that never began it does it then."""
    whole, resumed = state, mipsjax.load(file)
    with executor(kind) as beside:
        for frame in frames[-2:]:
            whole, _ = slam.step(whole, frame, CFG)
            resumed, _ = slam.step(resumed, frame, CFG, beside)
    assert whole.refinement is not None and whole.refinement.number > state.refinement.number  # pyright: ignore
    assert_same(resumed, whole)


def test_the_same_state_gives_the_same_bytes(state: SlamState, file: Path, tmp_path: Path) -> None:
    mipsjax.save(mipsjax.load(file), str(tmp_path / "again.npz"))
    assert (tmp_path / "again.npz").read_bytes() == file.read_bytes()


def test_an_array_in_several_places_is_stored_once(state: SlamState, file: Path) -> None:
    loaded = mipsjax.load(file)
    first, second = (submap.keyframes[0] for submap in loaded.submaps)
    assert first.color is second.color and first.depth is second.depth
    assert loaded.refinement is not None
    assert loaded.refinement.submaps[0].keyframes[0].color is first.color
    arrays = {id(leaf): leaf.nbytes for leaf in jax.tree.leaves(state) if hasattr(leaf, "nbytes")}
    assert file.stat().st_size < 1.2 * sum(arrays.values()) + 50_000, "what is not arrays is small"


def test_it_is_an_npz_without_pickle(file: Path) -> None:
    with np.load(file, allow_pickle=False) as members:
        assert {"manifest", "float32", "float64", "uint8"} <= set(members)
        assert all(members[name].ndim == 1 for name in members)


def test_every_kind_that_a_state_names_can_be_saved() -> None:
    """Each class of the package in the annotations of what can be saved."""
    for kind in saved.TUPLES:
        module = sys.modules[kind.__module__]
        for annotation in map(str, vars(kind).get("__annotations__", {}).values()):
            named = (getattr(module, word, None) for word in re.findall(r"\w+", annotation))
            classes = [
                one for one in named if isinstance(one, type) and one.__module__.startswith("mipsjax.")
            ]
            assert set(classes) <= set(saved.KINDS.values()), kind.__name__


def test_what_cannot_be_saved_is_named(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="Frame cannot be saved"):
        saved.packed(Frame(0, 0.0, None, None), "state", {})
    with pytest.raises(OutputError, match="cannot write"):
        saved.save(SlamState((), 0, Records(), None, 0), tmp_path / "none" / "state.npz")  # pyright: ignore


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


@pytest.mark.fault(44)
def test_a_flipped_bit_is_found_or_changes_nothing(state: SlamState, file: Path, tmp_path: Path) -> None:
    """Where it changes nothing it is in what zip keeps beside, as a date. Half of them are in its tables at the end."""
    data, rng = file.read_bytes(), np.random.default_rng(0)
    bits = 8 * len(data)
    chosen = [*rng.integers(bits, size=FLIPS // 2), *rng.integers(bits - 8 * 600, bits, size=FLIPS // 2)]
    refused = 0
    for bit in map(int, chosen):
        path = tmp_path / "flipped.npz"
        path.write_bytes(flipped(data, bit))
        try:
            loaded = mipsjax.load(path)
        except InputError as error:
            refused += 1
            assert "\n" not in str(error) and str(path) in str(error)
        else:
            assert_same(loaded, state)
    assert refused > FLIPS // 2, "all of those in arrays"


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.999])
@pytest.mark.fault(44)
def test_a_truncated_file_is_refused(file: Path, share: float) -> None:
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match="damaged or cut short" if share else "no file of mipsjax"):
        mipsjax.load(file)


def test_what_is_no_state_is_refused(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = tmp_path / "other.npz"
    np.savez(other, poses=np.eye(4))
    text = tmp_path / "notes.txt"
    text.write_text("no state")
    for path, message in (
        (other, "no file of mipsjax"),
        (text, "no file of mipsjax"),
        (tmp_path / "none.npz", "No such file"),
        (tmp_path, "directory"),
    ):
        with pytest.raises(InputError, match=message):
            mipsjax.load(path)
    with pytest.raises(InputError, match="is a state and no checkpoint"):
        saved.unpacked(file, "checkpoint")
    monkeypatch.setattr(saved, "FORMAT", saved.FORMAT + 1)
    message = f"has version {saved.FORMAT - 1} of the format.*reads version {saved.FORMAT}"
    with pytest.raises(InputError, match=message):
        mipsjax.load(file)
