"""How good a reconstructed mesh is, each number with its protocol.

Distances are measured between points drawn evenly from the surfaces, to the nearest point of the other set;
with 200,000 points over a room of 100 square metres that resolves about 1 cm. Metres, world frame of the
reference.

Only what the camera saw can be reconstructed: `observed` finds the part of a reference that at least one
frame saw. The reference is culled to that part, the reconstruction is not (what it invents elsewhere is an
error); its numbers are reported both ways.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float64, UInt8
from scipy.spatial import KDTree

from mipsjax.core.camera import Intrinsics, project
from mipsjax.core.rigid import transform_back
from mipsjax.errors import InputError
from mipsjax.mesh.render import Caster

POINTS = 200_000
"""Points drawn from each surface: the number that the field commonly uses."""
THRESHOLD_M = 0.05
"""Inlier distance of completion ratio and F-score: the field's usual 5 cm."""
DEPTH_TOLERANCE_M = 0.02
"""A point this far behind the measured depth still counts as seen: two to three sigma of a depth camera at 2
m."""
PEAK = 255.0
"""Greatest value of an 8-bit colour."""


class SurfaceError(NamedTuple):
    """Distances between a reconstruction and a reference, from points drawn from both."""

    accuracy_m: float
    """Mean distance from the reconstruction to the nearest reference point."""
    accuracy_rms_m: float
    """Root mean square of the same distances: the paper's accuracy."""
    completeness_m: float
    """Mean distance from the reference to the nearest point of the reconstruction."""
    completion_ratio: float
    """Fraction of the reference within the threshold of the reconstruction: the paper's completeness."""
    precision: float
    """Fraction of the reconstruction within the threshold of the reference."""
    f_score: float
    """Harmonic mean of precision and completion ratio."""
    threshold_m: float
    points: int
    """Points of the reconstruction."""
    reference_points: int


class Views(NamedTuple):
    """What the camera saw: poses and depth images of the frames that define the observed surface."""

    T_world_cam: Float64[np.ndarray, "F 4 4"]
    """World frame of the reference; rows with a NaN are left out."""
    intrinsics: Intrinsics
    depths: Iterable[Float[np.ndarray, "H W"]]
    """z-depth in metres, 0 for none, one image a pose; may be read lazily, and is read once a call."""


class MeshError(NamedTuple):
    """The same reconstruction measured with two cullings; the reference is culled to the observed surface in
    both."""

    all_of_it: SurfaceError
    """Every point of the reconstruction counts."""
    observed_part: SurfaceError | None
    """Only points of the reconstruction that a frame saw count; None without views."""
    reference_kept: float
    """Fraction of the reference that was observed; 1 without views."""


class DepthError(NamedTuple):
    """Depth L1: mesh seen from given poses against reference depth images."""

    mean_m: float
    """Mean absolute difference over pixels where both have a depth."""
    pixels: int
    """Number of those pixels."""
    uncovered: float
    """Fraction of the pixels with reference depth where the mesh has none."""


class ColorError(NamedTuple):
    """PSNR of vertex colours seen from given poses against images."""

    psnr_db: float
    """From the mean squared error over all compared pixels of all images."""
    pixels: int
    uncovered: float
    """Fraction of pixels that the mesh does not cover; they are not compared."""


def sample_surface(
    mesh: trimesh.Trimesh, count: int = POINTS, seed: int = 0
) -> Float64[np.ndarray, "count 3"]:
    """Points spread over the surface in proportion to area; the same ones for the same mesh and seed.

    Stratified along the faces: point i falls into the i-th of `count` equal parts of the area.

    Raises:
        InputError: the mesh has no surface.
    """
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]  # mesh.triangles would be kept
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cumulative = np.cumsum(np.linalg.norm(cross, axis=1))
    if len(cumulative) == 0 or not np.isfinite(cumulative[-1]) or cumulative[-1] <= 0:
        raise InputError("the mesh has no surface to measure: it is empty, degenerate or not finite")
    rng = np.random.default_rng(seed)
    place = (np.arange(count) + rng.random(count)) * (cumulative[-1] / count)
    # To the right, so that no point falls on a face without area
    face = np.minimum(np.searchsorted(cumulative, place, side="right"), len(cumulative) - 1)
    # the square root makes the density even over a triangle
    outward, across = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
    return (1 - outward) * a + outward * ((1 - across) * b + across * c)


def compare_points(
    points: Float64[np.ndarray, "N 3"],
    reference: Float64[np.ndarray, "M 3"],
    threshold_m: float = THRESHOLD_M,
) -> SurfaceError:
    """Distances to the nearest neighbour between two point sets, both ways.

    Raises:
        InputError: one of the sets is empty.
    """
    if len(points) == 0 or len(reference) == 0:
        raise InputError(
            f"nothing to compare: {len(points)} points against {len(reference)} reference points"
        )
    to_reference, _ = KDTree(reference).query(points, workers=-1)
    to_points, _ = KDTree(points).query(reference, workers=-1)
    precision = float(np.mean(to_reference <= threshold_m))
    ratio = float(np.mean(to_points <= threshold_m))
    return SurfaceError(
        accuracy_m=float(np.mean(to_reference)),
        accuracy_rms_m=float(np.sqrt(np.mean(to_reference**2))),
        completeness_m=float(np.mean(to_points)),
        completion_ratio=ratio,
        precision=precision,
        f_score=2 * precision * ratio / (precision + ratio) if precision + ratio > 0 else 0.0,
        threshold_m=threshold_m,
        points=len(points),
        reference_points=len(reference),
    )


