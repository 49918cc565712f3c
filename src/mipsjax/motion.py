"""How the camera moves: a Kalman filter of constant velocity, whose prediction is a prior of second-order tracking.

Not in the paper. In a doorway a frame can slide by centimetres without fitting the map any worse; the frames before
it say where it is. Twists are (v, omega), metres and radians, in the camera's own frame, as in `core/tracking.py`, to
first order: what a camera moves between two frames is small.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from mipsjax.config import RefineConfig
from mipsjax.state import Motion, Pose

Twist = Float64[np.ndarray, "6"]

SPEED = (
    3.0  # metres a second and radians a second, standard deviation of a velocity that nothing is known about
)
LONGEST = 5.0  # a velocity is not extrapolated further than so many of the intervals before it


class Prediction(NamedTuple):
    """The next frame, before it is seen."""

    T_last_next: Pose
    covariance: Float64[np.ndarray, "12 12"]
    """As in `Motion`, at the next frame."""
    velocity: Twist
    seconds: float
    """Since the last one. 0: time says nothing, and so does the motion."""

    @property
    def precision(self) -> Float64[np.ndarray, "6 6"]:
        """Inverse covariance of the pose."""
        return np.linalg.inv(self.covariance[:6, :6]) if self.seconds else np.zeros((6, 6))


def predict(motion: Motion | None, seconds: float, go: RefineConfig) -> Prediction:
    """After so much time; velocity wanders by white noise in the acceleration."""
    if motion is None:
        motion = Motion(np.zeros(6), np.diag([0.0] * 6 + [SPEED**2] * 6), 0.0)
    seconds = max(seconds, 0.0)
    T = _moved(motion.velocity * min(seconds, LONGEST * motion.seconds))
    onward = np.block([[_adjoint(T), seconds * np.eye(6)], [np.zeros((6, 6)), np.eye(6)]])
    density = np.diag(np.repeat([go.acceleration**2, go.angular_acceleration**2], 3))
    grown = np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
    covariance = onward @ motion.covariance @ onward.T + np.kron(grown, density)
    return Prediction(T, covariance, motion.velocity, seconds)


def update(
    predicted: Prediction, T_last_next: Pose, information: Float64[np.ndarray, "6 6"]
) -> Motion | None:
    """With the frame's pose, which has taken the prediction into account, and what the frame itself says of it.

    `information` is the inverse covariance of a twist from there by the frame alone. None where time says nothing.
    """
    if not predicted.seconds:
        return None
    prior, across = predicted.covariance[:6, :6], predicted.covariance[6:, :6]
    gain = np.linalg.solve(prior, across.T).T
    posed = np.linalg.inv(predicted.precision + information)
    posed = (posed + posed.T) / 2
    velocity = predicted.velocity + gain @ _twist(np.linalg.inv(predicted.T_last_next) @ T_last_next)
    moving = predicted.covariance[6:, 6:] - gain @ (prior - posed) @ gain.T
    return Motion(velocity, np.block([[posed, posed @ gain.T], [gain @ posed, moving]]), predicted.seconds)


def _moved(twist: Twist) -> Pose:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(twist[3:]).as_matrix(), twist[:3]
    return T


def _twist(T: Pose) -> Twist:
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def _adjoint(T_last_next: Pose) -> Float64[np.ndarray, "6 6"]:
    """A twist of the last frame as one of the next."""
    R, t = T_last_next[:3, :3], T_last_next[:3, 3]
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    return np.block([[R.T, -R.T @ cross], [np.zeros((3, 3)), R.T]])
