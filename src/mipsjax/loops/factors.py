"""Measurements between submaps: what the pose graph is made of, their residuals, and what is wrong with a bad one.

Nothing here needs GTSAM. Tangents are in its order all the same (rotation, translation), perturbations on the
right: T exp(xi).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from mipsjax.core.rigid import Pose

SMALLEST_SIGMA = 1e-6  # rad or m; less is a mistake of units, and its information drowns all others
ROTATION_TOLERANCE = 1e-4  # entries of R R^T - 1: products of single-precision rotations stay well below
NORMAL_TOLERANCE = 1e-2  # of the length of a normal: it scales the residual by as much
COLUMNS = 13  # the 12 entries of a rigid motion and a constant


class RelativePose(NamedTuple):
    """Pose of submap `second` in `first`, as measured by tracking or by matched features (Eq. 21)."""

    first: int
    second: int
    T_first_second: Pose
    sigma_rotation: float
    """Radians, of each axis."""
    sigma_translation: float
    """Metres, of each axis."""
    trusted: bool = False
    """Never rejected: a sequential edge."""
    added: Float64[np.ndarray, "6 6"] = np.zeros((6, 6))
    """Covariance beside these, of a tangent (rotation, translation) on the right: what is known to be loose."""
    cauchy: float = np.inf
    """Standard deviations, scale of a Cauchy weight: beyond it the measurement counts for less. Infinite: never."""

    @property
    def covariance(self) -> Float64[np.ndarray, "6 6"]:
        """Of the whole measurement."""
        sigmas = np.repeat([self.sigma_rotation, self.sigma_translation], 3).astype(np.float64)
        return np.diag(sigmas**2) + self.added


class PointToPlane(NamedTuple):
    """Surface points of submap `first` and what they correspond to on the surface of `second` (Eqs. 19 and 20).

    The residuals are e_i = (p_i - T_first^-1 T_second q_i) . n_i, metres.
    """

    first: int
    second: int
    p_first: Float[np.ndarray, "N 3"]
    n_first: Float[np.ndarray, "N 3"]
    """Unit normals at `p_first`, in the frame of `first`."""
    q_second: Float[np.ndarray, "N 3"]
    """In the frame of `second`."""
    sigma: float
    """Metres, of one residual."""
    trusted: bool = False
    effective_points: float = 50.0
    """Independent points: neighbours on one surface share their error, so N of them weigh as this many at most."""


Factor = RelativePose | PointToPlane


class FactorError(ValueError):
    """A factor that must not enter the graph. The message names its submaps, `pair` holds them."""

    def __init__(self, factor: Factor, problem: str) -> None:
        self.pair = factor.first, factor.second
        super().__init__(
            f"{type(factor).__name__} factor between submaps {factor.first} and {factor.second}: {problem}"
        )


def check(factor: Factor, submaps: int) -> None:
    """
    Raises:
        FactorError: an index is not one of `submaps`, or a shape, sigma, normal or rotation is wrong or not finite.
    """
    for number in (factor.first, factor.second):
        if not 0 <= number < submaps:
            raise FactorError(factor, f"there are {submaps} submaps")
    if factor.first == factor.second:
        raise FactorError(factor, "a submap is not measured against itself")
    if isinstance(factor, RelativePose):
        _check_sigma(factor, "sigma_rotation", factor.sigma_rotation)
        _check_sigma(factor, "sigma_translation", factor.sigma_translation)
        if not _is_covariance(factor.added):
            raise FactorError(factor, f"added must be a finite covariance 6 x 6, not {factor.added}")
        if not factor.cauchy > 0:
            raise FactorError(factor, f"cauchy must be positive, not {factor.cauchy}")
        if not is_rigid(factor.T_first_second):
            raise FactorError(factor, f"T_first_second is not a rigid motion: {factor.T_first_second}")
    else:
        _check_sigma(factor, "sigma", factor.sigma)
        _check_points(factor)


def _check_sigma(factor: Factor, name: str, sigma: float) -> None:
    if not (np.isfinite(sigma) and sigma >= SMALLEST_SIGMA):
        raise FactorError(factor, f"{name} must be at least {SMALLEST_SIGMA} and finite, not {sigma}")


def _is_covariance(added: Float64[np.ndarray, "6 6"]) -> bool:
    if np.shape(added) != (6, 6) or not np.isfinite(added).all() or not np.allclose(added, added.T):
        return False
    strengths = np.linalg.eigvalsh(added)
    # Of a matrix without an inverse, rounding makes some of them negative
    return bool(strengths[0] >= -1e-9 * max(strengths[-1], SMALLEST_SIGMA**2))


def _check_points(factor: PointToPlane) -> None:
    shapes = {np.shape(points) for points in (factor.p_first, factor.n_first, factor.q_second)}
    if shapes != {(len(factor.p_first), 3)} or len(factor.p_first) == 0:
        raise FactorError(factor, f"points and normals must be three equal arrays N x 3, not {shapes}")
    if not all(np.isfinite(points).all() for points in (factor.p_first, factor.n_first, factor.q_second)):
        raise FactorError(factor, "a point or normal is not finite")
    if np.abs(np.linalg.norm(factor.n_first, axis=1) - 1).max() > NORMAL_TOLERANCE:
        raise FactorError(factor, "normals must be of unit length")
    if not (np.isfinite(factor.effective_points) and factor.effective_points > 0):
        raise FactorError(factor, f"effective_points must be positive, not {factor.effective_points}")


def is_rigid(T: Pose) -> bool:
    """Whether this is a finite, proper rotation and a translation."""
    if np.shape(T) != (4, 4) or not np.isfinite(T).all():
        return False
    R = np.asarray(T)[:3, :3]
    orthogonal = np.abs(R @ R.T - np.eye(3)).max() < ROTATION_TOLERANCE
    return bool(orthogonal and np.linalg.det(R) > 0 and np.array_equal(np.asarray(T)[3], [0, 0, 0, 1]))


def compress(
    p_first: Float[np.ndarray, "N 3"], n_first: Float[np.ndarray, "N 3"], q_second: Float[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "M 13"]:
    """At most 13 rows with, for every pose, the sum of squares of the N point-to-plane residuals (Eq. 20).

    A residual is linear in the 12 entries of T_first_second = [R t], row by row: its row is
    (-n_x [q 1], -n_y [q 1], -n_z [q 1], p . n). The triangle of the QR decomposition of all rows keeps every norm.
    """
    p, n, q = (np.asarray(points, np.float64) for points in (p_first, n_first, q_second))
    # [q 1], which the 3 x 4 matrix [R t] takes to the first frame
    homogeneous = np.concatenate([q, np.ones((len(q), 1))], axis=1)
    linear = -(n[:, :, None] * homogeneous[:, None]).reshape(-1, COLUMNS - 1)
    # Q has orthonormal columns: the norm of the residuals is that of R times the same vector
    _, rows = np.linalg.qr(np.column_stack([linear, np.sum(p * n, axis=1)]))
    return rows


def plane_residual(
    rows: Float64[np.ndarray, "M 13"], T_first_second: Pose
) -> tuple[Float64[np.ndarray, "M"], Float64[np.ndarray, "M 6"], Float64[np.ndarray, "M 6"]]:
    """Residuals of compressed rows, metres, and their derivatives by right perturbations of both world poses.

    T = T_first^-1 T_second becomes exp(-xi) T when T_first moves, T exp(xi) when T_second does.
    """
    linear, constant = rows[:, :-1], rows[:, -1]
    # The sign is that of exp(-xi): moving the first pose moves its measurement the other way
    by_first = -(_GENERATORS @ T_first_second)[:, :3].reshape(6, -1)
    by_second = (T_first_second @ _GENERATORS)[:, :3].reshape(6, -1)
    return linear @ T_first_second[:3].ravel() + constant, linear @ by_first.T, linear @ by_second.T


def row_sigma(factor: PointToPlane) -> float:
    """With N points the rows hold N residuals; this takes them for as few as are independent."""
    return factor.sigma * max(1.0, len(factor.p_first) / factor.effective_points) ** 0.5


def _generators() -> Float64[np.ndarray, "6 4 4"]:
    """Derivatives of exp(xi) at 0, in the order of GTSAM."""
    out = np.zeros((6, 4, 4))
    for axis in range(3):
        out[axis, :3, :3] = np.cross(np.eye(3)[axis], np.eye(3)).T
        out[3 + axis, axis, 3] = 1
    return out


_GENERATORS = _generators()
