"""Rigid motions: what must hold of them whatever they are, near the identity and near half a turn, too."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mipsjax.core import rigid

# Sums of a few products of numbers of about 1 in double precision
EXACT = 1e-13
# The same in single precision
SINGLE = 5e-6
# Just above the angle below which the library takes a series for its logarithm, half of the digits are lost
SINGLE_LOGARITHM = 5e-5

ANGLES = [0.0, 1e-9, 1e-4, 0.3, 2.0, np.pi - 1e-4]
AXIS = np.array([0.48, -0.6, 0.64])  # of unit length
POINTS = np.random.default_rng(3).normal(size=(50, 3))


def turned_by(angle: float) -> np.ndarray:
    return rigid.from_twist(np.concatenate([[0.3, -1.2, 0.5], angle * AXIS]))


MOTIONS = np.stack([turned_by(angle) for angle in ANGLES])


@pytest.mark.parametrize("angle", ANGLES)
def test_an_inverse_undoes_a_motion(angle):
    T = turned_by(angle)
    np.testing.assert_allclose(rigid.inverse(T) @ T, np.eye(4), atol=EXACT)
    there = rigid.transform(T, POINTS)
    np.testing.assert_allclose(rigid.transform_back(T, there), POINTS, atol=EXACT)
    np.testing.assert_allclose(rigid.transform(rigid.inverse(T), there), POINTS, atol=EXACT)


def test_all_ways_to_transform_and_to_invert_agree():
    for T, back in zip(MOTIONS, rigid.inverses(MOTIONS), strict=True):
        np.testing.assert_allclose(back, rigid.inverse(T), atol=EXACT)
        expected = (np.c_[POINTS, np.ones(len(POINTS))] @ T.T)[:, :3]
        np.testing.assert_allclose(rigid.transform(T, POINTS), expected, atol=EXACT)
        compiled = rigid.transform(jnp.asarray(T), jnp.asarray(POINTS))
        np.testing.assert_allclose(compiled, expected, atol=SINGLE)


@pytest.mark.parametrize("angle", ANGLES)
def test_distance_and_lengths_are_those_of_the_motion_between(angle):
    T, length = turned_by(angle), np.linalg.norm([0.3, -1.2, 0.5])
    # The arc cosine loses half of the digits at both ends, as is said there
    metres, radians = rigid.distance(MOTIONS[3], MOTIONS[3] @ T)
    np.testing.assert_allclose([metres, radians], [length, angle], atol=1e-6)
    shift, turn = rigid.lengths(T[None])
    np.testing.assert_allclose([shift[0], turn[0]], [length, angle], atol=1e-6)
    np.testing.assert_allclose(rigid.angles(T[None, :3, :3])[0], angle, atol=EXACT)


@pytest.mark.parametrize("angle", ANGLES)
def test_twists_are_reversed(angle):
    twist = np.concatenate([[0.3, -1.2, 0.5], angle * AXIS])
    np.testing.assert_allclose(rigid.to_twist(rigid.from_twist(twist)), twist, atol=1e-11)


def test_the_nearest_rigid_motion_is_one_and_leaves_a_rigid_one_alone():
    stretched = MOTIONS[3].copy()
    stretched[:3, :3] += 1e-3 * np.random.default_rng(1).normal(size=(3, 3))
    found = rigid.rigid(stretched.astype(np.float32))
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=EXACT)
    assert np.linalg.det(found[:3, :3]) > 0
    np.testing.assert_allclose(rigid.rigid(MOTIONS[3]), MOTIONS[3], atol=EXACT)


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.3, 2.0])
def test_compiled_motions_are_reversed_and_turn_as_those_of_the_host(angle):
    twist = jnp.asarray(np.concatenate([[0.3, -0.2, 0.5], angle * AXIS]), jnp.float32)
    T = np.asarray(rigid.perturbed(jnp.eye(4), twist))
    np.testing.assert_allclose(rigid.log(T), twist, atol=SINGLE_LOGARITHM)
    turn = Rotation.from_rotvec(angle * AXIS).as_matrix()
    np.testing.assert_allclose(T[:3, :3], turn, atol=SINGLE)
