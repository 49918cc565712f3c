"""Pictures and depth images of a triangle mesh by ray casting on the CPU, without any display.

Two uses: exact depth and vertex colours as a camera of known pose would see them (for the mesh metrics and
for inside views), and an overview picture into which one looks from above, as into a doll's house.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from jaxtyping import Bool, Float32, Float64, Int, UInt8
from trimesh.ray.ray_pyembree import RayMeshIntersector
from trimesh.visual import ColorVisuals

from mipsjax.core.camera import Intrinsics
from mipsjax.errors import OutputError

WHITE = (255, 255, 255)
PLAIN = 205
"""Grey level of a mesh without colours: light enough to show shading, darker than the background."""
AMBIENT = 0.3
"""Brightness of a surface that faces away from the lamp: dark enough to show shape, light enough to keep its
colour."""
LAMP_CAM = np.array([-0.45, -0.45, -0.77]) / np.linalg.norm([-0.45, -0.45, -0.77])
"""Direction to the lamp in the camera frame: above, left and behind the viewer, so that walls that meet in a
corner differ."""
CREASE_COS = np.cos(np.radians(40.0))
"""Normals are interpolated only up to this angle to the face, so that corners of walls stay sharp."""
RAYS_PER_BATCH = 1 << 16
"""Bounds memory: about half a kilobyte a ray is held at once."""
PARALLEL = 1e-12
"""Below this cosine a ray runs along its triangle and has no point of intersection."""
ELEVATION_DEG = 55.0
"""Overview: looks steeply enough over the near walls, and flat enough to show the far ones."""
FIELD_OF_VIEW_DEG = 30.0
"""Overview: little perspective, so that near and far parts appear at about the same scale."""
AZIMUTHS = 12
"""Overview: directions tried; the one that fills the picture best is taken."""
THUMBNAIL_PX = 64
"""Width of the trial pictures; enough to compare filled areas."""
TRIAL_POINTS = 50_000
"""Points of the surface thrown into a trial picture: a dozen a pixel."""
FRAME_FRACTION = 0.04
"""Overview: white margin on each side."""
LEVEL_DEG = 25.0
"""Surfaces within this angle of horizontal take part in levelling: floors and tables, but no walls."""
PICTURE_PX = (960, 720)
"""Overview: width and height; a few hundred kilobytes as PNG."""
SUPERSAMPLING = 2
"""Overview: rays per pixel and axis, against stair-steps at edges."""


class Render(NamedTuple):
    """What a pinhole camera sees of a mesh."""

    color: UInt8[np.ndarray, "H W 3"]
    """RGB; the background colour where no surface is hit."""
    depth: Float32[np.ndarray, "H W"]
    """z-depth in metres, 0 where no surface is hit."""


class _Hits(NamedTuple):
    """First intersections of rays with a mesh; rows without one have face -1."""

    face: Int[np.ndarray, "R"]
    depth: Float64[np.ndarray, "R"]
    """Multiples of the ray's direction, 0 where nothing is hit."""
    weights: Float64[np.ndarray, "R 3"]
    """Barycentric coordinates in the face."""


