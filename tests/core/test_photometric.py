"""Brightness of points in images of earlier frames: where it says that a camera is, and when it says nothing."""

from __future__ import annotations

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.config.sections import Config
from mipsjax.core.camera import project, rays
from mipsjax.core.equations import Points, System, descend
from mipsjax.core.evidence import Evidence
from mipsjax.core.photometric import (
    EDGE_PX,
    FEWEST,
    LEVELS,
    Images,
    Shades,
    brightness_system,
    grey_of,
    pyramid,
    with_noise,
)
from mipsjax.core.solvers import approach
from mipsjax.core.views import Views
from painted import CAMERA, painting, pose, wall

CFG = Config()
PAINTED = painting()
FIRST, OLDER = pose((0, 0, 0), (0, 0, 0)), pose((1, -3, 2), (-0.05, 0.02, 0.03))
SECOND = pose((1.0, 2.0, -1.5), (0.04, -0.03, 0.05))
GUESS = SECOND @ pose((0.4, -0.3, 0.3), (0.01, -0.008, 0.01))
EXACT_M = 0.0005
"""A twentieth of a pixel is 0.35 mm on a wall that is 2 m away."""


def images(*greys: np.ndarray, poses=(FIRST, OLDER)) -> Images:
    depth = np.stack([wall(T, PAINTED)[1][::2, ::2] for T in poses])
    T_sub_cam = np.stack(poses).astype(np.float32)
    return Images(
        jnp.asarray(np.stack(greys)), jnp.asarray(depth), jnp.asarray(T_sub_cam), jnp.ones(len(poses), bool)
    )


def usual() -> Images:
    return images(*(wall(T, PAINTED)[0] for T in (FIRST, OLDER)))


def seen(grey: np.ndarray, of: Images, level: int = 0) -> Shades:
    """A second frame that looks like this, in these images."""
    depth = jnp.asarray(wall(SECOND, PAINTED)[1])
    return pyramid(of, jnp.asarray(grey, jnp.float32), depth, LEVELS, CAMERA, CFG)[level]


def system(T: np.ndarray, shade: Shades) -> System:
    return brightness_system(jnp.asarray(T, jnp.float32), shade, CAMERA, CFG)


def found(grey: np.ndarray, of: Images) -> np.ndarray:
    """From coarse to fine, as in tracking."""
    T = jnp.asarray(GUESS, jnp.float32)
    for level in reversed(range(LEVELS)):
        shade = with_noise(seen(grey, of, level), T, CAMERA, CFG)
        T = descend(lambda T, shade=shade: brightness_system(T, shade, CAMERA, CFG), T, 10)
    return np.asarray(T, np.float64)


def off(T: np.ndarray) -> float:
    """Metres, or as many radians."""
    error = np.linalg.inv(SECOND) @ T
    turn = (error[:3, :3] - error[:3, :3].T)[np.triu_indices(3, 1)] / 2
    return float(np.abs(np.concatenate([error[:3, 3], turn])).max())


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.7, 15.0)])
def test_the_pose_is_found_along_a_plain_wall_in_any_light(gain: float, offset: float):
    """Of which surfaces say nothing. An offset and a gain are the image's own."""
    grey = gain * wall(SECOND, PAINTED)[0] + offset
    assert off(GUESS) > 0.009
    assert off(found(grey, usual())) < EXACT_M


def test_what_moves_does_not_move_the_camera():
    grey = wall(SECOND, PAINTED)[0].astype(np.float32)
    grey[80:180, 100:200] = grey[20:120, 40:140]  # an eighth of the image
    assert off(found(grey, usual())) < 2 * EXACT_M


def test_an_image_that_shows_nothing_holds_nothing():
    """Nor does its noise, here of 2 of 255."""
    rng = np.random.default_rng(0)
    size = (CAMERA.height, CAMERA.width)
    for noise in (0.0, 2.0):
        blank, first, older = (np.clip(128 + noise * rng.standard_normal(size), 0, 255) for _ in range(3))
        empty = images(*(image.astype(np.uint8) for image in (first, older)))
        held = system(SECOND, seen(blank, empty)).hessian
        usually = system(SECOND, seen(wall(SECOND, PAINTED)[0], usual())).hessian
        assert np.trace(held) < 1e-3 * np.trace(usually)


def test_a_blurred_frame_says_less():
    grey = wall(SECOND, PAINTED)[0]
    blurred = cv2.blur(grey, (25, 1))
    T = jnp.asarray(SECOND, jnp.float32)
    sharp, smeared = (with_noise(seen(image, usual()), T, CAMERA, CFG) for image in (grey, blurred))
    assert (sharp.noise < smeared.noise / 2).all() and (sharp.noise >= CFG.track.brightness.noise).all()
    assert np.trace(system(SECOND, smeared).hessian) < np.trace(system(SECOND, sharp).hessian) / 3


def test_an_image_of_another_place_or_of_none_is_left_out():
    elsewhere = usual()._replace(T_sub_cam=usual().T_sub_cam.at[1, 0, 3].add(10.0))
    grey, T = wall(SECOND, PAINTED)[0], jnp.asarray(SECOND, jnp.float32)
    assert with_noise(seen(grey, elsewhere), T, CAMERA, CFG).images.mask.tolist() == [True, False]
    filled = usual()._replace(mask=jnp.array([True, False]))
    of_one, of_both = (system(SECOND, seen(grey, some)) for some in (filled, usual()))
    assert 0 < np.trace(of_one.hessian) < 0.7 * np.trace(of_both.hessian)


