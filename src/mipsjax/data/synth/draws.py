"""Random choices that are the same bits with every version of NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


class Draws:
    """A stream of choices named by whole numbers.

    Only `Generator.random` is used: NumPy may change how it makes other draws out of the same bits.
    """

    def __init__(self, *name: int) -> None:
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(name)))

    def between(self, low: float, high: float) -> float:
        """A number in an interval, in whole hundredths."""
        return round(low + (high - low) * float(self._rng.random()), 2)

    def chance(self, probability: float) -> bool:
        """True with that probability."""
        return float(self._rng.random()) < probability

    def pick(self, options: Sequence[T]) -> T:
        """One of some options."""
        return options[int(float(self._rng.random()) * len(options))]

    def shuffled(self, options: Sequence[T]) -> list[T]:
        """All options in another order."""
        keys = [float(self._rng.random()) for _ in options]
        return [options[row] for row in sorted(range(len(options)), key=keys.__getitem__)]