class Caster:
    """A mesh prepared for ray casting; build it once for many views.

    Attributes:
        mesh: the mesh as given; world frame, metres.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.mesh = mesh
        self._intersector = RayMeshIntersector(mesh) if len(mesh.faces) else None
        self._corners = np.asarray(mesh.triangles, dtype=np.float64)
        self._face_normals, self._vertex_normals = _normals(mesh)
        self._colors = vertex_colors(mesh)

    def render(
        self,
        T_world_cam: Float64[np.ndarray, "4 4"],
        intrinsics: Intrinsics,
        shaded: bool = True,
        background: tuple[int, int, int] = WHITE,
    ) -> Render:
        """Colour and depth seen from a pose. Depth is exact to float32: one ray through each pixel centre.

        With `shaded` the vertex colours are darkened by the angle to a wide lamp above the viewer's left
        shoulder (Lambert's cosine, raised so that it fades out only opposite the lamp), without it they are
        given as they are. Both sides of a surface are seen.
        """
        height, width = intrinsics.height, intrinsics.width
        color = np.empty((height * width, 3), np.uint8)
        depth = np.zeros(height * width, np.float32)
        for rows, directions in _pixel_rays(intrinsics):
            rays = directions @ T_world_cam[:3, :3].T
            hits = self._cast(np.broadcast_to(T_world_cam[:3, 3], rays.shape), rays)
            lamp = T_world_cam[:3, :3] @ LAMP_CAM if shaded else None
            color[rows] = self._shade(hits, rays, lamp, background)
            depth[rows] = hits.depth
        return Render(color.reshape(height, width, 3), depth.reshape(height, width))

    def _cast(self, origins: Float64[np.ndarray, "R 3"], rays: Float64[np.ndarray, "R 3"]) -> _Hits:
        """First hits in double precision: the triangle comes from the ray caster, its plane is met
        exactly."""
        face = np.full(len(rays), -1)
        depth, weights = np.zeros(len(rays)), np.zeros((len(rays), 3))
        if self._intersector is not None:
            face = np.array(self._intersector.intersects_first(origins, rays), dtype=np.int64)
        along = np.einsum("ri,ri->r", self._face_normals[face], rays) if len(self._face_normals) else depth
        face[np.abs(along) < PARALLEL] = -1
        hit = face >= 0
        corners = self._corners[face[hit]]
        height = np.einsum("ri,ri->r", self._face_normals[face[hit]], corners[:, 0] - origins[hit])
        depth[hit] = height / along[hit]
        points = origins[hit] + depth[hit, None] * rays[hit]
        weights[hit] = _barycentric(points, corners)
        return _Hits(face, depth, weights)

    def _shade(
        self,
        hits: _Hits,
        rays: Float64[np.ndarray, "R 3"],
        lamp: Float64[np.ndarray, "3"] | None,
        background: tuple[int, int, int],
    ) -> UInt8[np.ndarray, "R 3"]:
        out = np.empty((len(rays), 3), np.uint8)
        out[:] = background
        hit = hits.face >= 0
        vertices = np.asarray(self.mesh.faces)[hits.face[hit]]
        color = np.einsum("rk,rkc->rc", hits.weights[hit], self._colors[vertices].astype(np.float64))
        if lamp is not None:
            normals = self._interpolated_normals(hits.face[hit], vertices, hits.weights[hit])
            toward_viewer = -np.sign(np.einsum("ri,ri->r", normals, rays[hit]))
            lit = 0.5 + 0.5 * toward_viewer * (normals @ lamp)
            color *= (AMBIENT + (1.0 - AMBIENT) * lit)[:, None]
        out[hit] = np.clip(np.rint(color), 0, 255).astype(np.uint8)
        return out

    def _interpolated_normals(
        self,
        face: Int[np.ndarray, "R"],
        vertices: Int[np.ndarray, "R 3"],
        weights: Float64[np.ndarray, "R 3"],
    ) -> Float64[np.ndarray, "R 3"]:
        """Smooth normals on curved parts, the face's own near a crease."""
        flat = self._face_normals[face]
        corner = self._vertex_normals[vertices]
        smooth = np.einsum("rki,rki->rk", corner, np.broadcast_to(flat[:, None], corner.shape)) > CREASE_COS
        chosen = np.where(smooth[..., None], corner, flat[:, None])
        return _unit(np.einsum("rk,rki->ri", weights, chosen))


def render_mesh(
    mesh: trimesh.Trimesh,
    T_world_cam: Float64[np.ndarray, "4 4"],
    intrinsics: Intrinsics,
    shaded: bool = True,
    background: tuple[int, int, int] = WHITE,
) -> Render:
    """One view of a mesh; see `Caster.render`, which is the faster way to many views of the same mesh."""
    return Caster(mesh).render(np.asarray(T_world_cam, np.float64), intrinsics, shaded, background)


def vertex_colors(mesh: trimesh.Trimesh) -> UInt8[np.ndarray, "V 3"]:
    """RGB of every vertex; a light grey where the mesh has no vertex colours."""
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind == "vertex":
        return np.asarray(mesh.visual.vertex_colors, dtype=np.uint8)[:, :3]
    return np.full((len(mesh.vertices), 3), PLAIN, np.uint8)


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
    normals, areas = _face_geometry(mesh)
    up = _unit(np.asarray(up, np.float64)[None])[0]
    for limit_deg in (LEVEL_DEG, LEVEL_DEG / 2, LEVEL_DEG / 4):
        cosines = normals @ up
        flat = np.abs(cosines) > np.cos(np.radians(limit_deg))
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
    color = render_mesh(_keep_faces(mesh, _facing(mesh, pose[:3, 3])), pose, fine).color
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
    _, data = cv2.imencode(".png", image[..., ::-1])
    write_atomically(Path(path), data.tobytes())


def write_atomically(path: Path, data: bytes) -> None:
    """Writes a file that is there whole or not at all, also after a crash or on a full disk.

    Raises:
        OutputError: the folder is missing or not writable, or the disk is full.
    """
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None and os.path.exists(temporary):
            os.unlink(temporary)
        raise OutputError(
            f"cannot write {path}: {error.strerror}; check the folder and free space"
        ) from error


def _pixel_rays(intrinsics: Intrinsics) -> Iterator[tuple[slice, Float64[np.ndarray, "R 3"]]]:
    """Directions with z = 1 through pixel centres, camera frame, in batches of whole image rows."""
    columns = (np.arange(intrinsics.width) - intrinsics.cx) / intrinsics.fx
    rows_per_batch = max(1, RAYS_PER_BATCH // intrinsics.width)
    for top in range(0, intrinsics.height, rows_per_batch):
        rows = np.arange(top, min(top + rows_per_batch, intrinsics.height))
        y, x = np.meshgrid((rows - intrinsics.cy) / intrinsics.fy, columns, indexing="ij")
        batch = slice(top * intrinsics.width, (int(rows[-1]) + 1) * intrinsics.width)
        yield batch, np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)


def _barycentric(
    points: Float64[np.ndarray, "R 3"], corners: Float64[np.ndarray, "R 3 3"]
) -> Float64[np.ndarray, "R 3"]:
    """Weights of a triangle's corners at points of its plane, clipped to the triangle."""
    a, b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    aa, ab, bb = (np.einsum("ri,ri->r", p, q) for p, q in ((a, a), (a, b), (b, b)))
    ca, cb = np.einsum("ri,ri->r", c, a), np.einsum("ri,ri->r", c, b)
    denominator = np.maximum(aa * bb - ab * ab, np.finfo(np.float64).tiny)
    v = np.clip((bb * ca - ab * cb) / denominator, 0.0, 1.0)
    w = np.clip((aa * cb - ab * ca) / denominator, 0.0, 1.0 - v)
    return np.stack([1.0 - v - w, v, w], axis=1)


def _unit(vectors: Float64[np.ndarray, "R 3"]) -> Float64[np.ndarray, "R 3"]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)


