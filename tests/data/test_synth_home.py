"""Homes drawn from a seed: what every one of them must be, by plan and path alone, and a few rendered."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax.config import InputConfig
from mipsjax.data.synth import open_synth, synth_names
from mipsjax.data.synth.__main__ import main
from mipsjax.data.synth.catalog import Spec, find
from mipsjax.data.synth.draws import Draws
from mipsjax.data.synth.home import home
from mipsjax.data.synth.home_furnish import furnished, outside
from mipsjax.data.synth.home_plan import MOST_ROOMS, WALL, Plan, home_plan
from mipsjax.data.synth.home_route import room_order, route
from mipsjax.data.synth.home_walk import FAST, SLOW, Tempo
from mipsjax.data.synth.mesh import reference_mesh
from mipsjax.data.synth.path import speeds
from mipsjax.errors import InputError

SEEDS = range(101, 161)
# Poses are checked so many times a second
OFTEN = 60.0
# A home of one room and of few shapes, and one of several rooms with windows
SMALL_HOME, LARGE_HOME = 106, 105
NARROW = InputConfig(working_width=80)

distance = jax.jit(lambda scene, points: scene.distance(points))


def spec(seed: int, tempo: Tempo) -> Spec:
    found = find(f"home-{seed}-fast" if tempo is FAST else f"home-{seed}")
    assert found is not None
    return found


@lru_cache(maxsize=2 * len(SEEDS))
def poses(seed: int, tempo: Tempo) -> np.ndarray:
    found = spec(seed, tempo)
    return found.path().poses(np.arange(0.0, (found.frames - 1) / found.fps, 1.0 / OFTEN))


def free_of_walls(plan: Plan, places: np.ndarray) -> np.ndarray:
    """A lower bound of the distances from the walls: the greatest to the ends of a room or an opening."""
    boxes = [(room.cell.low, room.cell.high) for room in plan.rooms]
    for door in plan.doors:
        half = [door.width / 2, door.width / 2]
        half[door.axis] = WALL / 2 + 0.8
        boxes.append((tuple(np.subtract(door.place, half)), tuple(np.add(door.place, half))))
    inner = [np.min(np.minimum(places - low, high - places), axis=1) for low, high in boxes]
    return np.max(inner, axis=0)


# Draws


def test_draws_are_the_same_bits_everywhere() -> None:
    """Values of NumPy 2.0; other versions must give the same ones."""
    draws = Draws(1, 2)
    assert [draws.between(0.0, 100.0) for _ in range(3)] == [44.84, 43.09, 42.0]
    assert Draws(1, 2).shuffled("abcdefg") == ["f", "g", "d", "c", "b", "a", "e"]


def test_draws_have_a_range_and_no_favourite() -> None:
    draws = Draws(3)
    assert {draws.pick((1, 2, 3)) for _ in range(50)} == {1, 2, 3}
    assert all(2.0 <= draws.between(2.0, 2.5) <= 2.5 for _ in range(50))
    assert 0.2 < np.mean([draws.chance(0.3) for _ in range(500)]) < 0.4


# Every home


def test_homes_of_all_sizes_occur_and_walks_of_both_kinds() -> None:
    plans = [home_plan(seed) for seed in SEEDS]
    assert {plan.room_count() for plan in plans} == set(range(1, MOST_ROOMS + 1))
    assert 0.3 < np.mean([plan.returns for plan in plans]) < 0.8
    alike = [len({room.style for room in plan.rooms}) < len(plan.rooms) for plan in plans]
    assert 0.15 < np.mean(alike) < 0.6
    assert any(room.use == "corridor" for plan in plans for room in plan.rooms)


@pytest.mark.parametrize("seed", SEEDS)
def test_every_room_is_visited_through_doors(seed: int) -> None:
    plan, places = home_plan(seed), route(home_plan(seed))
    for room in plan.rooms:
        inside = np.minimum(places - room.cell.low, room.cell.high - places).min(axis=1)
        assert inside.max() > 0.6, room
    order = room_order(plan)
    pairs = {frozenset(door.rooms) for door in plan.doors}
    assert all(frozenset(pair) in pairs for pair in pairwise(order))
    assert plan.returns == (len(order) > 1 and order[0] == order[-1]) or len(plan.rooms) == 1


@pytest.mark.parametrize("tempo", [SLOW, FAST], ids=["slow", "fast"])
@pytest.mark.parametrize("seed", SEEDS)
def test_walks_keep_clear_and_keep_their_limits(seed: int, tempo: Tempo) -> None:
    plan, found = home_plan(seed), poses(seed, tempo)
    places = found[:, [0, 2], 3]
    assert np.min(free_of_walls(plan, places)) > 0.3
    for room in furnished(seed):
        for space in room.spaces:
            low, high = np.array(space.low)[[0, 2]], np.array(space.high)[[0, 2]]
            assert np.min(outside(places, low, high)) > 0.3, space
    height = -found[:, 1, 3]
    assert height.min() > 1.2 and height.max() < 1.7
    linear, angular = speeds(found, 1.0 / OFTEN)
    assert tempo.limits.linear[0] <= linear.min() and linear.max() <= tempo.limits.linear[1]
    assert angular.max() <= tempo.limits.angular[1]


@pytest.mark.parametrize("seed", SEEDS[::6])
def test_fast_walks_turn_fast(seed: int) -> None:
    """As FastCaMo-Synth: 0.9 to 2.2 rad/s, but on straight ways."""
    _, angular = speeds(poses(seed, FAST), 1.0 / OFTEN)
    assert np.mean(angular > 0.9) > 0.7


@pytest.mark.parametrize("seed", SEEDS)
def test_a_walk_that_returns_ends_where_it_began(seed: int) -> None:
    found, T_world_cam = spec(seed, SLOW), poses(seed, SLOW)
    assert 100 < found.frames < 2000
    ends = T_world_cam[0], found.path().poses(np.array([found.path().duration]))[0]
    apart = float(np.linalg.norm(ends[0][:3, 3] - ends[1][:3, 3]))
    if home_plan(seed).returns:
        assert apart < 1e-3 and np.trace(ends[0][:3, :3].T @ ends[1][:3, :3]) > 2.999
    else:
        assert apart > 1.0 or len(home_plan(seed).rooms) == 1


def test_rooms_that_are_alike_are_furnished_alike() -> None:
    seed = next(s for s in SEEDS if len({r.style for r in home_plan(s).rooms}) < len(home_plan(s).rooms))
    styles = [room.style for room in home_plan(seed).rooms]
    first, second = (n for n, style in enumerate(styles) if styles.count(style) == 2)
    kinds = [[solid.material for solid in furnished(seed)[n].piece.boxes] for n in (first, second)]
    assert kinds[0] == kinds[1]


def test_things_do_not_stand_in_each_other() -> None:
    for seed in SEEDS[::5]:
        for room in furnished(seed):
            for n, space in enumerate(room.spaces):
                assert not any(space.meets(other, 0.0) for other in room.spaces[:n])


def test_a_seed_gives_the_same_bits_again() -> None:
    before = poses(LARGE_HOME, SLOW).copy(), home(LARGE_HOME).boxes
    for cached in (home_plan, furnished, home, poses):
        cached.cache_clear()
    np.testing.assert_array_equal(before[0], poses(LARGE_HOME, SLOW))
    np.testing.assert_array_equal(before[1].center, home(LARGE_HOME).boxes.center)


def test_great_seeds_have_homes() -> None:
    assert home_plan(10**18 - 1).room_count() >= 1 and home_plan(0) != home_plan(10**18 - 1)


# Images


@pytest.mark.parametrize("name", [f"home-{SMALL_HOME}", f"home-{LARGE_HOME}-fast"])
def test_most_pixels_have_depth_and_the_camera_is_in_free_space(name: str) -> None:
    sequence = open_synth(name, slice(None, None, 60), NARROW)
    assert sequence.T_world_cam is not None
    free = distance(sequence.scene, jnp.asarray(sequence.T_world_cam[:, :3, 3], jnp.float32))
    assert np.min(free) > 0.25
    measured = []
    for number in range(len(sequence)):
        frame = sequence[number]
        assert frame.depth is not None and frame.color is not None
        measured.append(np.mean(frame.depth > 0.0))
        assert frame.color.std() > 5.0
    assert np.median(measured) > 0.9 and np.quantile(measured, 0.1) > 0.6
    # Glass: some frames lack depth, and are bright there
    assert np.min(measured) < 0.99


def test_glass_has_no_depth_and_is_bright() -> None:
    """Towards the middle of a window, from 1.5 m."""
    from mipsjax.data.synth.catalog import QVGA
    from mipsjax.data.synth.render import render

    plan = home_plan(SMALL_HOME)
    window = plan.windows[0]
    forward = np.zeros(3)
    forward[[0, 2][window.axis]] = window.outward
    right = np.cross([0.0, 1.0, 0.0], forward)
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = np.stack([right, [0.0, 1.0, 0.0], forward], axis=1)
    middle = np.array([window.place[0], -(window.sill + window.height / 2), window.place[1]])
    # Beside the bar in the middle
    T_world_cam[:3, 3] = middle - 1.5 * forward + 0.25 * window.width * right
    image = render(home(SMALL_HOME), QVGA.resized(80, 60), T_world_cam[None])
    assert image.glass[30, 40] and not image.glass[58, 40]
    assert image.color[image.glass].mean() > 1.2 * image.color[~image.glass].mean()
    # The pane ends the ray: its own depth is known to the renderer
    assert image.depth[30, 40] == pytest.approx(1.7, abs=0.03)


def test_noise_and_blur_take_glass() -> None:
    sequence = open_synth(f"home-{SMALL_HOME}-fast+noise+blur", slice(40, 41), NARROW)
    frame = sequence[0]
    assert frame.depth is not None and frame.depth.max() < 6.5


def test_the_true_mesh_is_made(tmp_path: Path) -> None:
    mesh = reference_mesh(home(SMALL_HOME), voxel_m=0.12)
    off = np.abs(distance(home(SMALL_HOME), jnp.asarray(mesh.vertices, jnp.float32)))
    assert np.quantile(off, 0.98) < 1e-4


# Names


def test_names_show_the_form() -> None:
    assert {"home-SEED", "home-SEED-fast"} <= synth_names().keys()


@pytest.mark.parametrize(
    "name",
    [
        "home-x",
        "home--3",
        "home-",
        "home-1.5",
        "home-007",
        "home-3-slow",
        "home-SEED",
        f"home-{10**18}",
        "home-٣",
    ],
)
def test_wrong_names_are_answered_with_the_form(name: str) -> None:
    with pytest.raises(InputError, match="home-SEED") as error:
        open_synth(name, slice(None), InputConfig())
    assert "\n" not in str(error.value)


def test_export_of_a_home(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = f"home-{SMALL_HOME}"
    assert main([name, str(tmp_path / "home"), "--frames", ":2", "--no-mesh"]) == 0
    assert f"2 frames of synth:{name}" in capsys.readouterr().out
    assert '"fps": 15.0' in (tmp_path / "home" / "camera.json").read_text()
