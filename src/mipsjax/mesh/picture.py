"""An overview picture of a room-like mesh, into which one looks from above, as into a doll's house."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float64, UInt8

from mipsjax.core.camera import Intrinsics, project
from mipsjax.core.rigid import from_parts, transform_back
from mipsjax.files import write_atomically
from mipsjax.mesh.render import face_geometry, render_mesh, unit, vertex_colors

ELEVATION_DEG = 55.0
"""Looks steeply enough over the near walls, and flat enough to show the far ones."""
FIELD_OF_VIEW_DEG = 30.0
"""Little perspective, so that near and far parts appear at about the same scale."""
AZIMUTHS = 12
"""Directions tried; the one that fills the picture best is taken."""
THUMBNAIL_PX = 64
"""Width of the trial pictures; enough to compare filled areas."""
TRIAL_POINTS = 50_000
"""Points of the surface thrown into a trial picture: a dozen a pixel."""
FRAME_FRACTION = 0.04
"""White margin on each side."""
LEVEL_DEG = 25.0
"""Surfaces within this angle of horizontal take part in levelling: floors and tables, but no walls."""
PICTURE_PX = (960, 720)
"""Width and height; a few hundred kilobytes as PNG."""
SUPERSAMPLING = 2
"""Rays per pixel and axis, against stair-steps at edges."""


def up_direction(T_world_cam: Float64[np.ndarray, "N 4 4"]) -> Float64[np.ndarray, "3"]:
    """Unit vector that points up in the world: against the mean image-down axis of the finite poses.

    Cameras are carried about upright, with y down; the mean takes out how they nod. Without any finite pose
    it is -y, which is up for a first pose of identity.
    """
    finite = T_world_cam[np.isfinite(T_world_cam).all(axis=(1, 2))]
    up = -finite[:, :3, 1].sum(axis=0)
    length = np.linalg.norm(up)
    return up / length if length > 0 else np.array([0.0, -1.0, 0.0])


def level(mesh: trimesh.Trimesh, up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Turns an approximate up direction to the mean normal of the near-horizontal surfaces. Unit vector."""
    normals, areas = face_geometry(mesh)
    up = unit(np.asarray(up, np.float64)[None])[0]
    # Narrower each time: the better up is known, the less a sloping surface may turn it
    for limit_deg in (LEVEL_DEG, LEVEL_DEG / 2, LEVEL_DEG / 4):
        cosines = normals @ up
        flat = np.abs(cosines) > np.cos(np.radians(limit_deg))
        # Normals of ceilings point down: by the sign they count for the same direction
        total = ((areas * np.sign(cosines))[flat, None] * normals[flat]).sum(axis=0)
        if np.linalg.norm(total) > 0:
            up = total / np.linalg.norm(total)
    return up


