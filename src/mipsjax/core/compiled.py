"""How the entry points of the core are compiled."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import jax
from jax.stages import Wrapped


def compiled(*static: str) -> Callable[[Callable[..., Any]], Wrapped]:
    """A decorator: `jax.jit` with these arguments static, and matrix products in full single precision.

    A GPU otherwise rounds the factors to the 10 bits of TF32: of 4 m that is 2 mm, as much as a pose may be off. A CPU
    knows no other precision, and has the same bits without it.
    """

    def of(function: Callable[..., Any]) -> Wrapped:
        # Set while the function is traced: what it calls, and the derivatives that it takes, have it, too
        @wraps(function)
        def exactly(*args: Any, **kwargs: Any) -> Any:
            with jax.default_matmul_precision("highest"):
                return function(*args, **kwargs)

        return jax.jit(exactly, static_argnames=static)

    return of
