"""Random draws of the host loop: each purpose has draws of its own, so that one added in one place moves no other."""

from __future__ import annotations

from enum import IntEnum

import jax
import numpy as np

from mipsjax.config.sections import Config

# Compiled, they take a tenth of the time; they are called for each frame
_key, _fold_in = jax.jit(jax.random.key), jax.jit(jax.random.fold_in)


class Purpose(IntEnum):
    """What is drawn."""

    NETWORKS = 0
    """What the networks of a new submap begin with."""
    FIRST_FIT = 1
    """Pixels and samples of its first fit."""
    TRACK = 2
    """Pixels of a frame that is tracked, and where its particles are."""
    MAP = 3
    """Pixels and samples of local bundle adjustment with a frame."""
    MAP_KEYFRAMES = 4
    """The keyframes that take part in it."""
    REVISIT = 5
    """Pixels and samples of the steps on the frame with which a submap takes over again."""
    REVISIT_KEYFRAMES = 6
    """The keyframes that take part in them."""
    BACKGROUND = 7
    """Pixels and samples of the refinement of a submap that the camera is not in."""
    BACKGROUND_KEYFRAMES = 8
    """The keyframes that take part in it."""
    FINISH = 9
    """Pixels and samples of what a submap learns after the last frame."""
    FINISH_KEYFRAMES = 10
    """The keyframes that it learns from."""
    MEND = 11
    """Pixels and samples of what a submap learns anew."""
    MEND_KEYFRAMES = 12
    """The keyframes that it learns from."""
    MATCH = 13
    """Matches from which the motion between two images is computed."""


def key_for(cfg: Config, purpose: Purpose, *numbers: int) -> jax.Array:
    """The key of one purpose at what these numbers name, such as a frame's record or a submap."""
    key = _key(np.uint32(cfg.seed))
    for number in (purpose, *numbers):
        key = _fold_in(key, np.uint32(number))
    return key


def generator_for(cfg: Config, purpose: Purpose, *numbers: int) -> np.random.Generator:
    """A generator of NumPy for one purpose at what these numbers name."""
    return np.random.default_rng((cfg.seed, purpose, *numbers))
