"""The compiler underneath: versions that compute wrong derivatives on a CPU are refused, and this one does not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mipsjax import _check_jaxlib
from mipsjax.config.sections import FieldConfig
from mipsjax.core import field as nf

POINTS, REPEATS = 1536, 10
STEP = 2e-4  # metres, of the numerical derivative


@pytest.mark.parametrize("found", ["0.10.2", "0.11.0"])
def test_broken_versions_are_refused(found):
    with pytest.raises(ImportError, match=f"jaxlib {found} computes"):
        _check_jaxlib(found, "--xla_force_host_platform_device_count=2")
    _check_jaxlib(found, "--xla_cpu_experimental_ynn_fusion_type=")


def test_other_versions_are_not():
    _check_jaxlib("0.10.1", "")


def test_derivatives_of_the_hash_grid_repeat_to_the_bit_and_agree_with_differences():
    """What jaxlib 0.10.2 gets wrong; random from call to call, or a crash."""
    cfg = FieldConfig()
    field = nf.init(jax.random.key(0), cfg)
    assert field.fine is not None and field.fine.table is not None
    table = 0.1 * jax.random.normal(jax.random.key(1), field.fine.table.shape)
    field = field._replace(fine=field.fine._replace(table=table))
    points = jax.random.uniform(jax.random.key(2), (POINTS, 3), minval=-2, maxval=2)

    def total(p):
        return jnp.sum(nf.tsdf(field, p, cfg).psi)

    gradient = jax.jit(jax.grad(total))
    results = [np.asarray(gradient(points)) for _ in range(REPEATS)]
    for again in results[1:]:
        np.testing.assert_array_equal(again, results[0])
    psi = jax.jit(lambda p: nf.tsdf(field, p, cfg).psi)
    shift = jnp.array([[STEP, 0, 0]])
    numerical = np.asarray(psi(points + shift) - psi(points - shift)) / (2 * STEP)
    # The field is piecewise: a cell's border or a relu within a step makes single points differ
    off = np.abs(numerical - results[0][:, 0])
    assert np.median(off) < 0.05 * np.median(np.abs(numerical))
