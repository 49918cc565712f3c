"""A long list as a value: one more entry costs the same however many there are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import TypeVar, overload

import jax

BLOCK = 256
"""Entries of a block: so many references at most are copied for one more entry."""
Entry = TypeVar("Entry")


@partial(jax.tree_util.register_dataclass, data_fields=("full", "open"), meta_fields=())
@dataclass(frozen=True, eq=False)
class Records(Sequence[Entry]):
    """Entries in order, in blocks that are shared with the lists that this one was made from."""

    full: tuple[tuple[Entry, ...], ...] = ()
    """Blocks of `BLOCK` entries each."""
    open: tuple[Entry, ...] = ()
    """The last entries, fewer than fill a block."""

    @classmethod
    def of(cls, entries: Iterable[Entry]) -> Records[Entry]:
        """From all of its entries."""
        entries = tuple(entries)
        whole = len(entries) - len(entries) % BLOCK
        blocks = tuple(entries[begin : begin + BLOCK] for begin in range(0, whole, BLOCK))
        return cls(blocks, entries[whole:])

    def appended(self, entry: Entry) -> Records[Entry]:
        """With one more at the end."""
        longer = (*self.open, entry)
        return Records((*self.full, longer)) if len(longer) == BLOCK else Records(self.full, longer)

    def with_last(self, entry: Entry) -> Records[Entry]:
        """With the last one replaced. Raises IndexError where there is none."""
        if self.open:
            return Records(self.full, (*self.open[:-1], entry))
        return Records((*self.full[:-1], (*self.full[-1][:-1], entry)))

    def __len__(self) -> int:
        return BLOCK * len(self.full) + len(self.open)

    @overload
    def __getitem__(self, place: int) -> Entry: ...

    @overload
    def __getitem__(self, place: slice) -> tuple[Entry, ...]: ...

    def __getitem__(self, place: int | slice) -> Entry | tuple[Entry, ...]:
        # A range knows what negative places and slices mean, and when to raise IndexError
        places = range(len(self))[place]
        if isinstance(places, int):
            return self._at(places)
        return tuple(self._at(one) for one in places)

    def __iter__(self) -> Iterator[Entry]:
        return chain.from_iterable((*self.full, self.open))

    def __reversed__(self) -> Iterator[Entry]:
        yield from reversed(self.open)
        for block in reversed(self.full):
            yield from reversed(block)

    def _at(self, place: int) -> Entry:
        block, within = divmod(place, BLOCK)
        return self.full[block][within] if block < len(self.full) else self.open[within]
