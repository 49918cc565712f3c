"""Which submap counts where in the mesh."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import maps
from mipsjax.config.presets import PRESETS
from mipsjax.core import mapping
from mipsjax.mesh.reconstruct import Blend
from mipsjax.submaps.state import SlamState

CFG = PRESETS["tiny"]
WALL = 2.0  # metres in front of the origin
NEARER = 1.4  # metres, from where the second submap sees the middle of it


@pytest.fixture(scope="module")
def state() -> SlamState:
    """Two submaps of one wall, the second with its anchor nearer; one says it is behind, the other before any point."""
    near = maps.keyframe(1)._replace(depth=np.full_like(maps.DEPTH, WALL - NEARER))
    first = maps.submap(maps.keyframe(0), learned=saying(0))
    second = maps.submap(near, T_world_sub=maps.pose(translation=(0, 0, NEARER)), learned=saying(-1))
    return maps.state(first, second)


def saying(which: int) -> mapping.Learned:
    """A submap that finds the same class everywhere."""
    learned = mapping.create(jax.random.key(0), CFG)
    net = learned.field.fine
    assert net is not None
    biases = (*net.biases[:-1], net.biases[-1].at[which].add(2.0))
    return learned._replace(field=learned.field._replace(fine=net._replace(biases=biases)))


def test_the_submap_that_measured_from_nearer_leads(state):
    half = WALL * maps.CAMERA.cx / maps.CAMERA.fx
    points = [[0, 0, WALL], [0.8 * half, 0, WALL], [0, 0, WALL + 0.05], [0, 0, WALL - 0.5], [9, 0, WALL]]
    np.testing.assert_array_equal(Blend(state, CFG).leading(np.array(points, float)), [1, 0, 1, -1, -1])


def test_a_submap_fades_where_its_measurements_end(state):
    along = np.linspace([0, 0, WALL], [0.6, 0, WALL], 2000)

    def distance(part: SlamState) -> np.ndarray:
        return Blend(part, CFG)(along, lambda blended: blended.psi, colored=False)

    added = distance(state) - distance(state._replace(submaps=state.submaps[:1]))
    most = np.abs(added).max()
    assert most > 0.01, "the two say the same"
    assert (np.abs(added[:100]) > 0.2 * most).all() and (added[-100:] == 0).all()
    assert np.abs(np.diff(added)).max() < 0.02 * most
