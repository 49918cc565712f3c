"""Depth images of a room with a pillar, at the poses they were taken from and at others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics
from mipsjax.data.open import open_sequence
from mipsjax.uncertainty.agreement import (
    LIMIT,
    WINDOW,
    Agreement,
    Noise,
    Views,
    agreement,
    looked_through,
    pairs_of,
    surfaces,
)

CAMERA = Intrinsics(41.0, 41.0, 22.5, 17.0, 46, 35)
NOISE = Noise(0.01, 0.002)
COUNT = 60
STEP = 30
"""The view at which a slide begins."""
ROOM = np.array([2.5, 1.3, 3.0])
"""Metres, half the sides; y is down."""
PILLAR = np.array([0.3, 1.3, 0.3])


def rays() -> Float64[np.ndarray, "h w 3"]:
    x = (np.arange(CAMERA.width) - CAMERA.cx) / CAMERA.fx
    y = (np.arange(CAMERA.height) - CAMERA.cy) / CAMERA.fy
    return np.stack(np.broadcast_arrays(x[None], y[:, None], 1.0), -1)


def poses() -> Float64[np.ndarray, "N 4 4"]:
    """Round the pillar, looking past it: a third of the way, with the view ahead."""
    out = np.tile(np.eye(4), (COUNT, 1, 1))
    angle = np.linspace(0, 2.0, COUNT)
    out[:, :3, 3] = np.stack([1.5 * np.sin(angle), 0.1 * np.sin(3 * angle), -1.5 * np.cos(angle)], -1)
    out[:, :3, :3] = Rotation.from_euler("y", (0.4 - angle)[:, None]).as_matrix()
    return out


def seen(T_world_cam: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "h w"]:
    """Exact depth, by the slabs of the two boxes."""
    direction = rays() @ T_world_cam[:3, :3].T
    place = T_world_cam[:3, 3]
    with np.errstate(divide="ignore"):
        walls = np.maximum((ROOM - place) / direction, (-ROOM - place) / direction).min(-1)
        sides = np.stack([(PILLAR - place) / direction, (-PILLAR - place) / direction])
    enter, leave = sides.min(0).max(-1), sides.max(0).min(-1)
    return np.where((enter < leave) & (enter > 0), np.minimum(enter, walls), walls)


@pytest.fixture(scope="module")
def room() -> Views:
    T_world_cam = poses()
    return Views(np.stack([seen(T) for T in T_world_cam]), T_world_cam, CAMERA)


def judged(views: Views) -> Agreement:
    found = agreement(views, NOISE)
    assert found is not None
    return found


def moved(views: Views, turn_deg: float, shift_m: float) -> Views:
    """All views from `STEP` on with one and the same error, as after a slide."""
    error = np.eye(4)
    error[:3, :3] = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    error[:3, 3] = views.T_world_cam[STEP, :3, :3] @ [0, 0, shift_m]
    T_world_cam = views.T_world_cam.copy()
    T_world_cam[STEP:] = error @ T_world_cam[STEP:]
    return views._replace(T_world_cam=T_world_cam)


def noisy(depth: Float[np.ndarray, "N h w"], deviations: float) -> Float[np.ndarray, "N h w"]:
    return depth + deviations * NOISE(depth) * np.random.default_rng(0).standard_normal(depth.shape)


def by_disparity(depth: Float[np.ndarray, "N h w"]) -> Float[np.ndarray, "N h w"]:
    """Steps of a structured-light sensor: 3 mm at 1 m, 27 mm at 3 m."""
    return 1 / (np.round(1 / depth / 0.003) * 0.003)


def with_holes(depth: Float[np.ndarray, "N h w"]) -> Float[np.ndarray, "N h w"]:
    """A tenth is missing, and with it every surface that needs a pixel beside it."""
    return np.where(np.random.default_rng(0).random(depth.shape) < 0.1, 0, depth)


RIGHT = {
    "exact": lambda depth: depth,
    "noise": lambda depth: noisy(depth, 1.0),
    "steps": by_disparity,
    "holes": with_holes,
    "a shadow": lambda depth: np.where(np.arange(CAMERA.width) < 10, 0, depth),
    "far away": lambda depth: np.where(depth > 3, noisy(depth, 2.0), depth),
}
WRONG = {
    "along the ray": lambda depth: depth * np.linalg.norm(rays(), axis=-1),
    "whole metres": np.round,
    "a tenth too long": lambda depth: 1.1 * depth,
}


@pytest.mark.parametrize("name", RIGHT)
def test_what_is_measured_right_is_not_looked_through(room: Views, name: str) -> None:
    found = judged(room._replace(depth=RIGHT[name](room.depth)))
    # A third of the limit: far from being called wrong
    assert found.begins is None and found.worst.share < LIMIT / 3


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_model_of_depth_is_seen(room: Views, name: str) -> None:
    found = judged(room._replace(depth=noisy(WRONG[name](room.depth), 0.5)))
    assert found.begins is not None and found.worst.share > 2 * LIMIT


@pytest.mark.parametrize(("turn_deg", "shift_m"), [(5.0, 0.0), (0.0, 0.3), (0.0, -0.3)])
def test_a_slide_is_seen_and_where_it_began(room: Views, turn_deg: float, shift_m: float) -> None:
    found = judged(moved(room._replace(depth=noisy(room.depth, 0.5)), turn_deg, shift_m))
    assert found.worst.share > LIMIT and found.begins is not None
    assert found.begins.first < STEP <= found.begins.last < STEP + 2 * WINDOW


def test_the_world_frame_does_not_matter(room: Views) -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), (10, -20, 5)
    _, here = looked_through(moved(room, 5.0, 0.0), NOISE)
    elsewhere = moved(room, 5.0, 0.0)
    _, there = looked_through(elsewhere._replace(T_world_cam=T @ elsewhere.T_world_cam), NOISE)
    # Single precision: a tile at the limit may fall to either side
    assert np.nanmax(np.abs(here - there)) < 0.05


def test_who_walks_through_the_view_is_no_contradiction(room: Views) -> None:
    """A column half a metre wide, 1.2 m away, that crosses the image within 20 views."""
    depth = room.depth.copy()
    half = round(0.25 / 1.2 * CAMERA.fx)
    for view in range(20, 40):
        middle = round((view - 20) / 20 * CAMERA.width)
        columns = slice(max(0, middle - half), middle + half)
        depth[view, :, columns] = np.minimum(depth[view, :, columns], 1.2)
    found = judged(room._replace(depth=depth))
    assert found.begins is None


def test_a_long_way_round_may_drift_as_usual(room: Views) -> None:
    """The same slide counts less in pairs with a long path between them."""
    T_world_cam = np.concatenate([room.T_world_cam, room.T_world_cam])
    T_world_cam[COUNT:, 0, 3] += 0.15
    twice = Views(np.concatenate([room.depth, room.depth]), T_world_cam, CAMERA)
    pairs, near = looked_through(twice, NOISE)
    far_apart = np.zeros((1, 4, 4)) + np.eye(4)
    far_apart[0, 0, 3] = 20.0
    depth = np.concatenate([room.depth, np.zeros((1, *room.depth.shape[1:])), room.depth])
    T_world_cam = np.concatenate([room.T_world_cam, far_apart, T_world_cam[COUNT:]])
    pairs_round, far = looked_through(Views(depth, T_world_cam, CAMERA), NOISE)
    across = (pairs.earlier < COUNT) & (pairs.later >= COUNT)
    across_round = (pairs_round.earlier < COUNT) & (pairs_round.later > COUNT)
    assert np.nanmax(near[across]) > 2 * LIMIT
    assert np.nanmedian(far[across_round]) < np.nanmedian(near[across])


@pytest.mark.parametrize("count", [0, 1, 2, WINDOW])
def test_a_few_views_give_no_verdict(room: Views, count: int) -> None:
    few = Views(room.depth[:count], room.T_world_cam[:count], CAMERA)
    assert agreement(few, NOISE) is None


def test_views_without_depth_or_overlap_give_no_verdict(room: Views) -> None:
    assert agreement(room._replace(depth=np.zeros_like(room.depth)), NOISE) is None
    apart = room.T_world_cam.copy()
    apart[:, 0, 3] += 50 * np.arange(COUNT)
    assert agreement(room._replace(T_world_cam=apart), NOISE) is None


def test_images_too_small_for_tiles_give_no_verdict(room: Views) -> None:
    small = Views(room.depth[:, :6, :6], room.T_world_cam, CAMERA.cropped(0, 0, 6, 6))
    assert agreement(small, NOISE) is None


def test_pairs_are_near_in_place_and_of_every_distance_in_time() -> None:
    """A camera that comes back to where it was: it is paired with that time."""
    there_and_back = np.concatenate([poses(), poses()[::-1]])
    pairs = pairs_of(there_and_back, np.full(len(there_and_back), 2.5))
    gap = pairs.later - pairs.earlier
    assert ((gap >= 2 << pairs.level) & (gap < 4 << pairs.level)).all()
    last = pairs.later == len(there_and_back) - 1
    assert pairs.earlier[last].min() == 0


def test_edges_and_grazing_surfaces_are_left_out() -> None:
    """A step in depth, and a floor seen to the horizon."""
    step = np.where(np.arange(CAMERA.width) < 20, 1.5, 2.5) * np.ones((1, CAMERA.height, 1))
    kept = surfaces(step, CAMERA, NOISE)
    assert not kept[0, :, 19:21].any() and kept[0, 1:-1, 2:18].all() and kept[0, 1:-1, 22:-1].all()
    floor = 0.3 / np.maximum(rays()[None, ..., 1], 0.02)
    kept = surfaces(floor, CAMERA, NOISE)
    # Tangent of the angle to the normal, 1 / y, over the limit
    grazing = (rays()[..., 1] > 0.05) & (rays()[..., 1] < 0.2)
    assert not kept[0][grazing].any() and kept[0][-5:-1, 1:-1].all()


def test_bookstore(shared_data: Path) -> None:
    """Rendered with a sensor's noise, with exact poses; and as if depth were measured along the ray."""
    sequence = open_sequence(shared_data / "bookstore", frames=slice(0, 180, 3))
    depth = np.stack(
        [frame.depth for i in range(len(sequence)) if (frame := sequence[i].cleaned()).depth is not None]
    )
    assert sequence.T_world_cam is not None
    camera = sequence.intrinsics.decimated(7)
    right = Views(depth[:, ::7, ::7], sequence.T_world_cam, camera)
    found = judged(right)
    assert found.begins is None and found.worst.share < LIMIT / 3
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    along = np.sqrt(1 + x[None] ** 2 + y[:, None] ** 2)
    found = judged(right._replace(depth=right.depth * along))
    assert found.begins is not None and found.worst.share > 2 * LIMIT
