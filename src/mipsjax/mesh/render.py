"""Depth and colour images of a triangle mesh by ray casting on the CPU, without any display.

Exact depth and vertex colours as a camera of known pose would see them, for the mesh metrics and for pictures.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import trimesh
from jaxtyping import Float32, Float64, Int, UInt8
from trimesh.ray.ray_pyembree import RayMeshIntersector
from trimesh.visual import ColorVisuals

from mipsjax.core.camera import Intrinsics, rays

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
            # Not made unit vectors: z is 1 in the camera, so that multiples of them are z-depths
            in_world = directions @ T_world_cam[:3, :3].T
            hits = self._cast(np.broadcast_to(T_world_cam[:3, 3], in_world.shape), in_world)
            lamp = T_world_cam[:3, :3] @ LAMP_CAM if shaded else None
            color[rows] = self._shade(hits, in_world, lamp, background)
            depth[rows] = hits.depth
        return Render(color.reshape(height, width, 3), depth.reshape(height, width))

    def _cast(self, origins: Float64[np.ndarray, "R 3"], rays: Float64[np.ndarray, "R 3"]) -> _Hits:
        """First hits in double precision: the triangle comes from the ray caster, its plane is met
        exactly."""
        face = np.full(len(rays), -1)
        depth, weights = np.zeros(len(rays)), np.zeros((len(rays), 3))
        if self._intersector is not None:
            # Embree works in single precision: only which triangle is hit comes from it
            face = np.array(self._intersector.intersects_first(origins, rays), dtype=np.int64)
        # A ray that hits nothing has face -1, reads the last normal here, and is no hit below
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
            # A surface seen from behind is lit as from the front
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
        return unit(np.einsum("rk,rki->ri", weights, chosen))


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


def _pixel_rays(intrinsics: Intrinsics) -> Iterator[tuple[slice, Float64[np.ndarray, "R 3"]]]:
    """Directions with z = 1 through pixel centres, camera frame, in batches of whole image rows."""
    width = intrinsics.width
    rows_per_batch = max(1, RAYS_PER_BATCH // width)
    for top in range(0, intrinsics.height, rows_per_batch):
        end = min(top + rows_per_batch, intrinsics.height)
        v, u = np.mgrid[top:end, :width].reshape(2, -1)
        yield slice(top * width, end * width), rays(v, u, intrinsics)


def _barycentric(
    points: Float64[np.ndarray, "R 3"], corners: Float64[np.ndarray, "R 3 3"]
) -> Float64[np.ndarray, "R 3"]:
    """Weights of a triangle's corners at points of its plane, clipped to the triangle."""
    a, b, c = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    aa, ab, bb = (np.einsum("ri,ri->r", p, q) for p, q in ((a, a), (a, b), (b, b)))
    ca, cb = np.einsum("ri,ri->r", c, a), np.einsum("ri,ri->r", c, b)
    denominator = np.maximum(aa * bb - ab * ab, np.finfo(np.float64).tiny)  # 0 of a triangle without area
    # One after the other, so that the three still sum to 1
    v = np.clip((bb * ca - ab * cb) / denominator, 0.0, 1.0)
    w = np.clip((aa * cb - ab * ca) / denominator, 0.0, 1.0 - v)
    return np.stack([1.0 - v - w, v, w], axis=1)


def unit(vectors: Float64[np.ndarray, "R 3"]) -> Float64[np.ndarray, "R 3"]:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths > 0, lengths, 1.0)


def face_geometry(mesh: trimesh.Trimesh) -> tuple[Float64[np.ndarray, "F 3"], Float64[np.ndarray, "F"]]:
    """Unit normals by the right-hand rule and areas in square metres; zero normals for degenerate faces."""
    corners = np.asarray(mesh.triangles, np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return unit(cross), 0.5 * np.linalg.norm(cross, axis=1)


def _normals(mesh: trimesh.Trimesh) -> tuple[Float64[np.ndarray, "F 3"], Float64[np.ndarray, "V 3"]]:
    """Face normals and the area-weighted normals of the vertices."""
    normals, areas = face_geometry(mesh)
    faces, total = np.asarray(mesh.faces), np.zeros((len(mesh.vertices), 3))
    for axis in range(3):
        weights = np.repeat(areas * normals[:, axis], 3)
        total[:, axis] = np.bincount(faces.ravel(), weights, len(mesh.vertices))
    return normals, unit(total)