def picture(
    mesh: trimesh.Trimesh, size: tuple[int, int] = PICTURE_PX, up: Float64[np.ndarray, "3"] | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Overview of a room-like mesh, obliquely from above, on white. `size` is width, height in pixels.

    Faces seen from behind are left out, so that one looks past the near walls and through the ceiling, whose
    normals point into the room. The side from which it is seen is the one that fills the picture best. `up`
    is about up in the world (see `up_direction`), by default -y; it is levelled by the floor. An empty mesh
    gives a white picture.
    """
    width, height = size
    if len(mesh.faces) == 0:
        return np.full((height, width, 3), 255, np.uint8)
    up = level(mesh, np.array([0.0, -1.0, 0.0]) if up is None else up)
    trial = (THUMBNAIL_PX, max(1, round(THUMBNAIL_PX * height / width)))
    points, normals = _sparse_surface(mesh)
    azimuths = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    poses = [_overview_pose(points, up, azimuth, size) for azimuth in azimuths]
    filled = [_filled_pixels(points, normals, pose, _overview_intrinsics(trial)) for pose in poses]
    pose = poses[int(np.argmax(filled))]
    fine = _overview_intrinsics((width * SUPERSAMPLING, height * SUPERSAMPLING))
    color = render_mesh(with_faces(mesh, facing(mesh, pose[:3, 3])), pose, fine).color
    return np.asarray(cv2.resize(color, size, interpolation=cv2.INTER_AREA), np.uint8)


def save_picture(
    path: Path,
    mesh: trimesh.Trimesh,
    up: Float64[np.ndarray, "3"] | None = None,
    size: tuple[int, int] = PICTURE_PX,
) -> None:
    """Writes the overview of `picture` as a PNG; the file appears whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    save_png(path, picture(mesh, size, up))


def save_png(path: Path, image: UInt8[np.ndarray, "H W 3"]) -> None:
    """Writes an RGB image as PNG through a temporary file beside it.

    Raises:
        OutputError: the file cannot be written.
    """
    _, data = cv2.imencode(".png", image[..., ::-1])  # OpenCV takes BGR
    write_atomically(Path(path), data.tobytes())


def _sparse_surface(
    mesh: trimesh.Trimesh,
) -> tuple[Float64[np.ndarray, "T 3"], Float64[np.ndarray, "T 3"]]:
    """Points spread over the surface by area, and their unit normals."""
    normals, areas = face_geometry(mesh)
    cumulative = np.cumsum(areas)
    places = (np.arange(TRIAL_POINTS) + 0.5) * (cumulative[-1] / TRIAL_POINTS)
    face = np.minimum(np.searchsorted(cumulative, places), len(cumulative) - 1)
    # a plastic-number sequence spreads the points of a large face evenly over it
    first, second = np.arange(TRIAL_POINTS)[:, None] * np.array([[[0.7548776662]], [[0.5698402910]]]) % 1.0
    outward = np.sqrt(first)
    a, b, c = np.moveaxis(np.asarray(mesh.triangles, np.float64)[face], 1, 0)
    return (1 - outward) * a + outward * ((1 - second) * b + second * c), normals[face]


def _filled_pixels(
    points: Float64[np.ndarray, "T 3"],
    normals: Float64[np.ndarray, "T 3"],
    T_world_cam: Float64[np.ndarray, "4 4"],
    intrinsics: Intrinsics,
) -> int:
    """Pixels into which points fall that face the camera."""
    seen = np.einsum("ti,ti->t", normals, T_world_cam[:3, 3] - points) > 0
    p_cam = transform_back(T_world_cam, points[seen])
    # All are within the picture, which the eye was placed for
    u, v = np.rint(project(p_cam, intrinsics)).astype(np.int64).T
    return len(np.unique(v * intrinsics.width + u))


def facing(mesh: trimesh.Trimesh, eye: Float64[np.ndarray, "3"]) -> Bool[np.ndarray, "F"]:
    """The faces whose front is seen from a point."""
    normals, _ = face_geometry(mesh)
    return np.einsum("fi,fi->f", normals, eye - np.asarray(mesh.triangles)[:, 0]) > 0


def with_faces(mesh: trimesh.Trimesh, keep: Bool[np.ndarray, "F"]) -> trimesh.Trimesh:
    """Some faces of a mesh, in its colours."""
    faces = np.asarray(mesh.faces)[keep]
    return trimesh.Trimesh(mesh.vertices, faces, vertex_colors=vertex_colors(mesh), process=False)


def _overview_intrinsics(size: tuple[int, int]) -> Intrinsics:
    width, height = size
    focal = 0.5 * width / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2)
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def _overview_pose(
    points: Float64[np.ndarray, "T 3"], up: Float64[np.ndarray, "3"], azimuth: float, size: tuple[int, int]
) -> Float64[np.ndarray, "4 4"]:
    """Camera that sees all points from one side and above, as near as the picture allows."""
    right, ahead = _horizontal_axes(up)
    heading = np.cos(azimuth) * ahead + np.sin(azimuth) * right
    elevation = np.radians(ELEVATION_DEG)
    forward = np.cos(elevation) * heading - np.sin(elevation) * up
    sideways = np.cross(heading, up)
    # x right, y down, z forward, as of any camera here
    axes = np.stack([sideways, np.cross(forward, sideways), forward], axis=1)
    return from_parts(axes, axes @ _fitted_eye(points @ axes, size))


def _fitted_eye(points: Float64[np.ndarray, "V 3"], size: tuple[int, int]) -> Float64[np.ndarray, "3"]:
    """Nearest eye, in axes parallel to the camera's, from which all points fall into the picture.

    A point is inside the left edge if x - x_eye >= -t (z - z_eye) with t the tangent of half the field of
    view, and so on for each edge: four linear bounds, which leave x_eye, y_eye and the greatest z_eye.
    """
    tangents = np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2) * np.array([1.0, size[1] / size[0]])
    # What fits into a view narrower by the margins leaves them free in the whole one
    tangents *= 1.0 - 2.0 * FRAME_FRACTION
    low = (points[:, :2] + tangents * points[:, 2:]).min(axis=0)
    high = (points[:, :2] - tangents * points[:, 2:]).max(axis=0)
    # Both bounds of an axis meet at a z_eye; the axis that asks for more distance decides
    z_eye = ((low - high) / (2.0 * tangents)).min()
    return np.array([*(0.5 * (low + high)), z_eye])


def _horizontal_axes(
    up: Float64[np.ndarray, "3"],
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Two unit vectors perpendicular to up and to each other."""
    # The axis least along up: the product with one almost parallel to it is little but rounding
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    right = unit(np.cross(helper, up)[None])[0]
    return right, np.cross(up, right)
