"""Features: which keypoints keep a point, awkward images, retrieval, the same bits on any number of threads."""

import cv2
import numpy as np
import pytest

from mipsjax.core.camera import Intrinsics
from mipsjax.data.open import open_sequence
from mipsjax.images.features import (
    CONTRAST,
    LARGEST,
    MAX_DETECTED,
    MAX_FEATURES,
    UNIT,
    VOTED,
    Features,
    detect,
    packed,
    similar,
    squared_distances,
    unpacked,
)

CAMERA = Intrinsics(290.0, 290.0, 159.5, 119.5, 320, 240)
FLAT = np.full((240, 320), 2.0, np.float32)


def picture(seed=0, size=(240, 320)):
    """Smooth random blobs: texture at every scale."""
    rng = np.random.default_rng(seed)
    grey = sum(
        cv2.resize(rng.uniform(size=(n, n)).astype(np.float32), size[::-1], interpolation=cv2.INTER_CUBIC)
        for n in (8, 16, 32, 64)
    )
    grey = np.clip(grey * 64, 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def bits(found: Features) -> bytes:
    return b"".join(array.tobytes() for array in found)


def looking(seed, count=100):
    """Features of a place of its own: unrelated descriptors."""
    d = np.abs(np.random.default_rng(seed).normal(size=(count, 128)))
    d = np.minimum(np.rint(UNIT * d / np.linalg.norm(d, axis=1, keepdims=True)), LARGEST).astype(np.uint8)
    return Features(packed(d), np.zeros((count, 3), np.float32), np.zeros((30, 40), np.float32))


def pixels(found: Features):
    """(u, v) that the points project to."""
    return found.p_cam[:, :2] / found.p_cam[:, 2:] * 290.0 + np.float32([159.5, 119.5])


@pytest.mark.parametrize("axis", [0, 1])
def test_points_lie_where_the_depth_of_their_pixels_is(axis):
    slope = np.linspace(0, 1, FLAT.shape[axis], dtype=np.float32)
    depth = FLAT + (slope[None] if axis else slope[:, None])
    found = detect(picture(), depth, CAMERA)
    assert 100 < len(found.descriptors) <= MAX_FEATURES
    assert len(found.p_cam) == len(found.descriptors)
    u, v = np.rint(pixels(found)).astype(int).T
    # the median of the square around lies at most a pixel's slope from the middle
    np.testing.assert_allclose(found.p_cam[:, 2], depth[v, u], atol=1.01 / (len(slope) - 1))


def test_points_project_to_keypoints():
    """Of the whole detector, with their half pixel."""
    image = picture()
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    sift = cv2.SIFT.create(nfeatures=MAX_DETECTED, contrastThreshold=CONTRAST)
    keypoints = np.array([k.pt for k in sift.detect(grey, None)], np.float32)
    away = np.linalg.norm(pixels(detect(image, FLAT, CAMERA))[:, None] - keypoints[None], axis=2)
    assert away.min(axis=1).max() < 1e-3  # single precision of 320 pixels


def test_descriptors_have_their_length():
    found = detect(picture(), FLAT, CAMERA)
    length = np.linalg.norm(unpacked(found.descriptors).astype(float), axis=1)
    # rounding 128 components by up to a half, and components cut at the largest
    assert np.all(length < UNIT + 6) and np.median(length) > UNIT - 6


def test_packing_keeps_every_component():
    components = np.random.default_rng(0).integers(0, LARGEST + 1, (50, 128)).astype(np.uint8)
    assert packed(components).shape == (50, 64)
    np.testing.assert_array_equal(unpacked(packed(components)), components)


def test_distances_are_exact():
    a, b = looking(0).descriptors, looking(1).descriptors
    difference = unpacked(a)[:, None].astype(np.int64) - unpacked(b)[None].astype(np.int64)
    exact = np.sum(difference**2, axis=2).astype(np.float32)
    np.testing.assert_array_equal(squared_distances(a, b), exact / np.float32(UNIT**2))


def test_no_feature_where_depth_is_missing_or_broken():
    depth = FLAT.copy()
    depth[:, :100] = 0
    depth[:, 100:140] = np.nan
    depth[:, 140:160] = np.inf
    depth[:, 160:180] = -1
    found = detect(picture(), depth, CAMERA)
    assert len(found.p_cam) > 20
    assert pixels(found)[:, 0].min() > 178
    assert np.isfinite(found.p_cam).all() and np.isfinite(found.depth).all()


def test_no_feature_at_the_edge_of_an_object():
    depth = FLAT.copy()
    depth[:, 160:] = 3.0
    u = pixels(detect(picture(), depth, CAMERA))[:, 0]
    # columns 159 and 160 have both depths within their square
    assert not np.any((u > 158.5) & (u < 160.5))
    assert np.any((u > 155) & (u < 158.5)) and np.any((u > 160.5) & (u < 164))


@pytest.mark.parametrize("color", [0, 128, 255])
def test_an_image_without_texture_has_no_features(color):
    found = detect(np.full((240, 320, 3), color, np.uint8), FLAT, CAMERA)
    assert found.descriptors.shape == (0, 64) and found.p_cam.shape == (0, 3)


def test_no_depth_no_features():
    found = detect(picture(), np.zeros_like(FLAT), CAMERA)
    assert len(found.descriptors) == 0 and not found.depth.any()


def test_sizes_must_fit_the_camera():
    with pytest.raises(ValueError, match="expected"):
        detect(picture(), FLAT[:120], CAMERA)


def test_bounded_size():
    found = detect(picture(), FLAT, CAMERA)
    assert sum(array.nbytes for array in found) <= MAX_FEATURES * 76 + 40 * 30 * 4


def test_a_wide_image_gives_the_same_points():
    """Twice the working width: keypoints of the reduced image, in pixels of the whole one."""
    image = picture(3, (480, 640))
    camera = Intrinsics(580.0, 580.0, 319.5, 239.5, 640, 480)
    whole = detect(image, np.full((480, 640), 2.0, np.float32), camera)
    doubled = cv2.resize(image, (1280, 960), interpolation=cv2.INTER_NEAREST)
    wide = detect(doubled, np.full((960, 1280), 2.0, np.float32), camera.resized(1280, 960))
    np.testing.assert_array_equal(wide.descriptors, whole.descriptors)
    np.testing.assert_allclose(wide.p_cam, whole.p_cam, atol=1e-5)


def test_the_same_bits_on_any_number_of_threads():
    before = cv2.getNumThreads()
    try:
        results = []
        for threads in (1, 2, 4):
            cv2.setNumThreads(threads)
            results.append(bits(detect(picture(1), FLAT, CAMERA)))
    finally:
        cv2.setNumThreads(before)
    assert results[0] == results[1] == results[2]


def test_a_known_place_is_found_among_others():
    database = [looking(seed) for seed in range(30)]
    rng = np.random.default_rng(0)
    disturbed = unpacked(database[17].descriptors).astype(int) + rng.integers(-1, 2, size=(100, 128))
    current = database[17]._replace(descriptors=packed(np.clip(disturbed, 0, LARGEST).astype(np.uint8)))
    assert similar(current, database, 3)[0] == 17
    assert similar(current, database, 3) == similar(current, database, 30)[:3]


def test_keyframes_without_features_are_never_named():
    nothing = looking(0, 0)
    assert similar(looking(1), [], 5) == []
    assert similar(looking(1), [nothing, nothing], 5) == []
    assert similar(nothing, [looking(1)], 5) == []
    assert similar(looking(2), [nothing, looking(2), nothing, looking(3)], 5) == [1, 3]
    assert similar(looking(2), [looking(2)], 0) == []


def test_only_the_largest_features_vote():
    place = looking(0, VOTED + 50)
    changed = place._replace(
        descriptors=np.concatenate([looking(9, VOTED).descriptors, place.descriptors[VOTED:]])
    )
    others = [looking(seed) for seed in range(20, 40)]
    assert similar(place, [*others, changed, place], 1) == [21]


def test_real_frames_find_their_neighbours(shared_data):
    sequence = open_sequence(str(shared_data / "redkitchen"), frames=slice(0, 1000, 50))
    found = [detect(sequence[i].color, sequence[i].depth, sequence.intrinsics) for i in range(len(sequence))]
    assert min(len(f.descriptors) for f in found) > 100
    assert [similar(f, found, 1)[0] for f in found] == list(range(len(found)))