def _face_geometry(mesh: trimesh.Trimesh) -> tuple[Float64[np.ndarray, "F 3"], Float64[np.ndarray, "F"]]:
    """Unit normals by the right-hand rule and areas in square metres; zero normals for degenerate faces."""
    corners = np.asarray(mesh.triangles, np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return _unit(cross), 0.5 * np.linalg.norm(cross, axis=1)


def _normals(mesh: trimesh.Trimesh) -> tuple[Float64[np.ndarray, "F 3"], Float64[np.ndarray, "V 3"]]:
    """Face normals and the area-weighted normals of the vertices."""
    normals, areas = _face_geometry(mesh)
    faces, total = np.asarray(mesh.faces), np.zeros((len(mesh.vertices), 3))
    for axis in range(3):
        weights = np.repeat(areas * normals[:, axis], 3)
        total[:, axis] = np.bincount(faces.ravel(), weights, len(mesh.vertices))
    return normals, _unit(total)


def _sparse_surface(
    mesh: trimesh.Trimesh,
) -> tuple[Float64[np.ndarray, "T 3"], Float64[np.ndarray, "T 3"]]:
    """Points spread over the surface by area, and their unit normals."""
    normals, areas = _face_geometry(mesh)
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
    x, y, z = ((points[seen] - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]).T
    u = np.rint(intrinsics.fx * x / z + intrinsics.cx).astype(np.int64)
    v = np.rint(intrinsics.fy * y / z + intrinsics.cy).astype(np.int64)
    return len(np.unique(v * intrinsics.width + u))


def _facing(mesh: trimesh.Trimesh, eye: Float64[np.ndarray, "3"]) -> Bool[np.ndarray, "F"]:
    normals, _ = _face_geometry(mesh)
    return np.einsum("fi,fi->f", normals, eye - np.asarray(mesh.triangles)[:, 0]) > 0


def _keep_faces(mesh: trimesh.Trimesh, keep: Bool[np.ndarray, "F"]) -> trimesh.Trimesh:
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
    T_world_cam = np.eye(4)
    T_world_cam[:3, :3] = np.stack([sideways, np.cross(forward, sideways), forward], axis=1)
    T_world_cam[:3, 3] = T_world_cam[:3, :3] @ _fitted_eye(points @ T_world_cam[:3, :3], size)
    return T_world_cam


def _fitted_eye(points: Float64[np.ndarray, "V 3"], size: tuple[int, int]) -> Float64[np.ndarray, "3"]:
    """Nearest eye, in axes parallel to the camera's, from which all points fall into the picture.

    A point is inside the left edge if x - x_eye >= -t (z - z_eye) with t the tangent of half the field of
    view, and so on for each edge: four linear bounds, which leave x_eye, y_eye and the greatest z_eye.
    """
    tangents = np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2) * np.array([1.0, size[1] / size[0]])
    tangents *= 1.0 - 2.0 * FRAME_FRACTION
    low = (points[:, :2] + tangents * points[:, 2:]).min(axis=0)
    high = (points[:, :2] - tangents * points[:, 2:]).max(axis=0)
    z_eye = ((low - high) / (2.0 * tangents)).min()
    return np.array([*(0.5 * (low + high)), z_eye])


def _horizontal_axes(
    up: Float64[np.ndarray, "3"],
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Two unit vectors perpendicular to up and to each other."""
    helper = np.eye(3)[int(np.argmin(np.abs(up)))]
    right = _unit(np.cross(helper, up)[None])[0]
    return right, np.cross(up, right)
