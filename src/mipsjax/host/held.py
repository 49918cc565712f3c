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

    joint: Float64[np.ndarray, "12 12"]
    """Of the pose, relative to the submap's anchor, and of the motion since the frame before, which the next frame is
    expected to go on with."""

    @property
    def covariance(self) -> Matrix:
        """Of the pose."""
        return self.joint[:6, :6]


NONE = np.zeros((6, 6))
"""The covariance of an anchor, which is where it is by definition."""
EXACT = Held(np.zeros((12, 12)))


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
    """After a frame that was tracked at `T_sub_cam`, `seconds` after the last one: a step of a Kalman filter.

    It was measured against keyframes that are themselves off by `reference`, with the `information` of a twist in the
    camera's frame. Where that says little the frame goes on as the last one did, give or take an acceleration, and what
    it is off by then grows ever faster.
    """
    accelerated = moved(np.diag(np.repeat([cfg.acceleration, cfg.turn], 3) ** 2) * seconds**4, T_sub_cam)
    # Relative to those keyframes: what is common to them and to the last frame is counted once
    expected = _positive(last.joint - _padded(reference))
    on = np.block([[np.eye(6), np.eye(6)], [NONE, np.eye(6)]])
    expected = on @ expected @ on.T + np.tile(accelerated, (2, 2))
    back = adjoint(np.linalg.inv(T_sub_cam))
    measured = back.T @ information @ back
    gain = expected[:, :6] @ np.linalg.solve(np.eye(6) + measured @ expected[:6, :6], measured)
    return Held(_even(expected - gain @ expected[:6] + _padded(reference)))


def at(covariance: Matrix, last: Held, T_new_old: Pose) -> Held:
    """Of a frame whose pose is known this well in another submap, and which moves on as it did in the last one."""
    joint = _padded(covariance)
    joint[6:, 6:] = moved(last.joint[6:, 6:], T_new_old)
    return Held(joint)


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


def difference(whole: Matrix, part: Matrix) -> Matrix:
    """What was added to one covariance to make another of it; nothing in directions in which it is the lesser."""
    return _positive(whole - part)


def deviations(covariance: Matrix, T_sub_cam: Pose) -> tuple[float, float]:
    """Standard deviations of the camera's centre, metres, and of its orientation, radians; each over all directions."""
    centre = np.concatenate([np.eye(3), -cross(T_sub_cam[:3, 3])], axis=1)
    shift = centre @ covariance @ centre.T
    return float(np.sqrt(np.trace(shift))), float(np.sqrt(np.trace(covariance[3:, 3:])))


def cross(v: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """The matrix of the cross product with `v` from the left."""
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _padded(covariance: Matrix) -> Float64[np.ndarray, "12 12"]:
    joint = np.zeros((12, 12))
    joint[:6, :6] = covariance
    return joint


def _positive(matrix: Float64[np.ndarray, "N N"]) -> Float64[np.ndarray, "N N"]:
    """The nearest covariance: without its negative parts."""
    values, vectors = np.linalg.eigh(_even(matrix))
    return (vectors * np.maximum(values, 0)) @ vectors.T


def _even(matrix: Float64[np.ndarray, "N N"]) -> Float64[np.ndarray, "N N"]:
    return (matrix + matrix.T) / 2
