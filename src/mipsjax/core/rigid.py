"""Rigid motions: poses as 4 x 4 matrices, small motions as twists (v, omega), metres and radians.

`T_a_b` maps b-coordinates to a. `transform`, `transform_back` and `turned` take NumPy arrays and JAX arrays alike. What
follows them is for the host, in double precision; `exp`, `log` and `perturbed` at the end are for compiled code.

Where two ways of computing the same differ in the last bit, both are here, each with the reason why it is wanted. A
pose that `np.linalg.inv` inverts elsewhere is a third way of `inverse`: it solves a system and rounds otherwise.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Float64
from scipy.spatial.transform import Rotation

Pose = Float64[np.ndarray, "4 4"]

AnyArray = TypeVar("AnyArray", np.ndarray, jax.Array)


def transform(T_a_b: Float[AnyArray, "4 4"], p_b: Float[AnyArray, "P 3"]) -> Float[AnyArray, "P 3"]:
    """Points from frame b to frame a."""
    return turned(T_a_b[:3, :3], p_b) + T_a_b[None, :3, 3]


def transform_back(T_a_b: Float[AnyArray, "4 4"], p_a: Float[AnyArray, "P 3"]) -> Float[AnyArray, "P 3"]:
    """Points from frame a to frame b: the shift is undone first, so that no pose has to be inverted."""
    return turned(T_a_b[:3, :3].T, p_a - T_a_b[None, :3, 3])


def turned(R_a_b: Float[AnyArray, "3 3"], v_b: Float[AnyArray, "P 3"]) -> Float[AnyArray, "P 3"]:
    """Directions from frame b to frame a.

    By the rotation matrix: through quaternions, as a library of Lie groups would do it, takes many times as long. As
    sums: of a matrix product for each of many poses, as `jax.vmap` makes it, XLA takes 16 times as long on a CPU. On
    the host, too: the order of a product's sums may depend on the number of points and of threads, and what is decided
    by thresholds on single points is to come out the same on every machine.
    """
    x, y, z = v_b[:, 0:1], v_b[:, 1:2], v_b[:, 2:3]
    return x * R_a_b[None, :, 0] + y * R_a_b[None, :, 1] + z * R_a_b[None, :, 2]


def from_parts(rotation: Float64[np.ndarray, "3 3"], translation: Float64[np.ndarray, "3"]) -> Pose:
    """The motion that turns, then shifts."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def inverse(T: Pose) -> Pose:
    """The inverse of a rigid motion: its rotation is only transposed, which is exact."""
    back = T[:3, :3].T
    return from_parts(back, -back @ T[:3, 3])


def inverses(T: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "N 4 4"]:
    """The inverses of N rigid motions.

    Sums are taken by einsum here, not by N small matrix products: `inverse` of one of them may differ in the last bit.
    """
    out = np.zeros_like(T)
    out[:, :3, :3] = np.swapaxes(T[:, :3, :3], 1, 2)
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], T[:, :3, 3])
    out[:, 3, 3] = 1.0
    return out


def rigid(T: Float[np.ndarray, "4 4"]) -> Pose:
    """The nearest rigid motion in double precision: products of single-precision rotations drift."""
    u, _, vt = np.linalg.svd(T[:3, :3].astype(np.float64))
    return from_parts(u @ vt, T[:3, 3])


def distance(T_a: Pose, T_b: Pose) -> tuple[float, float]:
    """Metres and radians between two poses."""
    shift = np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])
    trace = np.trace(T_a[:3, :3].T @ T_b[:3, :3])
    return float(shift), float(_angle_of_trace(trace))


def lengths(
    motions: Float64[np.ndarray, "N 4 4"],
) -> tuple[Float64[np.ndarray, "N"], Float64[np.ndarray, "N"]]:
    """How far each of N motions shifts, metres, and turns, radians."""
    trace = np.trace(motions[:, :3, :3], axis1=1, axis2=2)
    return np.linalg.norm(motions[:, :3, 3], axis=1), _angle_of_trace(trace)


def _angle_of_trace(trace: Float64[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
    """The angle of a rotation matrix with this trace.

    Cheap, and good to half of the digits near 0 and near pi, where it is compared with limits of a degree or more;
    `angles` is for errors that are reported.
    """
    cosine = (trace - 1) / 2
    return np.arccos(np.clip(cosine, -1, 1))


def angles(rotations: Float64[np.ndarray, "N 3 3"]) -> Float64[np.ndarray, "N"]:
    """Angles of rotation matrices in [0, pi]. Radians.

    By the arc tangent of sine and cosine: the arc cosine alone loses half of the digits near 0 and near pi.
    """
    skew = rotations - np.swapaxes(rotations, 1, 2)
    axis = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    sine = 0.5 * np.linalg.norm(axis, axis=1)
    cosine = 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0)
    return np.arctan2(sine, cosine)


def align_rigid(
    source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "4 4"]:
    """Rigid motion T_target_source with the least sum of squared distances of T_target_source @ source to
    target.

    Umeyama 1991 (Least-squares estimation of transformation parameters between two point patterns) without
    scale; never a reflection. Where the points do not fix the rotation (one point, a straight line) it is one
    of the best.

    Raises:
        ValueError: the arrays are empty or of different shapes.
    """
    if source.shape != target.shape or len(source) == 0:
        raise ValueError(
            f"alignment needs two equal, non-empty sets of points: {source.shape}, {target.shape}"
        )
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    covariance = (target - mean_target).T @ (source - mean_source)
    u, _, vt = np.linalg.svd(covariance)
    # The last axis, that of the least spread, is turned round where the best orthogonal matrix is a reflection
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    return from_parts(rotation, mean_target - rotation @ mean_source)


def to_twist(T: Pose) -> Float64[np.ndarray, "6"]:
    """Shift and rotation vector of a motion.

    This is its logarithm to first order only, for the shift of a screw motion lies along a curve: for motions of a
    frame's length, and the exact reverse of `from_twist`.
    """
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def from_twist(twist: Float64[np.ndarray, "6"]) -> Pose:
    """The motion with this shift and rotation vector; the reverse of `to_twist`."""
    return from_parts(rotation(twist[3:]), twist[:3])


def rotation(vector: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The matrix of a rotation vector. Radians."""
    return Rotation.from_rotvec(vector).as_matrix()


def cross(v: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The matrix of the cross product with `v` from the left."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def adjoint(T_a_b: Pose) -> Float64[np.ndarray, "6 6"]:
    """A twist in frame b as one in frame a: T_a_b exp(xi) = exp(adjoint(T_a_b) xi) T_a_b."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = cross(t) @ R
    return out


def exp(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """The exponential of a twist, for compiled code; its derivative exists at 0, too."""
    return jaxlie.SE3.exp(twist).as_matrix()


def log(T: Float[Array, "4 4"]) -> Float[Array, "6"]:
    """The twist of a motion, for compiled code."""
    return jaxlie.SE3.from_matrix(T).log()


def perturbed(T: Float[Array, "4 4"], twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """A pose after a small motion in its own frame, T exp(twist), for compiled code."""
    return T @ exp(twist)
