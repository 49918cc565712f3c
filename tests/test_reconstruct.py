"""Which submap counts where in the mesh."""

from __future__ import annotations

import numpy as np
import pytest

import maps
from mipsjax.config import Config
from mipsjax.reconstruct import Blend

WALL = 2.0  # metres in front of the origin
NEARER = 1.4  # metres, from where the second submap sees the middle of it


@pytest.fixture(scope="module")
def blend() -> Blend:
    """Two submaps of one wall, the second with its anchor nearer."""
    near = maps.keyframe(1)._replace(depth=np.full_like(maps.DEPTH, WALL - NEARER))
    first = maps.submap(maps.keyframe(0))
    second = maps.submap(near, T_world_sub=maps.pose(translation=(0, 0, NEARER)))
    return Blend(maps.state(first, second), Config())


def test_the_submap_that_measured_from_nearer_leads(blend):
    half = WALL * maps.CAMERA.cx / maps.CAMERA.fx
    points = [[0, 0, WALL], [0.8 * half, 0, WALL], [0, 0, WALL + 0.05], [0, 0, WALL - 0.5], [9, 0, WALL]]
    np.testing.assert_array_equal(blend.leading(np.array(points, float)), [1, 0, 1, -1, -1])
