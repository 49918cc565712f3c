"""Mapping of an analytic scene: what is learned, which poses move, and what must leave no trace."""

from __future__ import annotations

from dataclasses import replace

import corner
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from corner import CAMERA, CFG, VIEWS, apart, pose

from compilations import compilations
from mipsjax.core import draws, mapping

KEY = jax.random.key(2)


def refine(submap, frames, steps, key=KEY):
    return mapping.refine(submap, frames, jnp.int32(steps), key, CAMERA, CFG)


def same_bits(a, b) -> bool:
    return all(
        np.array_equal(x, y, equal_nan=True) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)
    )


@pytest.fixture(scope="module")
def fresh() -> mapping.Learned:
    return mapping.create(jax.random.key(0), CFG)


@pytest.fixture(scope="module")
def loss():
    """The mapping loss on a fixed draw, as a function of the field and the frames."""
    return jax.jit(lambda field, frames: mapping.map_loss(field, frames, KEY, CAMERA, CFG)[0])


@pytest.fixture(scope="module")
def jolted(corner_frames) -> draws.Frames:
    """The movable frames 1 cm and half a degree off, each in another direction."""
    jolts = [
        pose(),
        pose((0.5, 0, 0), (0.01, 0, 0)),
        pose((0, 0.5, 0), (0, -0.01, 0)),
        pose((0, 0, -0.5), (0, 0, 0.01)),
        pose((-0.3, 0.3, 0.3), (-0.006, 0.006, -0.006)),
    ]
    return corner_frames._replace(T_sub_cam=(VIEWS @ np.stack(jolts)).astype(np.float32))


def test_the_loss_decreases(fresh, corner_map, corner_frames, loss):
    before = float(loss(fresh.field, corner_frames))
    after, _, info = refine(fresh, corner_frames, 60)
    assert bool(info.ok) and np.isfinite(info.loss)
    assert float(loss(after.field, corner_frames)) < 0.5 * before
    assert float(loss(corner_map.field, corner_frames)) < float(loss(after.field, corner_frames))


def test_the_gradient_does_not_depend_on_the_chunks(fresh, corner_frames, monkeypatch):
    def gradient():
        return jax.jit(lambda field: mapping.map_loss(field, corner_frames, KEY, CAMERA, CFG))(fresh.field)

    whole = gradient()
    monkeypatch.setattr(draws, "CHUNK_SAMPLES", 300)
    assert draws.draw(fresh.field, corner_frames, KEY, CAMERA, CFG).frame.shape[0] > 5
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(gradient()), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * np.abs(one).max())


def test_samples_around_the_surface_do_not_depend_on_the_chunks(fresh, corner_frames, monkeypatch):
    cfg = replace(CFG, sample=replace(CFG.sample, surface=3))
    frames = jax.tree.map(jnp.asarray, corner_frames)

    def depth():
        drawn = draws.draw(fresh.field, frames, KEY, CAMERA, cfg).samples.depth
        return np.asarray(drawn).reshape(-1, drawn.shape[-1])

    whole = depth()
    monkeypatch.setattr(draws, "CHUNK_SAMPLES", 300)
    same = np.isclose(depth(), whole, rtol=0, atol=1e-6).all(1)
    # Of two samples with about the same distance, rounding may choose the other
    assert same.mean() > 0.98


def test_poses_are_corrected_and_the_anchor_stays(corner_map, jolted):
    _, poses, info = refine(corner_map, jolted, 40)
    assert bool(info.ok)
    np.testing.assert_array_equal(poses[0], jolted.T_sub_cam[0])
    for before, after, truth in zip(jolted.T_sub_cam[1:], np.asarray(poses)[1:], VIEWS[1:], strict=True):
        (off_m, off_deg), (left_m, left_deg) = apart(before, truth), apart(after, truth)
        # The field has errors of 1 to 2 mm of its own
        assert left_m < 0.5 * off_m and left_deg < 0.6 * off_deg


def test_frames_that_may_not_move_do_not(corner_map, jolted):
    _, poses, _ = refine(corner_map, jolted._replace(movable=np.zeros(5, bool)), 3)
    np.testing.assert_array_equal(poses, jolted.T_sub_cam)


def test_networks_learn_the_same_whether_poses_learn_or_not(fresh, corner_frames):
    fixed = replace(CFG, map=replace(CFG.map, pose_learning_rate=0.0))

    def gradient(cfg):
        return jax.jit(lambda field: mapping.map_loss(field, corner_frames, KEY, CAMERA, cfg)[1])(fresh.field)

    (expected, moving), (networks, still) = gradient(CFG), gradient(fixed)
    assert np.any(moving) and not np.any(still)
    for one, other in zip(jax.tree.leaves(expected), jax.tree.leaves(networks), strict=True):
        # The two programs may round differently
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5 * np.abs(one).max())


