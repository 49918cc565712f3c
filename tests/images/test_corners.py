"""Corners followed between frames: the motion they find, and the images in which there is nothing to follow."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mipsjax.core.rigid import from_twist, to_twist, transform
from mipsjax.images.corners import EDGE_PX, Corners, corners
from mipsjax.images.following import follow
from painted import CAMERA, FINE_PX_PER_M, RANGE_M, painting, pose, wall

COUNT, FEWEST = 400, 30
MOTIONS = [
    ((0, 0, 0), (0, 0, 0)),
    ((0, 0, 0), (0.03, -0.02, 0.04)),
    ((0, 0, 5), (0, 0, 0)),
    ((3, -4, 2), (0.05, 0.03, -0.06)),
]
"""Degrees and metres."""


def from_home(grey: np.ndarray, depth: np.ndarray) -> Corners:
    return corners(grey, depth, 7, COUNT, CAMERA)


def test_corners_lie_on_the_surface_that_was_measured():
    found = from_home(*wall(np.eye(4), painting()))
    assert 100 < len(found.pixel) <= COUNT and found.record == 7
    np.testing.assert_allclose(found.p_cam[:, 2], RANGE_M, rtol=1e-5)
    image = found.p_cam[:, :2] / found.p_cam[:, 2:] * CAMERA.fx + (CAMERA.cx, CAMERA.cy)
    np.testing.assert_allclose(image, found.pixel, atol=1e-3)  # float32 at 320 pixels


def white(image: np.ndarray, sigma: float = 3.0) -> np.ndarray:
    noise = sigma * np.random.default_rng(0).standard_normal(image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def compressed(image: np.ndarray) -> np.ndarray:
    _, data = cv2.imencode(".jpg", white(image), [cv2.IMWRITE_JPEG_QUALITY, 90])
    return cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)


def enlarged(image: np.ndarray) -> np.ndarray:
    """As of a sensor of which every second pixel sees one colour."""
    return cv2.resize(white(image[::2, ::2], 4.0), image.shape[::-1], interpolation=cv2.INTER_LINEAR)


def with_a_border(image: np.ndarray) -> np.ndarray:
    out = white(image)
    out[:40] = 0
    return out


TAKEN = {
    "exact": lambda image: np.round(image).astype(np.uint8),
    "white noise": white,
    "compressed": compressed,
    "enlarged": enlarged,
    "smoothed": lambda image: cv2.blur(white(image), (3, 3)),
    "with a border": with_a_border,
}


@pytest.mark.parametrize("taken", TAKEN.values(), ids=TAKEN)
def test_noise_has_no_corners(taken):
    """A bare wall in soft light, where a camera's noise is all that an eye for corners finds. A painted one keeps its
    own."""
    painted, depth = wall(np.eye(4), painting())
    light = np.linspace(80, 160, depth.shape[1])[None] * np.ones_like(depth)
    bare = from_home(taken(light), depth).pixel
    # A border's edge is none of noise
    assert np.sum(bare[:, 1] > 50) < 0.05 * COUNT
    assert len(from_home(taken(painted), depth).pixel) > 0.7 * len(from_home(painted, depth).pixel)


@pytest.mark.parametrize(("degrees", "metres"), MOTIONS)
def test_the_motion_is_found_from_no_motion(degrees, metres):
    painted, truth = painting(), pose(degrees, metres)
    found = follow(from_home(*wall(np.eye(4), painted)), wall(truth, painted)[0], np.eye(4), FEWEST, CAMERA)
    assert found is not None
    T_error = np.linalg.inv(truth) @ found.T_ref_cam
    # A tenth of a pixel is 0.7 mm and 0.02 degrees; a shift and a turn are hard to tell apart on one plane
    assert np.linalg.norm(T_error[:3, 3]) < 0.005
    assert np.degrees(Rotation.from_matrix(T_error[:3, :3]).magnitude()) < 0.15


def test_a_fast_turn_is_found_from_a_guess_near_it():
    """Twelve degrees are 60 pixels, which flow alone does not reach."""
    painted, truth = painting(), pose((0, 12, 0), (0, 0, 0))
    home, grey = from_home(*wall(np.eye(4), painted)), wall(truth, painted)[0]
    found = follow(home, grey, pose((0, 10, 0), (0, 0, 0)), FEWEST, CAMERA)
    assert found is not None
    assert np.degrees(Rotation.from_matrix(truth[:3, :3].T @ found.T_ref_cam[:3, :3]).magnitude()) < 0.15


@pytest.mark.parametrize("measured", ["all of it", "with holes"])
@pytest.mark.parametrize(
    ("degrees", "metres"),
    [((0, 15, 5), (0.2, 0, 0.4)), ((0, 20, 20), (-0.5, 0, 0.3)), ((0, 25, 0), (-0.7, 0, 0.2))],
)
def test_a_corner_is_where_it_belongs_when_seen_from_elsewhere(degrees, metres, measured):
    """The square around it is stretched and turned there: as it is, it is found half a pixel off, and half as often."""
    painted, truth = painting(), pose(degrees, metres)
    grey, depth = wall(np.eye(4), painted)
    if measured == "with holes":
        depth[np.random.default_rng(0).random(depth.shape) < 0.3] = 0
        depth[:, 150:165] = 0
    home, guess = from_home(grey, depth), truth @ pose((0, 1, 0), (0.02, 0, 0))
    found = follow(home, wall(truth, painted)[0], guess, FEWEST, CAMERA)
    assert found is not None and len(found.pixel) > 100
    T_cam_ref = np.linalg.inv(truth)
    p_cam = found.p_ref @ T_cam_ref[:3, :3].T + T_cam_ref[:3, 3]
    off = p_cam[:, :2] / p_cam[:, 2:] * CAMERA.fx + (CAMERA.cx, CAMERA.cy) - found.pixel
    assert np.median(np.linalg.norm(off, axis=1)) < 0.05
    T_error = T_cam_ref @ found.T_ref_cam
    assert np.linalg.norm(T_error[:3, 3]) < 0.001
    assert np.degrees(Rotation.from_matrix(T_error[:3, :3]).magnitude()) < 0.02


def test_no_corner_is_beside_an_edge_of_depth(monkeypatch):
    """It may be of either side; a plane that is seen at a grazing angle has no edge."""
    grey, depth = wall(np.eye(4), painting())
    near = np.arange(CAMERA.width) > 160
    assert np.abs(from_home(grey, depth).pixel[:, 0] - 160.5).min() < 2
    found = from_home(grey, np.where(near, depth - 0.5, depth))
    assert len(found.pixel) > 100 and np.abs(found.pixel[:, 0] - 160.5).min() > EDGE_PX - 2
    slanted = wall(pose((0, 40, 0), (-1.0, 0, 0)), painting())
    grazing = from_home(*slanted)
    assert np.ptp(grazing.p_cam[:, 2]) > 1
    monkeypatch.setattr("mipsjax.images.corners.EDGE", np.inf)
    np.testing.assert_array_equal(grazing.pixel, from_home(*slanted).pixel)


SLATS = np.tile(np.arange(4 * FINE_PX_PER_M) % 240 < 60, (4 * FINE_PX_PER_M, 1)).astype(np.uint8)
"""A fence: what is painted on it is seen, and between its slats what is behind."""


def behind_a_fence(T_wall_cam: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brightness and depth of a wall with a fence before it, by a camera that moves on so during its exposure."""
    images = []
    for share in np.linspace(-0.5, 0.5, 7):
        T = T_wall_cam @ from_twist(share * velocity)
        grey, depth = wall(T, painting())
        (before, z), slat = wall(T, painting(1), 1.2), wall(T, SLATS, 1.2)[0] > 0
        images.append((np.where(slat, before, grey), np.where(slat, z, depth)))
    return np.mean([grey for grey, _ in images], 0).astype(np.uint8), images[3][1]


