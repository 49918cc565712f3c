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

from mipsjax.config.tracking import HeldConfig
from mipsjax.core.rigid import Pose, adjoint, cross

OPEN = 100.0
"""Metres or radians: the deviation of what nothing holds."""

Matrix = Float64[np.ndarray, "6 6"]


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
MOVING = 0.05
"""Metres, or rad, that a camera of which nothing is known may move between two frames, along each axis."""
ROUNDING = 1e-9
"""Of a standard deviation, relative to the largest, and of that in metres or rad: what is less is none."""
LASTING = 0.3
"""Seconds for which a camera goes on accelerating as it does."""
LONGEST = 1.0
"""Seconds: over a longer gap acceleration says nothing more."""


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


def at(covariance: Matrix, T_sub_cam: Pose, motion: Matrix | None = None) -> Held:
    """Of a frame whose pose is known this well, and its motion this well; not at all if None."""
    joint = np.zeros((12, 12))
    joint[:6, :6] = covariance
    # In the submap's frame, as all covariances here; the camera moves in its own
    joint[6:, 6:] = carried(MOVING**2 * np.eye(6), T_sub_cam) if motion is None else motion
    return Held(joint)


def predicted(reference: Matrix | None, last: Held, T_sub_cam: Pose, seconds: float, cfg: HeldConfig) -> Held:
    """Before a frame is measured, about at `T_sub_cam`, `seconds` after the last one.

    The camera goes on as it did, give or take an acceleration. Relative to what is off by `reference`, if anything:
    what is common to both is counted once.
    """
    covariance, cross, motion = last.joint[:6, :6], last.joint[:6, 6:], last.joint[6:, 6:]
    since = covariance if reference is None else difference(covariance, reference)
    cross = _bounded(cross, since, motion)
    seconds = min(seconds, LONGEST)
    # White noise that does as much over a while as an acceleration that lasts
    lasting = np.sqrt(max(2 * LASTING / seconds, 1.0))
    axes = np.repeat([cfg.acceleration, cfg.turn], 3) * lasting * seconds**2
    # The pose goes on by the motion, which stays: [[1, 1], [0, 1]] on the joint covariance
    on = np.block([[np.eye(6), np.eye(6)], [NONE, np.eye(6)]])
    joint = on @ np.block([[since, cross], [cross.T, motion]]) @ on.T
    return Held(_positive(joint + np.tile(carried(np.diag(axes**2), T_sub_cam), (2, 2))))


class Gains(NamedTuple):
    """What share of a surprise is believed: of a twist in the camera's frame, from where a frame was expected to where
    it was measured."""

    pose: Matrix
    motion: Matrix
    """Of the motion since the frame before, which the next one goes on with."""


def gains(reference: Matrix | None, expected: Held, T_sub_cam: Pose, information: Matrix) -> Gains:
    """Of a frame that is measured at about `T_sub_cam`, as for `held`."""
    into, out = adjoint(np.linalg.inv(T_sub_cam)), adjoint(T_sub_cam)
    weight, information = _weighed(reference, expected, T_sub_cam, information)
    gain = weight @ information
    return Gains(into @ gain[:6] @ out, into @ gain[6:] @ out)


def held(reference: Matrix | None, expected: Held, T_sub_cam: Pose, information: Matrix) -> Held:
    """After a frame was tracked at `T_sub_cam`, of which this was `expected`: the update of a Kalman filter (Kalman
    1960) in the form of Joseph, which stays a covariance whatever is rounded.

    It was measured with the `information` of a twist in the camera's frame, relative to keyframes that are themselves
    off by `reference`. What is measured of a pose says as much of the motion that led there. Where `reference` is None,
    it was measured against the frame before, that is, its motion was. What that says of earlier motions moves no pose:
    the map was learned there.
    """
    weight, information = _weighed(reference, expected, T_sub_cam, information)
    left = np.eye(12)
    # 1 - K H, where H picks the part that was measured
    left[:, _measured(reference)] -= weight @ information
    joint = left @ expected.joint @ left.T + weight @ information @ weight.T
    if reference is not None:
        joint[:6, :6] += reference
    return Held(_even(joint))


def _weighed(
    reference: Matrix | None, expected: Held, T_sub_cam: Pose, information: Matrix
) -> tuple[Float64[np.ndarray, "12 6"], Matrix]:
    """The gain of pose and motion is the first times the second, which is the information in the frame of the joint
    covariance."""
    into = adjoint(np.linalg.inv(T_sub_cam))
    information = into.T @ _positive(information) @ into
    measured = _measured(reference)
    whole = expected.joint[measured, measured]
    both = np.concatenate([whole, expected.joint[6:, measured]])
    # P (1 + I P)^-1 by solving the transposed system: the information may be singular, so is not inverted
    return np.linalg.solve((np.eye(6) + information @ whole).T, both.T).T, information


def _measured(reference: Matrix | None) -> slice:
    """Part of a joint covariance: against the frame before, a frame's motion is measured and not its pose."""
    return slice(6, 12) if reference is None else slice(0, 6)


def carried(covariance: Matrix, T_a_b: Pose) -> Matrix:
    """A covariance in frame b as one in frame a."""
    out = adjoint(T_a_b)
    return out @ covariance @ out.T


def difference(whole: Matrix, part: Matrix) -> Matrix:
    """What was added to one covariance to make another of it; nothing in directions in which it is the lesser."""
    return _positive(whole - part)


def deviations(covariance: Matrix, T_sub_cam: Pose) -> tuple[float, float]:
    """Standard deviations of the camera's centre, metres, and of its orientation, radians; each over all directions."""
    # A twist about the submap's origin moves the camera at t by v + omega x t = v - [t]x omega
    centre = np.concatenate([np.eye(3), -cross(T_sub_cam[:3, 3])], axis=1)
    shift, turn = centre @ covariance @ centre.T, covariance[3:, 3:]
    # A variance of nothing may be rounded to less
    metres, radians = np.sqrt(np.maximum([np.trace(shift), np.trace(turn)], 0))
    return float(metres), float(radians)


def _bounded(cross: Matrix, first: Matrix, second: Matrix) -> Matrix:
    """The covariance of two twists with each other, no more than their own allow: correlations are at most 1."""
    root, back = _roots(first)
    other, other_back = _roots(second)
    u, correlation, vt = np.linalg.svd(back @ cross @ other_back)
    return root @ (u * np.minimum(correlation, 1)) @ vt @ other


def _roots(covariance: Matrix) -> tuple[Matrix, Matrix]:
    """The square root, and its inverse where there is any."""
    values, vectors = np.linalg.eigh(covariance)
    root = np.sqrt(np.maximum(values, 0))
    # Relative to the largest: what rounding left of a zero would have a huge inverse
    some = root > ROUNDING * max(root[-1], ROUNDING)
    back = np.where(some, 1 / np.where(some, root, 1), 0)
    return (vectors * root) @ vectors.T, (vectors * back) @ vectors.T


def _positive(matrix: Float64[np.ndarray, "N N"]) -> Float64[np.ndarray, "N N"]:
    """The nearest covariance: without its negative parts."""
    values, vectors = np.linalg.eigh(_even(matrix))
    return (vectors * np.maximum(values, 0)) @ vectors.T


def _even(matrix: Float64[np.ndarray, "N N"]) -> Float64[np.ndarray, "N N"]:
    return (matrix + matrix.T) / 2


EXACT = at(NONE, np.eye(4))
"""Of an anchor."""
