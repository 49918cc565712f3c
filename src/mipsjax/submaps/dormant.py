"""What a submap keeps of its optimizer while the camera is elsewhere: Adam's averages in a third of the bytes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Shaped, UInt8

from mipsjax.core.mapping import Learned

BFLOAT16 = np.dtype(jnp.bfloat16)


@partial(jax.tree_util.register_dataclass, data_fields=("taken", "values"), meta_fields=("shape",))
@dataclass(frozen=True)
class Packed:
    """An array in bfloat16 without its zeros: what no sample has reached, as most of a hash grid's coarse levels."""

    taken: UInt8[np.ndarray, " B"]
    """A bit an entry: whether it is among the values."""
    values: Shaped[np.ndarray, " V"]
    """Of type bfloat16."""
    shape: tuple[int, ...]
    """Of the whole array."""


def packed(learned: Learned) -> Learned:
    """What was learned, with Adam's averages packed; what is packed already is given back as it is."""
    return learned._replace(optimizer=jax.tree.map(_pack, learned.optimizer, is_leaf=_is_packed))


def unpacked(learned: Learned) -> Learned:
    """What was learned, with these as arrays of single precision again; what is not packed is given back as it is."""
    return learned._replace(optimizer=jax.tree.map(_unpack, learned.optimizer, is_leaf=_is_packed))


def rests(learned: Learned) -> bool:
    """Whether any of it is packed."""
    return any(_is_packed(leaf) for leaf in jax.tree.leaves(learned.optimizer, is_leaf=_is_packed))


# On the host, where nothing is compiled for it


def _pack(leaf: Any) -> Any:
    if _is_packed(leaf) or leaf.dtype != np.float32:
        return leaf
    bits = np.asarray(leaf).astype(BFLOAT16).view(np.uint16).ravel()
    taken = bits != 0  # -0 has its sign, and is kept
    return Packed(np.packbits(taken), bits[taken].view(BFLOAT16), leaf.shape)


def _unpack(leaf: Any) -> Float32[np.ndarray, "..."] | Any:
    if not _is_packed(leaf):
        return leaf
    whole = np.zeros(leaf.shape, np.float32)
    whole.ravel()[np.unpackbits(leaf.taken, count=whole.size).view(bool)] = leaf.values.astype(np.float32)
    return whole


def _is_packed(leaf: Any) -> bool:
    return isinstance(leaf, Packed)
