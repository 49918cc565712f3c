"""A rigid motion from matched points of two depth cameras, of which many are wrong.

Triples of matched points give hypotheses (RANSAC, Fischler and Bolles 1981). They are judged and refined by what a
depth camera measures well, directions in the image, and by depth only as far as its noise allows: distances between
points alone lose half of the pairs at 4 m. Residuals are divided by the deviations below.

Sums are written as einsum, and points are moved by `transform`: unlike that of a matrix product, the order of such sums
depends on no number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

from mipsjax.core.rigid import Pose, from_parts, rotation, transform

DIRECTION_NOISE = 0.005
"""Of a matched keypoint, radians: 1.5 pixels of a 320 pixel image."""
DEPTH_NOISE_M, DEPTH_NOISE_PER_M = 0.01, 0.003
"""Deviation of depth: the constant part, and what grows with its square (structured light and stereo)."""
GATE = 16.3
"""Squared residual of an inlier: 99.9 % of a chi-square with three degrees of freedom."""
COARSE_GATE = 4 * GATE
"""The same for a hypothesis, whose own three points are noisy."""
NEAREST_M = 0.1
"""Points nearer than this to the camera, or behind it, are not projected."""

HYPOTHESES = 1000
"""Triples drawn: with 80 % outliers still eight without any in the mean."""
REFINEMENTS = 10
"""Gauss-Newton steps; the last ones change nothing visible."""
WEAK_PRIOR = 1e-6
"""On the 6 x 6 system: a thousand metres or radians of deviation where the points fix nothing."""
LEAST_SIDE_M = 0.03
"""Allowed difference of a triangle's sides beside the depth noise: no hypothesis is lost for want of precision."""
LEAST_AREA_M2 = 0.01
"""Twice the area of a triple: smaller ones say little about rotation."""


class Pairs(NamedTuple):
    """Matched points of both frames."""

    p_current: Float64[np.ndarray, "M 3"]
    p_other: Float64[np.ndarray, "M 3"]


def ransac(pairs: Pairs, seed: int) -> Pose | None:
    """T_other_current of the best of `HYPOTHESES` triples by truncated squared residuals; None without any."""
    count = len(pairs.p_current)
    if count < 3:
        return None
    triple = np.random.default_rng(seed).integers(count, size=(HYPOTHESES, 3))
    a, b = pairs.p_current[triple], pairs.p_other[triple]
    # Cheap, and most triples with an outlier fail here: their motions need not be made
    plausible = _congruent(a, b)
    if not plausible.any():
        return None
    T = _from_triples(a[plausible], b[plausible])
    # All points by all hypotheses at once; for one motion this is `transform`
    moved = np.einsum("nij,mj->nmi", T[:, :3, :3], pairs.p_current) + T[:, None, :3, 3]
    cost = np.sum(_residuals(moved, pairs.p_other[None]) ** 2, axis=-1)
    # Truncated squares and not a count of inliers: among equal counts the closer fit wins
    support = np.sum(np.maximum(COARSE_GATE - cost, 0), axis=1)
    return T[np.argmax(support)]


def by_inliers(pairs: Pairs, T_other_current: Pose) -> tuple[Pose, Bool[np.ndarray, "M"]]:
    """Gauss-Newton on the residuals of the inliers with Cauchy weights; the motion, and which pairs fit it."""
    T = T_other_current
    for _ in range(REFINEMENTS):
        inlier = _fits(pairs, T)
        if inlier.sum() < 3:
            break
        kept = Pairs(*(p[inlier] for p in pairs))
        residual = _residuals(transform(T, kept.p_current), kept.p_other)
        # Cauchy's, on the mean of three residuals, each in deviations
        weight = 1 / (1 + np.mean(residual**2, axis=1))
        J = _jacobian(kept, T)
        system = np.einsum("m,mki,mkj->ij", weight, J, J) + WEAK_PRIOR * np.eye(6)
        twist = -np.linalg.solve(system, np.einsum("m,mki,mk->i", weight, J, residual))
        # The turn is about the current camera, in axes of the other: it leaves the shift alone
        T = from_parts(rotation(twist[3:]) @ T[:3, :3], T[:3, 3] + twist[:3])
    return T, _fits(pairs, T)


