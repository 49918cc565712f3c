"""One map for all tests of tracking and mapping: fitting it is most of their time."""

from __future__ import annotations

import corner
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.core import draws, mapping

FIT_STEPS = 600


@pytest.fixture(scope="session")
def corner_frames() -> draws.Frames:
    """The corner from five true poses, of which all but the first may move."""
    depth, color = zip(*(corner.see(T) for T in corner.VIEWS), strict=True)
    return draws.Frames(
        np.stack(depth), np.stack(color), corner.VIEWS.astype(np.float32), np.arange(len(corner.VIEWS)) > 0
    )


@pytest.fixture(scope="session")
def corner_map(corner_frames) -> mapping.Learned:
    """A submap that has learned the corner from the true poses."""
    fixed = corner_frames._replace(movable=np.zeros(len(corner.VIEWS), bool))
    key = jax.random.key(1)
    submap = mapping.create(jax.random.key(0), corner.CFG)
    submap, _, info = mapping.refine(submap, fixed, jnp.int32(FIT_STEPS), key, corner.CAMERA, corner.CFG)
    assert bool(info.ok)
    return submap