def test_a_point_that_is_hidden_in_an_image_is_not_compared():
    """Something stands half a metre in front of the wall there."""
    hidden = usual()._replace(depth=usual().depth.at[:, :, 80:].add(-0.5))
    whole, half = (
        with_noise(seen(wall(SECOND, PAINTED)[0], some), jnp.asarray(SECOND, jnp.float32), CAMERA, CFG)
        for some in (usual(), hidden)
    )
    assert whole.measured.shape[1] > 4 * FEWEST
    assert np.trace(system(SECOND, half).hessian) < 0.75 * np.trace(system(SECOND, whole).hessian)


def test_points_are_the_steepest_pixels_and_each_image_has_others():
    grey, depth = wall(SECOND, PAINTED)
    shade = seen(grey, usual())
    assert shade.p_cam.shape == (2, CFG.track.brightness.pixels // 2, 3)
    u, v = np.asarray(project(shade.p_cam.reshape(-1, 3), CAMERA)).T
    np.testing.assert_allclose(u, np.rint(u), atol=1e-3)
    u, v = np.rint(u).astype(int), np.rint(v).astype(int)
    np.testing.assert_allclose(shade.p_cam[..., 2].ravel(), depth[v, u], rtol=1e-6)
    assert len(set(zip(u, v, strict=True))) == len(u)
    slope = np.hypot(*np.gradient(grey.astype(np.float32)))
    measured = np.asarray(shade.measured).ravel()
    assert measured.mean() > 0.5
    assert np.median(slope[v, u][measured]) > 1.5 * np.median(slope)


def test_beside_an_edge_of_depth_no_pixel_is_compared():
    """There it is not known which side a change of brightness belongs to, and a moving camera blurs one over the other;
    beside pixels that were not measured a smoothed gradient reaches two pixels."""
    grey, depth = wall(SECOND, PAINTED)
    grey = np.where(np.arange(CAMERA.width) < 160, grey // 2, 255 - grey // 2)
    depth[:, 160:] -= 0.5
    depth[:40] = 0
    shade = pyramid(usual(), jnp.asarray(grey, jnp.float32), jnp.asarray(depth), 1, CAMERA, CFG)[0]
    p_cam = np.asarray(shade.p_cam)[np.asarray(shade.measured)]
    u, v = np.rint(np.asarray(project(jnp.asarray(p_cam), CAMERA)).T)
    assert len(u) > 1000 and np.abs(u - 159.5).min() > EDGE_PX and v.min() > 41


@pytest.mark.parametrize("every", [1, 2, 4, 7])
def test_all_of_an_image_is_used_whatever_its_size(every: int):
    """Depth may be decimated, to fewer pixels than there are parts."""
    grey, depth = wall(SECOND, PAINTED)
    small = jnp.asarray(depth[::every, ::every])
    shade = pyramid(usual(), jnp.asarray(grey, jnp.float32), small, LEVELS, CAMERA, CFG)[0]
    p_cam = np.asarray(shade.p_cam)[np.asarray(shade.measured)]
    u, v = np.asarray(project(jnp.asarray(p_cam), CAMERA)).T
    assert min(u.min(), v.min()) < 6 * every + 6
    assert u.max() > CAMERA.width - 6 * every - 6 and v.max() > CAMERA.height - 6 * every - 6


def test_a_coarse_level_alone_is_not_biased():
    """Half a pixel of it would be 14 mm at the coarsest."""
    T = jnp.asarray(SECOND, jnp.float32)
    for level in range(LEVELS):
        shade = with_noise(seen(wall(SECOND, PAINTED)[0], usual(), level), T, CAMERA, CFG)
        end = descend(lambda T, shade=shade: brightness_system(T, shade, CAMERA, CFG), T, 10)
        assert off(np.asarray(end, np.float64)) < EXACT_M * 2**level


def test_from_far_off_coarse_images_and_depth_lead_near():
    """Eight pixels, where the finest level alone goes astray; without a map, as in front of what is not learned yet.
    Depth holds what lies across the wall, images the rest."""
    grey, depth = wall(SECOND, PAINTED)
    v, u = (axis.ravel() for axis in np.mgrid[4 : CAMERA.height : 8, 4 : CAMERA.width : 8])
    p_cam = rays(jnp.asarray(v), jnp.asarray(u), CAMERA) * depth[v, u][:, None]
    points = Points(p_cam, jnp.zeros_like(p_cam), jnp.ones(len(v), bool))
    views = Views(usual().depth, usual().T_sub_cam)
    levels = [Evidence(points, views, shades=seen(grey, usual(), level)) for level in range(LEVELS)]
    far = jnp.asarray(SECOND @ pose((-0.4, 1, 0.4), (0.012, 0.008, -0.012)), jnp.float32)

    def after(tried: list[Evidence], steps: int) -> float:
        T = far
        for level in tried:
            T = approach(T, level, steps, CAMERA, CFG)
        return off(np.asarray(T, np.float64))

    steps, begun = CFG.track.brightness.coarse_steps, off(np.asarray(far, np.float64))
    assert after(levels[:1], (LEVELS - 1) * steps) > begun
    assert after(levels[:0:-1], steps) < EXACT_M


def test_to_lose_sight_of_the_images_is_never_better():
    """A turn away from a pose that is somewhat wrong, until nothing is seen."""
    shade = with_noise(
        seen(wall(SECOND, PAINTED)[0], usual(), 1), jnp.asarray(SECOND, jnp.float32), CAMERA, CFG
    )
    costs = [float(system(SECOND @ pose((0, turn, 0), (0, 0, 0)), shade).cost) for turn in (0, 1, 60)]
    assert costs[0] < costs[1] < costs[2]


def test_grey_is_that_of_opencv():
    color = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    np.testing.assert_allclose(grey_of(jnp.asarray(color)), cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), atol=0.6)
