"""The encodings, and which of them the distance fields of a submap have.

A new one is a file with an `Encoding`, an entry of `ENCODINGS`, and its name in `config.sections.Encoding`.
"""

from __future__ import annotations

from typing import NamedTuple

from mipsjax.config.sections import FieldConfig
from mipsjax.core.encodings.encoding import Encoding
from mipsjax.core.encodings.hashgrid import HASH_GRID
from mipsjax.core.encodings.joint import JOINT
from mipsjax.core.encodings.sinusoids import SINUSOIDS

__all__ = ["ENCODINGS", "Encoding", "Fields", "fields"]


class Fields(NamedTuple):
    """The distance fields that a submap has, each by what it reads; at least one of the two."""

    smooth: Encoding | None
    """Of the one on which poses are searched for; its basin is wide."""
    fine: Encoding | None
    """Of the accurate one; None where the smooth one is all that there is."""

    @property
    def two(self) -> bool:
        """They are learned side by side: one for the search, one for the last steps."""
        return self.smooth is not None and self.fine is not None

    @property
    def finest(self) -> Encoding:
        """Of the most accurate field, which the colour reads, too."""
        finest = self.fine or self.smooth
        assert finest is not None
        return finest


ENCODINGS = {
    "frequency": Fields(smooth=SINUSOIDS, fine=None),
    "hash": Fields(smooth=None, fine=HASH_GRID),
    "joint": Fields(smooth=None, fine=JOINT),
    "both": Fields(smooth=SINUSOIDS, fine=HASH_GRID),
}
"""By `field.encoding`."""


def fields(cfg: FieldConfig) -> Fields:
    """Those of a configuration."""
    return ENCODINGS[cfg.encoding]
