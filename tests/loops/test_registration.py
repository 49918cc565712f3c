"""Relative poses: exact synthetic points, outliers, shapes that fix no pose, and real frames."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import align_rigid, distance, transform
from mipsjax.data.open import open_sequence
from mipsjax.images.features import LARGEST, UNIT, Features, detect, packed
from mipsjax.loops import ransac
from mipsjax.loops.registration import MAX_DEVIATION_M, Match, depth_agreement, match_all, relative_pose

CAMERA = Intrinsics(290.0, 290.0, 159.5, 119.5, 320, 240)
EXACT = 1e-6
"""Metres or radians: points are stored in single precision, and the weak prior pulls by 1e-9."""


def motion(rng, metres=0.5, degrees=20.0):
    T = np.eye(4)
    axis, direction = (d / np.linalg.norm(d) for d in rng.normal(size=(2, 3)))
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    T[:3, 3] = metres * direction
    return T


def pairs_of(T, p):
    return ransac.Pairs(p, p @ T[:3, :3].T + T[:3, 3])


def cloud(rng, count):
    """Points in the view, 1.5 to 4 m away."""
    z = rng.uniform(1.5, 4.0, count)
    return np.stack([rng.uniform(-0.4, 0.4, count) * z, rng.uniform(-0.3, 0.3, count) * z, z], 1)


def descriptors(rng, count):
    """Unrelated ones: random directions of the right length."""
    d = np.abs(rng.normal(size=(count, 128)))
    d = np.minimum(np.rint(UNIT * d / np.linalg.norm(d, axis=1, keepdims=True)), LARGEST)
    return packed(d.astype(np.uint8))


def features(p, looks, depth=None):
    depth = np.zeros((30, 40), np.float32) if depth is None else depth
    return Features(looks, p.astype(np.float32), depth)


def wall_depth(T_wall_cam, wall_z=3.0):
    """Coarse depth of the plane z = `wall_z` seen from a pose."""
    camera = CAMERA.decimated(8)
    v, u = np.mgrid[: camera.height, : camera.width]
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)
    slope = ray @ T_wall_cam[2, :3]
    return ((wall_z - T_wall_cam[2, 3]) / slope).astype(np.float32)


def wall_pair(seed=0, count=200):
    """Two views of points on a wall, with depth images that agree, and the true motion."""
    rng = np.random.default_rng(seed)
    T = motion(rng, 0.2, 5.0)
    p_other = cloud(rng, count)
    p_other *= 3.0 / p_other[:, 2:]
    p_current = (p_other - T[:3, 3]) @ T[:3, :3]
    looks = descriptors(rng, count)
    other = features(p_other, looks, wall_depth(np.eye(4)))
    return features(p_current, looks, wall_depth(T)), other, T


def assert_close(T, truth, tolerance=EXACT):
    metres, _ = distance(T, truth)
    radians = Rotation.from_matrix(truth[:3, :3].T @ T[:3, :3]).magnitude()
    assert metres < tolerance and radians < tolerance


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_exact_points_give_the_exact_motion(seed):
    rng = np.random.default_rng(seed)
    T = motion(rng)
    pairs = pairs_of(T, cloud(rng, 40))
    found = ransac.ransac(pairs, 0)
    assert found is not None
    refined, inlier = ransac.by_inliers(pairs, found)
    assert inlier.all()
    assert_close(refined, T)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("seed", range(5))
def test_outliers_change_nothing(seed, share):
    rng = np.random.default_rng(seed)
    T = motion(rng)
    p_current, p_other = pairs_of(T, cloud(rng, 100))
    wrong = rng.permutation(100)[: int(100 * share)]
    p_other[wrong] = cloud(rng, len(wrong))
    pairs = ransac.Pairs(p_current, p_other)
    found = ransac.ransac(pairs, 0)
    assert found is not None
    refined, inlier = ransac.by_inliers(pairs, found)
    right = np.delete(np.arange(100), wrong)
    assert inlier[right].all()
    # an outlier or two may lie within the gate by chance; their pull is bounded by the noise assumed
    assert_close(refined, T, EXACT if inlier.sum() == len(right) else 0.01)


def test_refinement_beats_distances_where_depth_is_noisy():
    """Oracle: the least-squares motion of the points, which trusts depth and direction alike."""
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        T = motion(rng)
        p_current, p_other = pairs_of(T, cloud(rng, 60))
        noisy = [
            p * (1 + rng.normal(size=(60, 1)) * ransac.depth_noise(p[:, 2:]) / p[:, 2:])
            for p in (p_current, p_other)
        ]
        pairs = ransac.Pairs(*noisy)
        refined, _ = ransac.by_inliers(pairs, T)
        errors.append([distance(found, T)[0] for found in (refined, align_rigid(*noisy))])
    ours, oracle = np.median(errors, axis=0)
    assert ours < oracle
    assert ours < 0.02  # a third of one point's noise


def test_jacobian_is_the_derivative():
    rng = np.random.default_rng(0)
    T = motion(rng)
    pairs, step = pairs_of(T, cloud(rng, 5)), 1e-6
    for axis in range(6):
        twist = step * np.eye(6)[axis]
        moved = [T.copy(), T.copy()]
        for sign, M in zip((1, -1), moved, strict=True):
            M[:3, :3] = Rotation.from_rotvec(sign * twist[3:]).as_matrix() @ T[:3, :3]
            M[:3, 3] += sign * twist[:3]
        ahead, back = (ransac._residuals(transform(M, pairs.p_current), pairs.p_other) for M in moved)
        # residuals of order 100 per unit, central differences: relative error 1e-8 or so
        np.testing.assert_allclose(
            ransac._jacobian(pairs, T)[..., axis], (ahead - back) / (2 * step), atol=1e-4
        )


def test_deviation_predicts_the_scatter():
    rng = np.random.default_rng(0)
    T, p = motion(rng), cloud(rng, 40)
    errors = []
    for _ in range(100):
        p_current, p_other = pairs_of(T, p)
        z = p_other[:, 2:] + rng.normal(size=(40, 1)) * ransac.depth_noise(p_other[:, 2:])
        aside = p_other[:, :2] / p_other[:, 2:] + rng.normal(size=(40, 2)) * ransac.DIRECTION_NOISE
        noisy = ransac.Pairs(p_current, np.concatenate([aside * z, z], axis=1))
        errors.append(distance(ransac.by_inliers(noisy, T)[0], T)[0])
    position, _ = ransac.deviation(pairs_of(T, p), T)
    # three axes, of which `position` is the greatest; robust weights cost some efficiency
    assert 0.7 * position < np.sqrt(np.mean(np.square(errors))) < 3**0.5 * 1.3 * position


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points_give_nothing(count):
    assert ransac.ransac(pairs_of(np.eye(4), np.ones((count, 3))), 0) is None


def test_points_in_a_row_are_no_hypothesis():
    p = np.outer(np.linspace(1, 3, 30), [0.1, 0.2, 1.0])
    assert ransac.ransac(pairs_of(np.eye(4), p), 0) is None


def test_points_in_a_row_are_not_believed():
    """Nearly collinear points pass as triples and as inliers; the turn about their line is what is missing."""
    rng = np.random.default_rng(0)
    p = np.stack([np.linspace(-1.5, 1.5, 60), np.zeros(60), np.full(60, 3.0)], 1)
    _, turned = ransac.deviation(pairs_of(np.eye(4), p), np.eye(4))
    assert turned > 1.0
    small = cloud(rng, 60) * 0.02 + [0, 0, 3.0]
    position, _ = ransac.deviation(pairs_of(np.eye(4), small), np.eye(4))
    assert position > MAX_DEVIATION_M


def test_two_views_of_a_wall():
    current, other, T = wall_pair()
    found = relative_pose(current, other, CAMERA, 0)
    assert found.ok and found.inliers == found.matches == 200
    assert_close(found.T_other_current, T)
    assert found.rmse_m < EXACT
    assert found.agreement == 1.0


def test_back_and_forth_are_inverse():
    current, other, _ = wall_pair(1)
    there, back = relative_pose(current, other, CAMERA, 0), relative_pose(other, current, CAMERA, 0)
    assert_close(there.T_other_current @ back.T_other_current, np.eye(4))


def test_the_same_seed_gives_the_same_bits():
    current, other, _ = wall_pair(2)
    first, second = (relative_pose(current, other, CAMERA, 7) for _ in range(2))
    assert first.T_other_current.tobytes() == second.T_other_current.tobytes()
    assert first[1:] == second[1:]


def test_perfect_matches_with_other_surfaces_around_are_not_believed():
    """Two equal objects in two rooms: every match fits, but one room is deeper."""
    current, other, _ = wall_pair()
    deeper = other._replace(depth=other.depth + np.float32(1.0))
    found = relative_pose(current, deeper, CAMERA, 0)
    assert found.inliers == 200 and not found.ok
    assert found.agreement < 0.1


def test_hidden_depth_is_left_out_and_depth_seen_through_contradicts():
    """One view has a wall, the other a board before half of it."""
    T, wall = np.eye(4), wall_depth(np.eye(4))
    board = wall.copy()
    board[:, 20:] = 1.0
    agreement, coverage = depth_agreement(
        features(np.ones((1, 3)), np.zeros((1, 64), np.uint8), wall),
        features(np.ones((1, 3)), np.zeros((1, 64), np.uint8), board),
        T,
        CAMERA,
    )
    # from the wall the board hides half; from the board half is seen through
    assert agreement == pytest.approx(2 / 3, abs=0.05) and coverage == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_features_give_no_motion(count):
    rng = np.random.default_rng(0)
    few = features(cloud(rng, count), descriptors(rng, count))
    many = features(cloud(rng, 50), descriptors(rng, 50))
    for a, b in ((few, many), (many, few), (few, few)):
        found = relative_pose(a, b, CAMERA, 0)
        assert isinstance(found, Match) and not found.ok
        assert np.isfinite(found.T_other_current).all()


def test_matches_are_one_to_one():
    rng = np.random.default_rng(3)
    looks = descriptors(rng, 60)
    a = features(cloud(rng, 60), looks)
    b = features(cloud(rng, 60), looks[::-1].copy())
    rows = match_all(a, b)
    np.testing.assert_array_equal(rows, np.stack([np.arange(60), 59 - np.arange(60)], 1))
    doubled = features(cloud(rng, 120), np.concatenate([looks, looks]))
    assert len(match_all(a, doubled)) == 0  # the second best is as good


def test_real_frames_apart_and_frames_of_another_place(shared_data):
    kitchen = open_sequence(str(shared_data / "redkitchen"), frames=slice(0, 1000, 10))
    living = open_sequence(str(shared_data / "small_house" / "living"), frames=slice(0, 369, 10))

    def seen(sequence, i):
        return detect(sequence[i].color, sequence[i].depth, sequence.intrinsics)

    truth = kitchen.T_world_cam
    assert truth is not None
    for i, j in ((0, 2), (40, 43), (70, 72)):
        found = relative_pose(seen(kitchen, i), seen(kitchen, j), kitchen.intrinsics, 0)
        metres, radians = distance(found.T_other_current, np.linalg.inv(truth[j]) @ truth[i])
        # true poses are good to 6 mm over 10 frames
        assert found.ok and metres < 0.05 and np.degrees(radians) < 3
    for i in (0, 10, 30):
        assert not relative_pose(seen(kitchen, i), seen(living, i), kitchen.intrinsics, 0).ok
