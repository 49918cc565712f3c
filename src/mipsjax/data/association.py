"""Which measurements of two lists belong together, by time; poses at given times."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation

from mipsjax.data.trajectory import Trajectory, known_poses
from mipsjax.errors import InputError

MAX_DT_S = 0.08
"""Two measurements farther apart belong to different moments; the value other systems use on TUM data."""

MAX_GAP_S = 0.1
"""Poses farther apart than this are not interpolated: a fast camera turns by ten degrees in that time."""

SAME_TIME_S = 1e-3
"""A pose this near in time is taken as it is, however far its neighbours are."""


def sort_stamps(
    timestamps: Float64[np.ndarray, "N"], what: str
) -> tuple[Int[np.ndarray, "K"], tuple[str, ...]]:
    """Order that makes timestamps strictly increasing, and remarks.

    The sort is stable; of equal timestamps the first in the list stays. `what` names the list in remarks.
    """
    order = np.argsort(timestamps, kind="stable")
    fresh = np.diff(timestamps[order], prepend=-np.inf) > 0
    remarks = []
    if np.any(np.diff(order) < 0):
        remarks.append(f"{what}: timestamps were not in order, sorted")
    if not fresh.all():
        remarks.append(f"{what}: {int((~fresh).sum())} entries with a repeated timestamp dropped")
    return order[fresh], tuple(remarks)


def associate(
    first: Float64[np.ndarray, "N"], second: Float64[np.ndarray, "M"], max_dt: float = MAX_DT_S
) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """Pairs of indices, one-to-one, nearest in time first, at most `max_dt` seconds apart.

    Both lists must be strictly increasing; both results are. Raises InputError if there is no pair.
    """
    left, right = np.arange(len(first)), np.arange(len(second))
    chosen_left, chosen_right = [], []
    while len(left) and len(right):
        # Who is nearest to each other is a pair; once they are gone others are nearest to each other
        there = nearest(second[right], first[left])
        back = nearest(first[left], second[right])
        mutual = back[there] == np.arange(len(left))
        mutual &= np.abs(second[right][there] - first[left]) <= max_dt
        if not mutual.any():
            break
        chosen_left.append(left[mutual])
        chosen_right.append(right[there[mutual]])
        left, right = left[~mutual], np.delete(right, there[mutual])
    if not chosen_left:
        raise InputError(_no_pair_message(first, second, max_dt))
    # Sorting each side undoes crossed pairs, and never makes the largest difference larger.
    return np.sort(np.concatenate(chosen_left)), np.sort(np.concatenate(chosen_right))


def nearest(stamps: Float64[np.ndarray, "N"], queries: Float64[np.ndarray, "M"]) -> Int[np.ndarray, "M"]:
    """Index of the nearest of increasing `stamps` for each query; the earlier one of two equally near."""
    after = np.clip(np.searchsorted(stamps, queries), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(queries - stamps[before]) <= np.abs(stamps[after] - queries), before, after)


def poses_at(
    timestamps: Float64[np.ndarray, "N"], trajectory: Trajectory, max_gap: float = MAX_GAP_S
) -> Float64[np.ndarray, "N 4 4"]:
    """Poses at the given times: linear in position and on the shortest arc in rotation.

    Between neighbours more than `max_gap` seconds apart and outside the trajectory the pose is NaN, unless
    a pose lies within SAME_TIME_S. The trajectory may be in any order.
    """
    order, _ = sort_stamps(trajectory.timestamps, "trajectory")
    stamps, poses = trajectory.timestamps[order], trajectory.T_world_cam[order]
    # Unknown ones are left out first, so that what lies between known ones counts as a gap
    known = known_poses(poses)
    stamps, poses = stamps[known], poses[known]
    if not len(stamps):
        return np.full((len(timestamps), 4, 4), np.nan)
    closest = nearest(stamps, timestamps)
    exact = np.abs(stamps[closest] - timestamps) <= SAME_TIME_S
    between = _interpolate(timestamps, stamps, poses, max_gap)
    return np.where(exact[:, None, None], poses[closest], between)


def _interpolate(
    timestamps: Float64[np.ndarray, "N"],
    stamps: Float64[np.ndarray, "M"],
    poses: Float64[np.ndarray, "M 4 4"],
    max_gap: float,
) -> Float64[np.ndarray, "N 4 4"]:
    after = np.clip(np.searchsorted(stamps, timestamps), 1, max(len(stamps) - 1, 1))
    result = np.full((len(timestamps), 4, 4), np.nan)
    if len(stamps) < 2 or not len(timestamps):
        return result
    before = after - 1
    gap = stamps[after] - stamps[before]
    inside = (timestamps >= stamps[before]) & (timestamps <= stamps[after]) & (gap <= max_gap)
    # 0 where the pose becomes NaN below: no turn is extrapolated
    weight = np.where(inside, (timestamps - stamps[before]) / gap, 0.0)
    start = Rotation.from_matrix(poses[before, :3, :3])
    turn = (start.inv() * Rotation.from_matrix(poses[after, :3, :3])).as_rotvec()
    result[:] = np.eye(4)
    result[:, :3, :3] = (start * Rotation.from_rotvec(weight[:, None] * turn)).as_matrix()
    result[:, :3, 3] = poses[before, :3, 3] + weight[:, None] * (poses[after, :3, 3] - poses[before, :3, 3])
    result[~inside] = np.nan
    return result


def _no_pair_message(first: Float64[np.ndarray, "N"], second: Float64[np.ndarray, "M"], max_dt: float) -> str:
    count = min(len(first), len(second))
    message = f"0 of {count} pairs within {max_dt:g} s"
    if not count:
        return f"{message}; one list is empty"
    smallest = np.abs(second[nearest(second, first)] - first).min()
    return f"{message}; nearest {smallest:.3g} s: the two clocks may differ"
