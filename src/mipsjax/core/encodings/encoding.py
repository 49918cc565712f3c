"""What an encoding is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float, PRNGKeyArray

from mipsjax.config.sections import FieldConfig

Parameters = Any
"""What an encoding learns: a pytree of arrays, None where it learns nothing."""


class Encoding(NamedTuple):
    """Functions that make of a point what a network reads.

    Small networks learn smooth functions of what they read: an encoding decides which detail they can show.
    """

    width: Callable[[FieldConfig], int]
    """Numbers a point."""
    init: Callable[[PRNGKeyArray, FieldConfig], Parameters]
    """Fresh parameters."""
    apply: Callable[[Parameters, Float[Array, "N 3"], FieldConfig], Float[Array, "N E"]]
    """Points in the submap's frame, metres, to what the network reads."""
