"""The floating-point operations of a compiled function's matrix products, counted in its traced program."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr


def matrix_flops(function: Callable[..., Any], *args: Any, loops: int = 1, searched: bool = False) -> float:
    """Floating-point operations of the matrix products of one call, from its traced program.

    A product of M x K by K x N counts 2 M K N; nothing else counts (sines, gathers, softmax, Adam). What
    a gradient costs is in the program itself: for the weights and inputs of a layer together twice the
    forward product, for its inputs alone once. `loops` is the number of rounds of every loop whose length
    is a traced value, and `searched` chooses the branch of a condition.
    """
    return _flops(jax.make_jaxpr(function)(*args).jaxpr, loops, int(searched))


def _flops(program: Jaxpr, loops: int, branch: int) -> float:
    total = 0.0
    for step in program.eqns:
        name, parameters = step.primitive.name, step.params
        if name == "dot_general":
            (contracted, _), _ = parameters["dimension_numbers"]
            left = step.invars[0].aval.shape
            inner = 1
            for axis in contracted:
                inner *= left[axis]
            total += 2.0 * step.outvars[0].aval.size * inner
        elif name == "scan":
            total += parameters["length"] * _flops(parameters["jaxpr"].jaxpr, loops, branch)
        elif name == "while":
            total += loops * _flops(parameters["body_jaxpr"].jaxpr, loops, branch)
        elif name == "cond":
            total += _flops(parameters["branches"][branch].jaxpr, loops, branch)
        else:
            total += sum(_flops(inner, loops, branch) for inner in _programs(parameters))
    return total


def _programs(parameters: dict[str, Any]) -> Iterator[Jaxpr]:
    """Programs that a primitive calls: those of jit, remat, custom derivatives."""
    for value in parameters.values():
        if isinstance(value, ClosedJaxpr):
            yield value.jaxpr
        elif isinstance(value, Jaxpr):
            yield value
