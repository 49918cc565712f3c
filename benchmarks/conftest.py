"""Measuring a compiled function: points and matrix products a second, and the share of the machine's rate."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

ROUNDS = 5
SQUARES = (512, 1024, 2048, 4096)
"""Sizes of the float32 products from which the machine's rate is taken."""


class Row(NamedTuple):
    """One line of the table at the end."""

    name: str
    milliseconds: float
    points_per_second: float
    gflops: float
    share: float


ROWS = pytest.StashKey[list[Row]]()


@pytest.fixture(scope="session")
def machine_gflops() -> float:
    """The best rate of a square float32 product in this run, GFLOP/s."""
    return max(_square_rate(size) for size in SQUARES)


def _square_rate(size: int) -> float:
    product = jax.jit(jnp.matmul)
    a = jax.random.normal(jax.random.key(0), (size, size))
    product(a, a).block_until_ready()
    seconds = []
    for _ in range(ROUNDS):
        began = perf_counter()
        product(a, a).block_until_ready()
        seconds.append(perf_counter() - began)
    return 2e-9 * size**3 / min(seconds)


@pytest.fixture
def throughput(benchmark, machine_gflops: float, request: pytest.FixtureRequest) -> Callable[..., None]:
    """`throughput(points, flops, function, *args)` times a compiled function and notes its rates."""

    def measure(points: int, flops: float, function: Callable[..., Any], *args: Any) -> None:
        benchmark.pedantic(
            lambda: jax.block_until_ready(function(*args)), rounds=ROUNDS, iterations=1, warmup_rounds=2
        )
        seconds = benchmark.stats.stats.min
        gflops = 1e-9 * flops / seconds
        row = Row(request.node.name, 1e3 * seconds, points / seconds, gflops, gflops / machine_gflops)
        benchmark.extra_info.update(
            points=points,
            points_per_second=row.points_per_second,
            matrix_gflop=1e-9 * flops,
            gflops=gflops,
            machine_gflops=machine_gflops,
            share_of_machine=row.share,
            device=jax.devices()[0].device_kind,
        )
        request.config.stash.setdefault(ROWS, []).append(row)

    return measure


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    rows = config.stash.get(ROWS, [])
    if not rows:
        return
    write = terminalreporter.write_line
    machine = rows[0].gflops / rows[0].share
    device = jax.devices()[0].device_kind
    terminalreporter.section("throughput")
    write(f"{device}: best square float32 product {machine:.0f} GFLOP/s; times are the least of {ROUNDS}")
    write(f"{'':<32}{'ms':>10}{'million points/s':>18}{'GFLOP/s':>10}{'share':>8}")
    for row in rows:
        name, millions = row.name.removeprefix("test_"), 1e-6 * row.points_per_second
        write(f"{name:<32}{row.milliseconds:>10.1f}{millions:>18.2f}{row.gflops:>10.1f}{row.share:>8.0%}")