def test_poses_stay_rigid(corner_map, jolted):
    _, poses, _ = refine(corner_map, jolted, 40)
    for T in np.asarray(poses, np.float64):
        np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)
        np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_any_number_of_steps_shares_one_compilation(fresh, corner_frames):
    refine(fresh, corner_frames, 1)
    with compilations() as compiled:
        three, five = (refine(fresh, corner_frames, n) for n in (3, 5))
        assert not compiled
        jax.jit(lambda x: x * 3)(np.float32(1))
        assert compiled, "the listener hears compilations"
    assert not same_bits(three[0], five[0])


def test_no_steps_change_nothing(corner_map, jolted):
    after, poses, info = refine(corner_map, jolted, 0)
    assert same_bits(after, corner_map) and same_bits(poses, jolted.T_sub_cam) and bool(info.ok)


def spoil(frames: draws.Frames, where: str) -> draws.Frames:
    broken = np.array(getattr(frames, where))
    broken[2] = np.nan
    return frames._replace(**{where: broken})


@pytest.mark.parametrize("where", ["depth", "T_sub_cam"])
def test_input_that_is_not_finite_leaves_everything_as_before(corner_map, jolted, where):
    frames = spoil(jolted, where)
    after, poses, info = refine(corner_map, frames, 3)
    assert not bool(info.ok)
    assert same_bits(after, corner_map)
    assert same_bits(poses, frames.T_sub_cam)


def test_frames_without_any_depth_are_harmless(corner_map, corner_frames):
    blind = corner_frames._replace(depth=np.zeros_like(corner_frames.depth))
    after, poses, info = refine(corner_map, blind, 3)
    assert bool(info.ok) and float(info.loss) == 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((after, poses)))


def test_the_same_key_gives_the_same_bits(corner_map, jolted):
    assert same_bits(refine(corner_map, jolted, 5), refine(corner_map, jolted, 5))
    assert not same_bits(refine(corner_map, jolted, 5), refine(corner_map, jolted, 5, jax.random.key(3)))


def test_every_new_submap_has_the_same_shapes(fresh, corner_map):
    for a, b in zip(*map(jax.tree.leaves, (fresh, corner_map)), strict=True):
        assert a.shape == b.shape and a.dtype == b.dtype


def test_the_slope_of_the_surface_in_closed_form():
    """|n . ray| of each pixel, n the normal of the one wall that a camera in front of it sees."""
    turn = pose((10.0, -25.0, 0.0), (1.5, -1.0, 0.0))
    depth, _ = corner.see(turn)
    v, u = (a.ravel() for a in np.mgrid[4:92:7, 4:124:7])
    hit = corner.unprojected(depth, turn, v, u)
    near_edge = np.sort(np.abs(hit - corner.WALLS), 1)[:, 1] < 0.2
    wall = np.abs(hit - corner.WALLS).argmin(1)
    expected = np.abs((corner.rays(v, u) @ turn[:3, :3].T)[np.arange(len(u)), wall])
    slope = np.asarray(draws.surface_slope(depth, v, u, CAMERA, CFG))
    plain = ~near_edge & (expected > 0.3)
    assert plain.sum() > 50
    # Differences of a float32 depth over 4 pixels, 7 cm apart at 2 m: 1e-6 / 0.07 of the slope
    np.testing.assert_allclose(slope[plain], np.clip(expected[plain], 0.25, 1.0), rtol=2e-3)


def test_pixels_are_drawn_from_where_they_say(corner_frames):
    cfg = replace(CFG, sample=replace(CFG.sample, perpendicular=True))
    drawn = draws.draw_pixels(KEY, corner_frames.depth[0], corner_frames.color[0], CAMERA, cfg)
    u = np.rint(np.asarray(drawn.ray[:, 0]) * CAMERA.fx + CAMERA.cx).astype(int)
    v = np.rint(np.asarray(drawn.ray[:, 1]) * CAMERA.fy + CAMERA.cy).astype(int)
    np.testing.assert_array_equal(drawn.depth, corner_frames.depth[0][v, u])
    np.testing.assert_allclose(drawn.color, corner_frames.color[0][v, u] / 255, atol=1e-6)
    assert drawn.slope.min() >= 0.25 and drawn.slope.max() <= 1
