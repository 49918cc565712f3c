"""Two frames against each other: the pose they agree on, what holds it, and what colour and surfaces say apart."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from corner import CAMERA, HOME, apart, pose, see
from jaxtyping import Array, Float

import painted
from mipsjax.config.sections import Config, PairConfig
from mipsjax.core import relative
from mipsjax.core.camera import Intrinsics
from mipsjax.core.evidence import Landmarks
from mipsjax.core.photometric import Images
from mipsjax.uncertainty.trust import ALLOWED, of_pair

CFG = replace(Config(), pairs=PairConfig(pixels=2304))
MOTION = pose((2.0, -3.0, 1.0), (0.06, -0.04, 0.05))
GUESS = MOTION @ pose((0.5, 0.4, -0.3), (0.01, -0.015, 0.01))
WALL_M = 2.0


def wall() -> np.ndarray:
    """Depth of a plane across the optical axis."""
    return np.full((CAMERA.height, CAMERA.width), WALL_M, np.float32)


def corners(T_first_second: np.ndarray, depth: np.ndarray, count: int = 200) -> Landmarks:
    """Points of the first frame, and where a second one at this pose sees them."""
    rng = np.random.default_rng(0)
    v, u = rng.integers(0, depth.shape[0], count), rng.integers(0, depth.shape[1], count)
    x, y = (u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy
    p_first = np.stack([x, y, np.ones(count)], 1) * depth[v, u][:, None]
    p_second = (p_first - T_first_second[:3, 3]) @ T_first_second[:3, :3]
    axes = np.tile(np.eye(2), (count, 1, 1))
    parts = (p_first, p_second[:, :2] / p_second[:, 2:], axes)
    return Landmarks(*(jnp.asarray(part, jnp.float32) for part in parts), jnp.ones(count, bool))


def measured(
    first: np.ndarray,
    second: np.ndarray,
    guess: np.ndarray,
    landmarks: Landmarks | None,
    trust: float = 1.0,
    shown: relative.Shown | None = None,
    camera: Intrinsics = CAMERA,
) -> relative.Relative:
    """Of one pair, without the first axis."""
    T = guess.astype(np.float32)
    pairs = relative.Pairs(first, second, T, T, landmarks, shown)  # pyright: ignore[reportArgumentType]
    stacked = jax.tree.map(lambda part: jnp.asarray(part)[None], pairs)
    found = relative.measure(stacked, np.float32(trust), camera, CFG)
    return jax.tree.map(lambda part: np.asarray(part[0]), found)


def slope(T: np.ndarray, towards: np.ndarray) -> Float[Array, "6"]:
    return jaxlie.SE3.from_matrix(jnp.asarray(np.linalg.inv(T) @ towards)).log()


@pytest.mark.parametrize("by", ["surfaces", "both"])
def test_the_pose_is_found_from_a_guess(by: str):
    first, second = see(HOME)[0], see(HOME @ MOTION)[0]
    found = measured(first, second, GUESS, corners(MOTION, first) if by == "both" else None)
    metres, degrees = apart(found.T_first_second, MOTION)
    # Exact depth, but a point falls on the nearest pixel, whose plane is known from its neighbours
    assert metres < 0.001 and degrees < 0.03
    assert found.matched > 0.8


def test_a_plain_wall_leaves_open_what_corners_hold():
    """Along it, and around its normal: as firmly as the guess, which says 0.1 m or rad."""
    free, weak = [0, 1, 5], 1 / CFG.track.prior**2
    alone = measured(wall(), wall(), np.eye(4), None)
    np.testing.assert_allclose(np.diag(alone.surfaces)[free], weak, rtol=0.5)
    assert (np.diag(alone.surfaces)[[2, 3, 4]] > 100 * weak).all()
    np.testing.assert_array_equal(alone.colour, 0)
    both = measured(wall(), wall(), pose((0, 0, 1), (0.02, 0, 0)), corners(np.eye(4), wall()))
    assert (np.diag(both.colour)[free] > 100 * weak).all()
    assert apart(both.T_first_second, np.eye(4))[0] < 2e-4  # what the guess pulls


def test_brightness_holds_what_a_plain_wall_leaves_open():
    """Without any corners, from a guess a few pixels off; a first frame that had no colour says nothing."""
    painting = painted.painting()
    T_second = pose((1.0, 2.0, -1.0), (0.04, -0.03, 0.05))
    (grey, first), (later, second) = (painted.wall(T, painting) for T in (np.eye(4), T_second))
    guess = T_second @ pose((0.3, -0.2, 0.3), (0.01, -0.008, 0.01))
    camera, every = painted.CAMERA, 2
    first, second = first[::every, ::every], second[::every, ::every]
    for colored in (True, False):
        parts = (grey[None], first[None], np.eye(4, dtype=np.float32)[None], np.array([colored]))
        shown = relative.Shown(Images(*(jnp.asarray(part) for part in parts)), later)  # pyright: ignore[reportArgumentType]
        found = measured(first, second, guess, None, shown=shown, camera=camera)
        metres, degrees = apart(found.T_first_second, T_second)
        assert (metres < 0.001 and degrees < 0.02) == colored
        assert (np.linalg.eigvalsh(found.colour)[0] > 10 / CFG.track.prior**2) == colored


def test_a_frame_without_depth_stays_at_the_guess():
    found = measured(wall(), np.zeros_like(wall()), GUESS, None)
    np.testing.assert_allclose(found.T_first_second, GUESS, atol=1e-6)
    assert found.matched == 0 and np.isfinite(found.surfaces).all()


def test_less_trust_moves_the_pose_from_corners_to_surfaces():
    first, second = see(HOME)[0], see(HOME @ MOTION)[0]
    elsewhere = MOTION @ pose((0.2, 0, 0), (0.004, 0, 0))
    off = []
    for trust in (1e3, 1.0, 1e-3):
        found = measured(first, second, MOTION, corners(elsewhere, first), trust)
        off.append(apart(found.T_first_second, MOTION)[0])
    # Most of the 4 mm between them, and what rounding to pixels leaves of the surfaces' pose
    assert off[0] > 0.003 and off[0] > off[1] > off[2] and off[2] < 0.001


def difference(found: relative.Relative) -> np.ndarray:
    """From where colour alone would have the frame to where surfaces would."""
    return found.to_surfaces - found.to_colour


def test_it_is_said_how_far_both_are_apart():
    first, second = see(HOME)[0], see(HOME @ MOTION)[0]
    elsewhere = MOTION @ pose((0.1, -0.05, 0.08), (0.003, 0.002, -0.002))
    found = measured(first, second, MOTION, corners(elsewhere, first))
    # Cauchy weights bend both a little: a tenth of what they are apart
    np.testing.assert_allclose(difference(found), slope(elsewhere, MOTION), atol=6e-4)


def test_noise_along_a_bare_wall_contradicts_no_corners():
    """Its normals pull the frame along the wall, as firmly as they seem to hold it: little."""
    rng = np.random.default_rng(1)
    first, second = (
        (wall() + 0.008 * rng.standard_normal(wall().shape)).astype(np.float32) for _ in range(2)
    )
    found = measured(first, second, np.eye(4), corners(np.eye(4), wall()))
    stacked = relative.Relative(*(np.asarray(part)[None] for part in found))
    said = of_pair(stacked, 0)
    assert said is not None and said.contradiction(1.0) < ALLOWED
