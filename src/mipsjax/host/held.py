"""What holds each frame, and how far its pose may be off after all that led there.

A residual cannot see a slide: a frame that moves along a bare wall fits as well as before. The normal equations of
tracking can: along a direction that they leave free the pose follows the motion before it, and its error grows.

Covariances are of a twist (v, omega), metres and radians, where exp(twist) T is the true pose and T the one found. They
are in the frame that T maps to, here a submap's, so that those of different frames are sums of each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from mipsjax.config import HeldConfig

OPEN = 100.0
"""Metres or radians: the deviation of what nothing holds."""

Matrix = Float64[np.ndarray, "6 6"]
Pose = Float64[np.ndarray, "4 4"]


class Held(NamedTuple):
    """How far the pose of one frame may be off in its submap."""

    covariance: Matrix
    """Relative to the submap's anchor."""
    motion: Matrix
    """Of the motion since the frame before, which the next one is expected to go on with."""


NONE = np.zeros((6, 6))
"""The covariance of an anchor, which is where it is by definition."""
EXACT = Held(NONE, NONE)


class Directions(NamedTuple):
    """What measurements alone say of a frame, in six directions, the one that they hold most firmly first."""

    deviation: Float64[np.ndarray, "6"]
    """Standard deviations, metres for a shift and radians for a turn."""
    twist: Float64[np.ndarray, "6 6"]
    """Unit twists (v, omega) in the camera's frame, one a row."""


def directions(information: Matrix) -> Directions:
    """Of the inverse covariance of a frame's pose, for a twist in its own frame."""
    strength, twists = np.linalg.eigh(information)
    least = 1 / OPEN**2
    return Directions(1 / np.sqrt(np.maximum(strength[::-1], least)), twists.T[::-1])


def held(
    reference: Matrix, last: Held, T_sub_cam: Pose, information: Matrix, seconds: float, cfg: HeldConfig
) -> Held:
    """After a frame that was tracked at `T_sub_cam`, `seconds` after the last one.

    It was measured against keyframes that are themselves off by `reference`, with the `information` of a twist in the
    camera's frame. Where that says little the frame goes on as the last one did, give or take an acceleration.
    """
    accelerated = np.repeat([cfg.acceleration, cfg.turn], 3) * seconds**2
    back = adjoint(np.linalg.inv(T_sub_cam))
    changed = last.motion + moved(np.diag(accelerated**2), T_sub_cam)
    # Of the last frame relative to those keyframes: what is common to both is counted once
    since = positive(last.covariance - reference)
    expected = since + changed
    measured = back.T @ information @ back
    left = np.linalg.inv(np.linalg.inv(expected) + measured)
    share = left @ measured
    rest = np.eye(6) - share
    motion = rest @ changed @ rest.T + share @ (since + left) @ share.T
    return Held(_even(reference + left), _even(motion))


def adjoint(T_a_b: Pose) -> Matrix:
    """A twist in frame b as one in frame a: T_a_b exp(xi) = exp(adjoint(T_a_b) xi) T_a_b."""
    R, t = T_a_b[:3, :3], T_a_b[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = cross(t) @ R
    return out


def moved(covariance: Matrix, T_a_b: Pose) -> Matrix:
    """A covariance in frame b as one in frame a."""
    out = adjoint(T_a_b)
    return out @ covariance @ out.T


def positive(matrix: Matrix) -> Matrix:
    """The nearest covariance: without its negative parts."""
    values, vectors = np.linalg.eigh(_even(matrix))
    return (vectors * np.maximum(values, 0)) @ vectors.T


def deviations(covariance: Matrix, T_sub_cam: Pose) -> tuple[float, float]:
    """Standard deviations of the camera's centre, metres, and of its orientation, radians; each over all directions."""
    centre = np.concatenate([np.eye(3), -cross(T_sub_cam[:3, 3])], axis=1)
    shift = centre @ covariance @ centre.T
    return float(np.sqrt(np.trace(shift))), float(np.sqrt(np.trace(covariance[3:, 3:])))


def cross(v: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The matrix of the cross product with `v` from the left."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _even(matrix: Matrix) -> Matrix:
    return (matrix + matrix.T) / 2
