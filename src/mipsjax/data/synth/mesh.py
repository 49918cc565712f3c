"""The exact surface of a scene as a coloured triangle mesh, for measuring reconstructions."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float, Float32, Float64, Int
from skimage.measure import marching_cubes

from mipsjax.data.synth.cull import is_large, nearby
from mipsjax.data.synth.render import display, radiance
from mipsjax.data.synth.scene import Scene

# Cells along the side of a block: small enough that most blocks hold no surface and are skipped
_BLOCK_CELLS = 20
# Side in metres of the squares on the floor around which the shapes of a large scene are gathered
_PART_M = 1.5
# Points evaluated in one compiled call
_CHUNK = 65536
# Vertices nearer than this share of a voxel are one: neighbouring blocks agree to rounding only
_WELD = 1e-2
# Corrections of vertices by Newton's method; the first leaves micrometres on flat and round faces
_CORRECTIONS = 2
# Greatest correction in voxels: at creases the linear model points anywhere
_CORRECTION_VOXELS = 0.5


def reference_mesh(scene: Scene, voxel_m: float = 0.01) -> trimesh.Trimesh:
    """The zero set of the scene's distance in the world frame, metres, normals into free space.

    Marching cubes on blocks of cells of `voxel_m`, vertices then moved onto the surface; edges are cut by up
    to half a voxel. Vertex colours are those of the rendered images.
    """
    # A cell and a half outside, so that no wall along the axes lies in a plane of the grid
    low = np.asarray(scene.bounds, np.float64)[0] - 1.5 * voxel_m
    part_at = _parts(scene, _BLOCK_CELLS * voxel_m)
    pieces = [
        _mesh_block(part_at(low + voxel_m * first), low, first, voxel_m)
        for first in _surface_blocks(scene, low, voxel_m)
    ]
    vertices, faces = _joined([piece for piece in pieces if piece is not None])
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(digits_vertex=int(np.ceil(-np.log10(_WELD * voxel_m))))
    mesh.update_faces(_three_cornered(mesh.faces))
    mesh.remove_unreferenced_vertices()
    bound = jnp.float32(_CORRECTION_VOXELS * voxel_m)
    on_surface = _in_chunks(lambda points: _onto_surface(scene, points, bound), mesh.vertices)
    color = display(_in_chunks(lambda points: radiance(scene, points), on_surface))
    return trimesh.Trimesh(on_surface, mesh.faces, vertex_colors=color, process=False)


def _parts(scene: Scene, block_m: float) -> Callable[[Float64[np.ndarray, "3"]], Scene]:
    """The scene around a block of that side that begins at a point: the whole of a small one."""

    @cache
    def part(column: tuple[int, int]) -> Scene:
        low = _PART_M * np.array(column, np.float64)
        return nearby(scene, low, low + _PART_M + block_m)

    if not is_large(scene):
        return lambda _: scene
    return lambda begin: part((int(begin[0] // _PART_M), int(begin[2] // _PART_M)))


def _surface_blocks(scene: Scene, low: Float64[np.ndarray, "3"], voxel_m: float) -> Int[np.ndarray, "B 3"]:
    """First cells of blocks that may hold surface: the distance in the middle is within half a diagonal."""
    high = np.asarray(scene.bounds, np.float64)[1] + voxel_m
    counts = np.ceil((high - low) / (_BLOCK_CELLS * voxel_m)).astype(int)
    first = _BLOCK_CELLS * np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    middle = low + voxel_m * (first + _BLOCK_CELLS / 2)
    free = _in_chunks(lambda points: _distance(scene, points), middle)
    return first[np.abs(free) <= np.sqrt(3.0) / 2 * _BLOCK_CELLS * voxel_m]


def _mesh_block(
    scene: Scene, low: Float64[np.ndarray, "3"], first: Int[np.ndarray, "3"], voxel_m: float
) -> tuple[Float64[np.ndarray, "V 3"], Int[np.ndarray, "T 3"]] | None:
    """Vertices in the world frame and faces of one block; None if no surface passes through it."""
    origin = jnp.asarray(low, jnp.float32)
    values = np.array(_block_distances(scene, origin, jnp.asarray(first, jnp.int32), jnp.float32(voxel_m)))
    # A block that ends exactly on the surface leaves it to the neighbour on the other side, and to no other
    values[values == 0.0] = np.finfo(np.float32).tiny
    if values.min() > 0.0 or values.max() < 0.0:
        return None
    vertices, faces, _, _ = marching_cubes(values, level=0.0, gradient_direction="descent")
    return low + voxel_m * (first + vertices.astype(np.float64)), faces


@jax.jit
def _block_distances(
    scene: Scene, low: Float[Array, "3"], first: Int[Array, "3"], voxel_m: Float[Array, ""]
) -> Float[Array, "G G G"]:
    # From whole cell numbers, so that neighbouring blocks see the same bits on the face they share
    cells = jnp.stack(jnp.mgrid[tuple(slice(_BLOCK_CELLS + 1) for _ in range(3))], axis=-1)
    cells = (cells + first[None, None, None, :]).astype(jnp.float32)
    return scene.distance(low[None, None, None, :] + voxel_m * cells)


@jax.jit
def _distance(scene: Scene, points: Float[Array, "N 3"]) -> Float[Array, "N"]:
    return scene.distance(points)


@jax.jit
def _onto_surface(
    scene: Scene, points: Float[Array, "N 3"], bound_m: Float[Array, ""]
) -> Float[Array, "N 3"]:
    for _ in range(_CORRECTIONS):
        surface = scene.surface(points)
        points = points - jnp.clip(surface.distance, -bound_m, bound_m)[:, None] * surface.normal
    return points


def _in_chunks(
    function: Callable[[Float32[Array, "N 3"]], Array], points: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N *rest"]:
    """`function` of all points, in calls of one size: one compilation, little memory."""
    count = len(points)
    padded = np.resize(points, (-(-count // _CHUNK) * _CHUNK, 3)).astype(np.float32)
    parts = [np.asarray(function(jnp.asarray(part))) for part in padded.reshape(-1, _CHUNK, 3)]
    return np.concatenate(parts)[:count]


def _joined(
    pieces: list[tuple[Float64[np.ndarray, "V 3"], Int[np.ndarray, "T 3"]]],
) -> tuple[Float64[np.ndarray, "V 3"], Int[np.ndarray, "T 3"]]:
    """One vertex list for all pieces."""
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in pieces[:-1])])
    faces = np.concatenate([faces + first for (_, faces), first in zip(pieces, firsts, strict=True)])
    return np.concatenate([vertices for vertices, _ in pieces]), faces


def _three_cornered(faces: Int[np.ndarray, "T 3"]) -> Bool[np.ndarray, "T"]:
    """Faces whose corners are three vertices: welding makes lines of some."""
    a, b, c = faces.T
    return (a != b) & (b != c) & (c != a)
