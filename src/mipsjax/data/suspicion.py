"""Signs that a recording is not what it is taken for: other depth, times of another unit, images on their side.

A sign is no proof: each is a remark, which says what was found and what to do if it is so.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int
from scipy.spatial.transform import Rotation

from mipsjax.core.camera import Intrinsics
from mipsjax.data.trajectory import known_poses

MOSTLY = 0.5
"""Share of a frame's depth beyond the range that is worth a remark."""
FEW_VALUES = 16
"""A frame with no more different depths, COARSE_M apart, is rounded: sensors give thousands."""
COARSE_M = 0.2
"""Metres. No sensor of depth is coarser within its range."""
SMOOTHER = 8.0
"""How much smoother an image must become with its bytes swapped; right ones become a hundred times rougher."""
SLOWEST_S = 5.0
"""Seconds from a frame to the next, in a recording of a moving camera."""
TIME_UNITS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
OFF_MIDDLE = 0.05
"""Part of width and height together by which a principal point is off the middle before it is looked at."""
FEWEST_POSES = 10
"""Of a trajectory whose turns are compared."""
TURNS = 4
"""A turn is compared over this part of the trajectory, in which a camera has turned by more than it drifts."""
APART_DEG, NEARER = 3.0, 0.25
"""Turns that differ by less than the one agree; another reading is named if it brings them to this share."""
FEWEST_VALUES = 3
"""Two may be two walls that the camera faces."""
OPENGL = np.array([1.0, -1.0, -1.0, 1.0])
"""Signs of the columns of a pose in axes with y up and z backward."""


def suspicions_of_depth(
    depth: Float32[np.ndarray, "H W"], units_per_metre: float, depth_max: float, number: int
) -> tuple[str, ...]:
    """Remarks on the depth of one frame in metres, 0 for none, before it is cut to the range of the config."""
    measured = depth[depth > 0]
    found = []
    beyond = float(np.mean(measured > depth_max))
    if beyond > MOSTLY:
        found.append(
            f"{100 * beyond:.0f} % of the depth of frame {number} is beyond {depth_max:g} m and left out: "
            "--input.depth-max takes more"
        )
    values = np.unique(measured)
    steps = np.diff(values)
    if FEWEST_VALUES <= len(values) <= FEW_VALUES and steps.min() >= COARSE_M:
        found.append(
            f"depth of frame {number} has only {len(values)} values, {steps.min():.3g} m apart at least: it was "
            "rounded when it was written, as to whole metres; write millimetres"
        )
    elif _smoother_swapped(np.rint(depth * units_per_metre).astype(np.uint16)):
        found.append(
            f"depth of frame {number} is smooth with the two bytes of each pixel swapped, and rough as it is: "
            "write its PNG anew, high byte first"
        )
    return tuple(found)


def suspicions_of_times(
    timestamps: Float64[np.ndarray, "N"], numbers: Int[np.ndarray, "N"]
) -> tuple[str, ...]:
    """Remarks on times that cannot be the seconds of a moving camera; `numbers` tell of frames left out."""
    step = float(np.median(np.diff(timestamps) / np.diff(numbers)))
    if step <= SLOWEST_S:
        return ()
    # The unit in which the frames would be nearest to 30 a second
    unit = min(TIME_UNITS, key=lambda units: abs(np.log(30.0 * step / units)))
    return (f"frames are {step:.3g} s apart: times must be in seconds; are these {TIME_UNITS[unit]}?",)


def suspicions_of_view(intrinsics: Intrinsics, source: str) -> tuple[str, ...]:
    """A remark where the principal point is that of an image with width and height exchanged."""
    _, _, cx, cy, width, height = intrinsics
    off = abs(cx - width / 2) + abs(cy - height / 2)
    off_turned = abs(cx - height / 2) + abs(cy - width / 2)
    if off <= OFF_MIDDLE * (width + height) or off_turned >= off / 4:
        return ()
    return (
        f"the principal point {cx:g} {cy:g} of {source} is in the middle of {height} x {width} images, these are "
        f"{width} x {height}: for images on their side, exchange FX with FY and CX with CY",
    )


def suspicions_of_truth(
    T_world_cam: Float64[np.ndarray, "N 4 4"], T_truth_cam: Float64[np.ndarray, "N 4 4"]
) -> tuple[str, ...]:
    """A remark where an estimate turns as the true poses do only if these are read by another convention."""
    known = known_poses(T_world_cam) & known_poses(T_truth_cam)
    estimate, truth = T_world_cam[known], T_truth_cam[known]
    if len(truth) < FEWEST_POSES:
        return ()
    as_given = _turned_apart_deg(estimate, truth)
    xyzw = Rotation.from_matrix(truth[:, :3, :3]).as_quat()
    readings = {
        "world-to-camera poses, which are to be inverted": np.linalg.inv(truth),
        "poses in OpenGL axes (y up, z backward), whose second and third column are to be negated": truth
        * OPENGL,
        # What was read as x y z w is w x y z then
        "quaternions with w first, which are to be written x y z w": _with_rotations(
            truth, xyzw[:, [1, 2, 3, 0]]
        ),
    }
    apart = {name: _turned_apart_deg(estimate, poses) for name, poses in readings.items()}
    best = min(apart, key=lambda name: apart[name])
    if as_given < APART_DEG or apart[best] > NEARER * as_given:
        return ()
    return (
        f"the true poses turn otherwise than the camera, by {as_given:.0f} degrees, and by {apart[best]:.1f} if they "
        f"are {best}: errors against them mean nothing",
    )


def _turned_apart_deg(first: Float64[np.ndarray, "N 4 4"], second: Float64[np.ndarray, "N 4 4"]) -> float:
    """Median angle between the turns of two trajectories, each over a part of its length."""
    # Turns, not poses: whatever lies between the two worlds cancels
    apart = max(1, len(first) // TURNS)
    turns = [
        Rotation.from_matrix(poses[:-apart, :3, :3]).inv() * Rotation.from_matrix(poses[apart:, :3, :3])
        for poses in (first, second)
    ]
    return float(np.degrees(np.median((turns[0].inv() * turns[1]).magnitude())))


def _with_rotations(
    poses: Float64[np.ndarray, "N 4 4"], xyzw: Float64[np.ndarray, "N 4"]
) -> Float64[np.ndarray, "N 4 4"]:
    changed = poses.copy()
    changed[:, :3, :3] = Rotation.from_quat(xyzw).as_matrix()
    return changed


def _smoother_swapped(raw: np.ndarray) -> bool:
    """Whether 16-bit depth is smoother from pixel to pixel with its bytes exchanged."""
    both = (raw[:, 1:] > 0) & (raw[:, :-1] > 0)
    if not both.any():
        return False

    def roughness(image: np.ndarray) -> float:
        return float(np.median(np.abs(np.diff(image.astype(np.int64), axis=1))[both]))

    # One unit more: an even image has no roughness to divide by
    return roughness(raw) > SMOOTHER * (roughness(raw.byteswap()) + 1)
