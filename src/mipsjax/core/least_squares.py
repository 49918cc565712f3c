"""The pose of a frame as one robust least-squares problem with its analytic derivative, solved by optimistix.

The same rows as in `core/equations.py`, for registration in another submap, at keyframes and lost frames, and for what
follows the last frame. Tracking of every frame has steps of its own (`descend`), which take half the time
(`experiments/solvers.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float

from mipsjax.core.equations import Prior, Rows
from mipsjax.core.rigid import exp, log, perturbed

RowsOf = Callable[[Float[Array, "4 4"]], Sequence[Rows]]
"""A pose to the rows of all that says where the frame is."""
SETTLED, SETTLED_SHARE = 1e-2, 1e-3
"""The steps end where twist and residuals, both in units of a point's noise, change by less: absolute, and as a share
of what they are, root mean square."""
HELD_AT_LEAST = 1e-5
"""Share of all points by which a pose is held at the start in every direction: far less than what counts as held
(`loop.held`), and more than the rounding of single precision, by which it would slide where nothing holds it."""
SMALL = 1e-12
"""Square metres; a cost below it is taken for 0, where its root has no derivative."""


def solve(rows_of: RowsOf, T: Float[Array, "4 4"], steps: int, unit: float) -> Float[Array, "4 4"]:
    """The pose that minimises the robust costs of all rows, after at most so many Levenberg-Marquardt steps from T.

    `unit` is the noise of a point, metres (or as many radians): residuals and twist are given to the solver in it, so
    that its damping, which begins at 1, is what one point says. Of what is not finite the start comes back.
    """
    if not steps:
        return T
    of_rows = robust_residuals(rows_of, T)
    stay = jnp.sqrt(HELD_AT_LEAST * jnp.sum(_flat(rows_of(T), "weight")))

    def residuals(scaled, _):
        return jnp.concatenate([of_rows(unit * scaled) / unit, stay * scaled])

    solver = optx.LevenbergMarquardt(
        SETTLED_SHARE, SETTLED, norm=optx.rms_norm, linear_solver=lx.Normal(lx.Cholesky())
    )
    found = optx.least_squares(
        residuals,
        solver,
        jnp.zeros(6),
        options={"jac": "fwd"},
        # The first of optimistix only looks at the start
        max_steps=steps + 1,
        # The best pose after these steps is wanted, converged or not
        throw=False,
    )
    ok = jnp.all(jnp.isfinite(found.value))
    return jnp.where(ok, perturbed(T, unit * found.value), T)


def robust_residuals(
    rows_of: RowsOf, T: Float[Array, "4 4"]
) -> Callable[[Float[Array, "6"]], Float[Array, " R"]]:
    """The residuals of T exp(twist) as a function of the twist (v, omega): signed roots of the robust costs.

    Their derivative is that of the rows: (w e / r) J for a residual r of the error e with the weight w, so that r times
    it is the slope w e J of the normal equations. The field is not differentiated again.
    """

    @jax.custom_jvp
    def residuals(twist):
        return _roots(rows_of(perturbed(T, twist)))

    @residuals.defjvp
    def _(primals, tangents):
        (twist,), (change,) = primals, tangents
        rows = rows_of(perturbed(T, twist))
        roots = _roots(rows)
        errors, weights = (_flat(rows, name) for name in ("residual", "weight"))
        jacobian = jnp.concatenate([one.jacobian.reshape(-1, 6) for one in rows])
        vanishing = roots**2 < SMALL
        # Near 0 a robust cost is w e^2
        by_error = weights * errors / jnp.where(vanishing, 1.0, roots)
        scale = jnp.where(vanishing, jnp.sqrt(weights), by_error)
        return roots, scale * (jacobian @ _in_camera(twist, change))

    return residuals


def prior_rows(prior: Prior) -> Callable[[Float[Array, "4 4"]], Rows]:
    """How far a pose is from a prior one, as rows."""
    strength, directions = jnp.linalg.eigh(prior.weight)
    # An inverse covariance has no negative eigenvalue but by rounding
    root = jnp.sqrt(jnp.maximum(strength, 0))[:, None] * directions.T
    T_prior_sub = jnp.linalg.inv(prior.T_sub_cam)

    def rows(T: Float[Array, "4 4"]) -> Rows:
        error = root @ log(T_prior_sub @ T)
        # The derivative of the logarithm is the identity up to half of its value, which is small where this counts
        return Rows(error, root, jnp.ones(6), error**2)

    return rows


def _roots(rows: Sequence[Rows]) -> Float[Array, " R"]:
    """Signed roots of the costs."""
    cost = _flat(rows, "cost")
    positive = cost > SMALL
    root = jnp.where(positive, jnp.sqrt(jnp.where(positive, cost, 1.0)), 0.0)
    return jnp.where(_flat(rows, "residual") < 0, -root, root)


def _flat(rows: Sequence[Rows], name: str) -> Float[Array, " R"]:
    return jnp.concatenate([getattr(one, name).reshape(-1) for one in rows])


def _in_camera(twist: Float[Array, "6"], change: Float[Array, "6"]) -> Float[Array, "6"]:
    """The motion in the camera's frame after a twist that follows from a change of that twist: the right Jacobian of
    the exponential, times the change."""
    T, moved = jax.jvp(exp, (twist,), (change,))
    # In the Lie algebra: [omega]x beside v
    motion = jnp.linalg.inv(T) @ moved
    omega = jnp.stack([motion[2, 1], motion[0, 2], motion[1, 0]])
    return jnp.concatenate([motion[:3, 3], omega])
