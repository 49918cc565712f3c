"""What is compiled depends on the sections of the configuration that it reads, and on no other."""

from __future__ import annotations

from dataclasses import fields, replace

import jax.numpy as jnp
import numpy as np
import pytest

from compilations import compilations
from mipsjax.config.sections import BackgroundConfig, Config, MapConfig, MeshConfig
from mipsjax.core.compiled import compiled

CFG = Config()


@compiled("cfg", reads=("map",))
def doubled(value, cfg: Config, times: int = 2):
    return times * value + cfg.map.steps


@compiled("cfg", reads=("map",))
def careless(value, cfg: Config):
    return value + cfg.mesh.voxel


def test_another_section_compiles_nothing_anew():
    one = jnp.ones(3)
    first = np.asarray(doubled(one, CFG))
    others = replace(CFG, mesh=MeshConfig(voxel=0.1), background=BackgroundConfig(steps=7), seed=5)
    with compilations() as compiled_again:
        np.testing.assert_array_equal(doubled(one, others), first)
    assert not compiled_again
    with compilations() as compiled_again:
        np.testing.assert_array_equal(doubled(one, replace(CFG, map=MapConfig(steps=7))), np.full(3, 9))
    assert compiled_again


def test_reading_a_section_that_was_not_named_is_an_error():
    with pytest.raises(AttributeError, match="voxel"):
        careless(jnp.ones(3), CFG)


def test_sections_that_are_named_are_sections():
    """A misspelt one would be taken away from the function that needs it, and seen only where it is read."""
    from mipsjax.core import mapping

    assert set(mapping.READS) <= {item.name for item in fields(Config)}


def test_sections_that_are_none_are_refused_where_they_are_named():
    with pytest.raises(ValueError, match="no sections of the configuration: feild"):
        compiled("cfg", reads=("feild",))
