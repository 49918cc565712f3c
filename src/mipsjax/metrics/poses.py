"""How far an estimated trajectory is from the true one, each number with its protocol.

All functions take two arrays of camera-to-world poses, row i of both belonging to the same moment. A row that
holds a NaN or an infinity is a missing pose: it is left out of the statistics and counted. Metres; rotation
errors in degrees.

The measures are those of Sturm et al. 2012 (A benchmark for the evaluation of RGB-D SLAM systems), with TE
added by MIPS-Fusion.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int

from mipsjax.core.rigid import align_rigid, angles, inverses, transform
from mipsjax.errors import InputError

MIN_POSES = 3
"""Pairs of poses that an aligned error needs: three points fix a rigid motion, fewer would be fitted
exactly."""

Poses = Float64[np.ndarray, "N 4 4"]


class Statistics(NamedTuple):
    """What is reported of a set of errors. Unit of the errors."""

    rmse: float
    mean: float
    median: float
    max: float


class AbsoluteError(NamedTuple):
    """ATE: position errors after the best rigid motion of the whole estimate onto the truth (no scale)."""

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    poses: int
    """Pairs that were compared."""
    missing_truth: int
    """Rows left out because the ground truth has no pose there."""
    missing_estimate: int
    """Rows left out because only the estimate has no pose there."""
    T_truth_estimate: Float64[np.ndarray, "4 4"]
    """The rigid motion that was applied to the estimate."""


class RelativeError(NamedTuple):
    """RPE: errors of the motion over a fixed number of frames, all overlapping pairs, without alignment."""

    trans_rmse_m: float
    trans_mean_m: float
    rot_rmse_deg: float
    rot_mean_deg: float
    delta_frames: int
    pairs: int
    """Pairs of frames that were compared."""
    missing_pairs: int
    """Pairs left out because one of their four poses is missing."""


class TranslationError(NamedTuple):
    """TE: position errors without alignment, both trajectories seen from their first common frame."""

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    poses: int
    """Pairs that were compared; the first, which is zero by construction, is one of them."""
    missing_truth: int
    missing_estimate: int


def absolute_error(T_world_cam: Poses, T_truth_cam: Poses) -> AbsoluteError:
    """ATE. Protocol: camera centres, rigid alignment over all compared poses without scale, then distances.

    The benchmark's number is `rmse_m`; the paper reports `mean_m`.

    Raises:
        InputError: fewer than three pairs of poses are finite.
    """
    usable, missing_truth, missing_estimate = _usable(T_world_cam, T_truth_cam)
    _require(int(usable.sum()), MIN_POSES, "ATE")
    estimate, truth = T_world_cam[usable, :3, 3], T_truth_cam[usable, :3, 3]
    # Without scale: depth measures it, so that a wrong one is an error of the estimate
    T_truth_world = align_rigid(estimate, truth)
    aligned = transform(T_truth_world, estimate)
    found = statistics(np.linalg.norm(aligned - truth, axis=1))
    return AbsoluteError(*found, int(usable.sum()), missing_truth, missing_estimate, T_truth_world)


def relative_error(T_world_cam: Poses, T_truth_cam: Poses, delta_frames: int = 1) -> RelativeError:
    """RPE. Protocol: all pairs (i, i + delta_frames), error (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), no alignment.

    P is the estimate and Q the truth. The translation error is the length of the error's translation, the
    rotation error its angle. Intervals count rows, missing ones too, so a gap never lengthens an interval.

    Raises:
        InputError: no pair is complete, or delta_frames is not positive.
    """
    if delta_frames < 1:
        raise InputError(f"the interval of the relative error must be at least 1 frame, not {delta_frames}")
    usable, _, _ = _usable(T_world_cam, T_truth_cam)
    # Both ends of an interval need a pose, what lies between does not
    complete = usable[:-delta_frames] & usable[delta_frames:]
    starts = np.flatnonzero(complete)
    _require(len(starts), 1, f"RPE over {delta_frames} frames")
    motion = _motions(T_world_cam, starts, delta_frames)
    true_motion = _motions(T_truth_cam, starts, delta_frames)
    error = inverses(true_motion) @ motion
    trans = statistics(np.linalg.norm(error[:, :3, 3], axis=1))
    rot = statistics(np.degrees(angles(error[:, :3, :3])))
    pairs = len(starts)
    return RelativeError(
        trans.rmse, trans.mean, rot.rmse, rot.mean, delta_frames, pairs, len(complete) - pairs
    )


def translation_error(T_world_cam: Poses, T_truth_cam: Poses) -> TranslationError:
    """TE. Protocol: both trajectories in the system of the first frame that has both poses, then distances.

    No alignment: an error of the first estimated rotations counts over the whole path.

    Raises:
        InputError: fewer than two pairs of poses are finite.
    """
    usable, missing_truth, missing_estimate = _usable(T_world_cam, T_truth_cam)
    # The first pair is zero by construction: one more is needed to say anything
    _require(int(usable.sum()), 2, "TE")
    estimate, truth = T_world_cam[usable], T_truth_cam[usable]
    # Inverses of the first pose of each, so that both begin at the identity
    seen_from_first = (inverses(estimate[:1]) @ estimate)[:, :3, 3]
    truth_from_first = (inverses(truth[:1]) @ truth)[:, :3, 3]
    found = statistics(np.linalg.norm(seen_from_first - truth_from_first, axis=1))
    return TranslationError(*found, int(usable.sum()), missing_truth, missing_estimate)


def statistics(errors: Float64[np.ndarray, "N"]) -> Statistics:
    """Root mean square, mean, median and maximum of non-negative, finite errors; at least one."""
    return Statistics(
        float(np.sqrt(np.mean(errors**2))),
        float(np.mean(errors)),
        float(np.median(errors)),
        float(np.max(errors)),
    )


def _usable(T_world_cam: Poses, T_truth_cam: Poses) -> tuple[Bool[np.ndarray, "N"], int, int]:
    """Rows with both poses, the number without truth, and the number without an estimate only."""
    if T_world_cam.shape != T_truth_cam.shape or T_world_cam.shape[1:] != (4, 4):
        raise ValueError(f"poses must be two arrays N x 4 x 4: {T_world_cam.shape}, {T_truth_cam.shape}")
    has_estimate = np.asarray(np.isfinite(T_world_cam).all(axis=(1, 2)))
    has_truth = np.asarray(np.isfinite(T_truth_cam).all(axis=(1, 2)))
    # A row that lacks both counts as lacking the truth, once
    return has_estimate & has_truth, int((~has_truth).sum()), int((has_truth & ~has_estimate).sum())


def _require(found: int, needed: int, measure: str) -> None:
    if found < needed:
        raise InputError(
            f"{measure} needs at least {needed} finite pairs of estimated and true poses, found {found}: "
            "check that both trajectories cover the same time"
        )


def _motions(
    T_world_cam: Poses, starts: Int[np.ndarray, "M"], delta_frames: int
) -> Float64[np.ndarray, "M 4 4"]:
    """Motions of the frames `delta_frames` after `starts`, seen from these."""
    return inverses(T_world_cam[starts]) @ T_world_cam[starts + delta_frames]
