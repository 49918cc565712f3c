"""How the entry points of the core are compiled."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields, replace
from functools import lru_cache, update_wrapper, wraps
from typing import Any

import jax

from mipsjax.config.sections import Config


def compiled(*static: str, reads: tuple[str, ...] = ()) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """A decorator: `jax.jit` with these arguments static, and matrix products in full single precision.

    `reads` are the sections of the argument `cfg`, a whole `Config`, that the function reads. What is compiled depends
    on these alone: configurations that differ elsewhere share it, and reading another section is an error.

    A GPU otherwise rounds the factors to the 10 bits of TF32: of 4 m that is 2 mm, as much as a pose may be off. A CPU
    knows no other precision, and has the same bits without it.
    """

    unknown = set(reads) - {item.name for item in fields(Config)}
    if unknown:
        raise ValueError(f"no sections of the configuration: {', '.join(sorted(unknown))}")

    def of(function: Callable[..., Any]) -> Callable[..., Any]:
        # Set while the function is traced: what it calls, and the derivatives that it takes, have it, too
        @wraps(function)
        def exactly(*args: Any, **kwargs: Any) -> Any:
            with jax.default_matmul_precision("highest"):
                return function(*args, **kwargs)

        jitted = jax.jit(exactly, static_argnames=static)
        return Narrowing(jitted, function, reads) if reads else jitted

    return of


class Narrowing:
    """A compiled function, given a configuration without what it does not read; all else that it can is what
    `jax.jit` gives."""

    def __init__(self, jitted: Any, function: Callable[..., Any], reads: tuple[str, ...]) -> None:
        update_wrapper(self, function)
        self.jitted, self._reads = jitted, reads
        self._place = list(inspect.signature(function).parameters).index("cfg")

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        args, kwargs = self._given(args, kwargs)
        return self.jitted(*args, **kwargs)

    def trace(self, *args: Any, **kwargs: Any) -> Any:
        """As of `jax.jit`."""
        args, kwargs = self._given(args, kwargs)
        return self.jitted.trace(*args, **kwargs)

    def lower(self, *args: Any, **kwargs: Any) -> Any:
        """As of `jax.jit`."""
        args, kwargs = self._given(args, kwargs)
        return self.jitted.lower(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        # Before there is one, as while it is copied
        if name == "jitted":
            raise AttributeError(name)
        return getattr(self.jitted, name)

    def _given(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
        """The arguments with a narrowed configuration."""
        if "cfg" in kwargs:
            return args, {**kwargs, "cfg": _narrowed(kwargs["cfg"], self._reads)}
        place = self._place
        if place >= len(args):  # of which `jax.jit` complains
            return args, kwargs
        return (*args[:place], _narrowed(args[place], self._reads), *args[place + 1 :]), kwargs


# Configurations of one process; comparing two takes longer than to find one here
@lru_cache(maxsize=256)
def _narrowed(cfg: Config, reads: tuple[str, ...]) -> Config:
    """The configuration with these sections, and nothing in the place of the others."""
    others = {item.name: UNREAD for item in fields(cfg) if item.name not in (*reads, "seed")}
    return replace(cfg, seed=0, **others)


class _Unread:
    """What stands for a section that a compiled function has not said that it reads."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"'{name}' is of a section that is not among the `reads` of a compiled function")


UNREAD = _Unread()
