"""Homes drawn from a seed: what every one of them must be, by plan and path alone."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest

from mipsjax.config.sections import InputConfig
from mipsjax.data.synth import open_synth, synth_names
from mipsjax.data.synth.catalog import Spec, find
from mipsjax.data.synth.draws import Draws
from mipsjax.data.synth.home import home
from mipsjax.data.synth.home_furnish import furnished, outside
from mipsjax.data.synth.home_layout import WALL
from mipsjax.data.synth.home_plan import MOST_ROOMS, Plan, home_plan
from mipsjax.data.synth.home_route import room_order, route
from mipsjax.data.synth.home_walk import FAST, SLOW, Tempo
from mipsjax.data.synth.path import speeds
from mipsjax.errors import InputError

SEEDS = range(101, 161)
# Poses are checked so many times a second
OFTEN = 60.0
# A home of several rooms, two of them alike
LARGE_HOME = 105


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


def test_plans_are_the_same_with_every_version() -> None:
    """Only sums, products and square roots make a plan: nothing that a library may round in another way."""
    text = repr([home_plan(seed) for seed in SEEDS[:20]])
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == "107a8a9645999b78"


def test_great_seeds_have_homes() -> None:
    assert home_plan(10**18 - 1).room_count() >= 1 and home_plan(0) != home_plan(10**18 - 1)


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