@pytest.mark.parametrize("degrees", [-4.0, 4.0])
def test_who_turns_and_walks_behind_things_sees_all_of_the_turn(degrees):
    """Corners between what is behind and the edge of what covers it would move with the latter: too little, where the
    walk takes back a part of what the turn moves."""
    truth = pose((0, degrees, 0), (-0.004 * degrees, 0, 0))
    blur = 0.5 * to_twist(truth)
    home = from_home(*behind_a_fence(np.eye(4), blur))
    found = follow(home, behind_a_fence(truth, blur)[0], truth, FEWEST, CAMERA)
    assert found is not None and len(found.pixel) > 60
    p_cam = transform(np.linalg.inv(truth), found.p_ref)
    off = found.pixel[:, 0] - (p_cam[:, 0] / p_cam[:, 2] * CAMERA.fx + CAMERA.cx)
    assert abs(np.mean(off)) < 0.05


def test_a_part_that_moves_by_itself_is_left_out():
    painted = painting()
    home, (grey, _) = from_home(*wall(np.eye(4), painted)), wall(np.eye(4), painted)
    moved = grey.copy()
    moved[60:180, 120:240] = grey[60:180, 112:232]
    found = follow(home, moved, np.eye(4), FEWEST, CAMERA)
    assert found is not None and np.abs(found.T_ref_cam - np.eye(4)).max() < 0.005
    inside = np.all((found.pixel > (130, 65)) & (found.pixel < (230, 175)), axis=1)
    assert not inside.any()


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("what", ["flat", "other place", "no depth"])
def test_nothing_to_follow_is_none(what, near):
    painted = painting()
    grey, depth = wall(np.eye(4), painted)
    if what == "flat":
        grey = np.full_like(grey, 128)
    elif what == "no depth":
        depth = np.zeros_like(depth)
    now = wall(np.eye(4), painting(1))[0] if what == "other place" else grey
    assert follow(from_home(grey, depth), now, np.eye(4), FEWEST, CAMERA, near) is None


def test_where_the_motion_is_known_to_a_pixel_the_second_round_is_enough():
    """From a guess that is off by 0.3 degrees, a pixel and a half."""
    painted, truth = painting(), pose((0, 15, 5), (0.2, 0, 0.4))
    home, now = from_home(*wall(np.eye(4), painted)), wall(truth, painted)[0]
    found = follow(home, now, truth @ pose((0, 0.3, 0), (0.005, 0, 0)), FEWEST, CAMERA, near=True)
    assert found is not None and len(found.pixel) > 100
    np.testing.assert_allclose(found.T_ref_cam, truth, atol=1e-3)


def test_the_same_corners_twice():
    painted = painting()
    home, grey = from_home(*wall(np.eye(4), painted)), wall(pose((1, 2, 0), (0, 0, 0.05)), painted)[0]
    one, two = (follow(home, grey, np.eye(4), FEWEST, CAMERA) for _ in range(2))
    assert one is not None and two is not None
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