def compare_meshes(
    mesh: trimesh.Trimesh,
    reference: trimesh.Trimesh,
    views: Views | None = None,
    threshold_m: float = THRESHOLD_M,
    count: int = POINTS,
    seed: int = 0,
) -> MeshError:
    """Accuracy, completeness, completion ratio and F-score of a mesh.

    Protocol: `count` points drawn by area from each mesh (seeds `seed` and `seed + 1`); reference points that
    no view saw are dropped; the reconstruction is measured whole, and a second time without the points that
    no view saw. Without views nothing is dropped.

    Raises:
        InputError: a mesh is empty, or the views saw nothing of one.
    """
    points = sample_surface(mesh, count, seed)
    # Another seed: by the same draws two equal meshes would be no distance apart
    true_points = sample_surface(reference, count, seed + 1)
    if views is None:
        return MeshError(compare_points(points, true_points, threshold_m), None, 1.0)
    # one pass over the depth images serves both sets
    seen = observed(np.concatenate([points, true_points]), views)
    kept = true_points[seen[count:]]
    if not seen[:count].any() or len(kept) == 0:
        raise InputError(
            "the views see nothing of the meshes: check that poses and meshes share the world frame"
        )
    return MeshError(
        compare_points(points, kept, threshold_m),
        compare_points(points[seen[:count]], kept, threshold_m),
        len(kept) / count,
    )


def observed(
    points: Float64[np.ndarray, "N 3"], views: Views, tolerance_m: float = DEPTH_TOLERANCE_M
) -> Bool[np.ndarray, "N"]:
    """Points that at least one view saw.

    Protocol: the point projects into the image, to a pixel with a depth measurement, and its z is at most
    that depth plus the tolerance. What lies in front of the measured surface counts as seen: the camera
    looked through it.
    """
    seen = np.zeros(len(points), bool)
    for T_world_cam, depth in zip(views.T_world_cam, views.depths, strict=True):
        if np.isfinite(T_world_cam).all():
            # What one view saw is seen, whatever the others show
            open_points = np.flatnonzero(~seen)
            visible = _visible(
                points[open_points], T_world_cam, views.intrinsics, np.asarray(depth), tolerance_m
            )
            seen[open_points[visible]] = True
    return seen


def depth_l1(mesh: trimesh.Trimesh, views: Views) -> DepthError:
    """Depth L1. Protocol: rays through all pixel centres of all views, mean absolute difference of z-depth.

    Pixels without reference depth are left out; pixels that the mesh leaves open are left out of the mean and
    counted in `uncovered`.

    Raises:
        InputError: no pixel has both depths.
    """
    caster, total, pixels, measured = Caster(mesh), 0.0, 0, 0
    for T_world_cam, depth in zip(views.T_world_cam, views.depths, strict=True):
        if np.isfinite(T_world_cam).all():
            found = caster.render(T_world_cam, views.intrinsics, shaded=False).depth
            both = (found > 0) & (depth > 0)
            total += float(np.abs(found.astype(np.float64) - depth)[both].sum())
            pixels, measured = pixels + int(both.sum()), measured + int((depth > 0).sum())
    if pixels == 0:
        raise InputError("no pixel has both a measured depth and a surface: check that poses and mesh match")
    return DepthError(total / pixels, pixels, 1.0 - pixels / measured)


def color_psnr(
    mesh: trimesh.Trimesh,
    T_world_cam: Float64[np.ndarray, "F 4 4"],
    intrinsics: Intrinsics,
    colors: Iterable[UInt8[np.ndarray, "H W 3"]],
) -> ColorError:
    """PSNR. Protocol: unshaded vertex colours seen from each pose against the images, RGB in 0 to 255, one
    mean squared error over all pixels that the mesh covers, 10 log10(255^2 / mse).

    Infinite for equal images.

    Raises:
        InputError: the mesh covers no pixel.
    """
    caster, total, pixels, seen = Caster(mesh), 0.0, 0, 0
    for pose, color in zip(T_world_cam, colors, strict=True):
        if np.isfinite(pose).all():
            found = caster.render(pose, intrinsics, shaded=False)
            covered = found.depth > 0
            # In floats: differences of bytes would wrap round at 0
            total += float(((found.color.astype(np.float64) - color) ** 2)[covered].sum())
            pixels, seen = pixels + int(covered.sum()), seen + covered.size
    if pixels == 0:
        raise InputError("the mesh covers no pixel of the images: check that poses and mesh match")
    return ColorError(psnr_db(total / (3 * pixels)), pixels, 1.0 - pixels / seen)


def psnr_db(mean_squared_error: float) -> float:
    """Peak signal-to-noise ratio in dB of 8-bit values; infinite for no error."""
    return float(10.0 * np.log10(PEAK**2 / mean_squared_error)) if mean_squared_error > 0 else float("inf")


def _visible(
    points: Float64[np.ndarray, "N 3"],
    T_world_cam: Float64[np.ndarray, "4 4"],
    intrinsics: Intrinsics,
    depth: Float[np.ndarray, "H W"],
    tolerance_m: float,
) -> Bool[np.ndarray, "N"]:
    """Points in the image and not behind what the pixel nearest to their projection measured."""
    p_cam = transform_back(T_world_cam, points)
    # Points behind the camera project into the image as well, upside down
    ahead = np.flatnonzero(p_cam[:, 2] > 0)
    z = p_cam[ahead, 2]
    u, v = np.rint(project(p_cam[ahead], intrinsics)).T
    inside = (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)
    measured = depth[v[inside].astype(np.int64), u[inside].astype(np.int64)]
    visible = np.zeros(len(points), bool)
    visible[ahead[inside]] = (measured > 0) & (z[inside] <= measured + tolerance_m)
    return visible
