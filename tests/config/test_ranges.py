"""What the numbers of a configuration may be, each alone and together."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mipsjax.config.options import flat, merged, validate
from mipsjax.config.ranges import RANGES, SMALLEST_SIGMA, Range
from mipsjax.config.sections import Config, InputConfig
from mipsjax.config.tracking import GuardConfig
from mipsjax.errors import ConfigError
from mipsjax.loops import factors


def numeric(value: object) -> bool:
    return not isinstance(value, bool | str)


def test_every_number_has_a_range() -> None:
    assert {name for name, value in flat(Config()) if numeric(value)} == RANGES.keys()


@pytest.mark.parametrize("name", [name for name, value in flat(Config()) if isinstance(value, float)])
@pytest.mark.parametrize("value", [float("nan"), -1.0, float("-inf")])
@pytest.mark.fault(51)
def test_impossible_numbers_are_named(name: str, value: float) -> None:
    section: dict[str, object] = {}
    inner = section
    *path, last = name.split(".")
    for part in path:
        inner = inner.setdefault(part, {})  # pyright: ignore[reportAssignmentType]
    inner[last] = value
    with pytest.raises(ConfigError, match=name.replace(".", r"\.")):
        validate(merged(Config(), section))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"map": {"frames": 2}}, "map.frames must be at least 3, got 2"),
        ({"field": {"hidden": [64, 0]}}, "field.hidden must be at least 1 and at most 1024, got 0"),
        ({"seed": -1}, "seed must be at least 0 and at most 4294967295, got -1"),
    ],
)
def test_message_says_what_is_allowed(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate(merged(Config(), changes))
    assert str(caught.value) == message


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"field": {"hidden": [99999999999]}}, "field.hidden"),
        ({"field": {"hidden": [64] * 9}}, "8 layers"),
        ({"field": {"hash_levels": 32, "hash_log2_entries": 24}}, "table of"),
        ({"track": {"ro": {"particles": 10**9}}}, "track.ro.particles"),
        ({"map": {"steps": 10**40}}, "map.steps must be at most 2147483647"),
        ({"map": {"steps": 10**400}}, "map.steps must be at most 2147483647"),
        ({"seed": 10**400}, "seed must be at most 4294967295"),
        ({"map": {"learning_rate": 10**400}}, "map.learning_rate must be a number"),
        ({"map": {"learning_rate": 1e300}}, "map.learning_rate"),
        ({"map": {"learning_rate": 1e-300}}, "map.learning_rate"),
    ],
)
def test_what_no_machine_can_hold_is_refused(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate(merged(Config(), changes))
    assert message in str(caught.value) and len(str(caught.value)) < 200


@pytest.mark.parametrize("name", ["sigma", "sigma_rotation", "points_sigma"])
def test_a_deviation_that_no_factor_may_have_is_refused_at_the_start(name: str) -> None:
    """The pose graph would refuse it at the first loop, which may come after hours."""
    assert factors.SMALLEST_SIGMA == SMALLEST_SIGMA
    validate(merged(Config(), {"loop": {name: SMALLEST_SIGMA}}))
    with pytest.raises(ConfigError) as caught:
        validate(merged(Config(), {"loop": {name: 0.9 * SMALLEST_SIGMA}}))
    assert str(caught.value) == f"loop.{name} must be at least 1e-06, got 9e-07"


def test_contradictions_are_found() -> None:
    with pytest.raises(ConfigError, match=r"guard\.weak must be at least guard\.lost"):
        validate(replace(Config(), guard=GuardConfig(weak=0.3, lost=0.5)))
    with pytest.raises(ConfigError, match=r"input\.depth_max"):
        validate(replace(Config(), input=InputConfig(depth_min=3.0, depth_max=2.0)))


@given(st.floats(), st.floats(0, 10), st.floats(10, 20), st.booleans(), st.booleans())
def test_ranges(value: float, low: float, high: float, above: bool, infinite: bool) -> None:
    allowed = Range(low, high, above, infinite)
    assert allowed.holds(value) == (low <= value <= high and not (above and value == low))
    assert not Range(low).holds(float("inf")) and Range(low, infinite=True).holds(float("inf"))