def deviation(inliers: Pairs, T_other_current: Pose) -> tuple[float, float]:
    """Greatest standard deviations of position (metres) and rotation (radians) in any direction."""
    J = _jacobian(inliers, T_other_current)
    covariance = np.linalg.inv(np.einsum("mki,mkj->ij", J, J) + WEAK_PRIOR * np.eye(6))
    # The largest eigenvalue is the variance along the loosest direction
    position, rotation = (np.linalg.eigvalsh(block)[-1] for block in (covariance[:3, :3], covariance[3:, 3:]))
    return float(np.sqrt(position)), float(np.sqrt(rotation))


def depth_noise(z: Float64[np.ndarray, "*M"]) -> Float64[np.ndarray, "*M"]:
    """Standard deviation of a measured depth. Metres."""
    return DEPTH_NOISE_M + DEPTH_NOISE_PER_M * z**2


def direction(p: Float[np.ndarray, "*K 3"]) -> Float[np.ndarray, "*K 2"]:
    """Image point at focal length 1; finite behind the camera, too."""
    return p[..., :2] / np.maximum(p[..., 2:], NEAREST_M)


def _congruent(a: Float64[np.ndarray, "K 3 3"], b: Float64[np.ndarray, "K 3 3"]) -> Bool[np.ndarray, "K"]:
    """Triangles with equal sides up to noise, large enough to say something."""
    slack = LEAST_SIDE_M + 3 * (depth_noise(a[..., 2]) + depth_noise(b[..., 2]))
    sides_a, sides_b = (np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2) for p in (a, b))
    area_a, area_b = (np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1) for p in (a, b))
    return np.all(np.abs(sides_a - sides_b) < slack, axis=1) & (np.minimum(area_a, area_b) > LEAST_AREA_M2)


def _from_triples(
    a: Float64[np.ndarray, "K 3 3"], b: Float64[np.ndarray, "K 3 3"]
) -> Float64[np.ndarray, "K 4 4"]:
    """Motions that turn triangle a into the plane and first side of b, and its centre into the centre of b."""
    T = np.tile(np.eye(4), (len(a), 1, 1))
    T[:, :3, :3] = np.einsum("nij,nkj->nik", _axes(b), _axes(a))
    T[:, :3, 3] = b.mean(axis=1) - np.einsum("nij,nj->ni", T[:, :3, :3], a.mean(axis=1))
    return T


def _axes(p: Float64[np.ndarray, "K 3 3"]) -> Float64[np.ndarray, "K 3 3"]:
    """Right-handed unit axes of triangles, in the columns: first side, in the plane, normal."""
    # `_congruent` has left out triangles that are so thin that these axes would be noise
    x = p[:, 1] - p[:, 0]
    z = np.cross(x, p[:, 2] - p[:, 0])
    x, z = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (x, z))
    return np.stack([x, np.cross(z, x), z], axis=2)


def _residuals(
    moved: Float64[np.ndarray, "*K 3"], target: Float64[np.ndarray, "*K 3"]
) -> Float64[np.ndarray, "*K 3"]:
    """Differences of direction and of depth, in their deviations; far out for points behind the camera."""
    aside = (direction(moved) - direction(target)) / DIRECTION_NOISE
    along = (moved[..., 2:] - target[..., 2:]) / depth_noise(target[..., 2:])
    return np.concatenate([aside, along], axis=-1)


def _jacobian(pairs: Pairs, T: Pose) -> Float64[np.ndarray, "M 3 6"]:
    """Of the residuals, by a shift (first three) and a turn about the current camera, in axes of the other."""
    turned = np.einsum("ij,mj->mi", T[:3, :3], pairs.p_current)
    x, y, z = (turned + T[None, :3, 3]).T
    by_point = np.zeros((len(z), 3, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = 1 / (z * DIRECTION_NOISE)
    by_point[:, 0, 2], by_point[:, 1, 2] = -x / (z**2 * DIRECTION_NOISE), -y / (z**2 * DIRECTION_NOISE)
    by_point[:, 2, 2] = 1 / depth_noise(pairs.p_other[:, 2])
    # d(w x turned) / dw applied to rows: row . (w x turned) = w . (turned x row)
    by_turn = np.cross(turned[:, None], by_point)
    return np.concatenate([by_point, by_turn], axis=2)


def _fits(pairs: Pairs, T: Pose) -> Bool[np.ndarray, "M"]:
    moved = transform(T, pairs.p_current)
    return (np.sum(_residuals(moved, pairs.p_other) ** 2, axis=1) < GATE) & (moved[:, 2] > NEAREST_M)
