"""From a map to a coloured mesh in the world frame: the blended submaps as functions for `host.meshing`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, Float32, Float64

from mipsjax.bundle import unprojected
from mipsjax.config import Config
from mipsjax.core import blend, volume
from mipsjax.host.meshing import extract
from mipsjax.state import SlamState, inverse

CHUNK_POINTS = 65536
"""Points of one compiled call: few calls for a room, tens of megabytes of activations."""

MARGIN_VOXELS = 2.0
"""Least margin: all eight corners of a cell that holds a measured point are within sqrt(3) voxels of it."""

Points = Float[np.ndarray, "N 3"]


def reconstruct(state: SlamState, cfg: Config, voxel_m: float | None = None) -> trimesh.Trimesh:
    """Surface of the map near what the keyframes measured: metres, world frame, normals into free space.

    Vertices carry colours and their `uncertainty` (entropy in nats). `voxel_m` is the edge of a cell, that of
    `cfg.mesh` where None. A map without any surface gives an empty mesh and a logged warning.

    Raises:
        ValueError: `voxel_m` is not positive.
    """
    mesh = cfg.mesh
    voxel_m = mesh.voxel if voxel_m is None else voxel_m
    return extract(
        lambda points: _blended(state, points, lambda b: (b.psi, b.entropy), cfg, colored=False),
        observed_points(state, cfg),
        voxel_m,
        margin_m=max(mesh.margin, MARGIN_VOXELS * voxel_m),
        color=lambda points: _blended(state, points, lambda b: b.color, cfg, colored=True),
        band_m=mesh.band,
        max_entropy=mesh.max_entropy * np.log(cfg.field.classes) if cfg.field.classification else None,
        min_component_m2=mesh.min_component_m2,
    )


def observed_points(state: SlamState, cfg: Config) -> Float32[np.ndarray, "N 3"]:
    """What all keyframes measured up to `cfg.mesh.depth_max`: points in the world frame, metres."""
    parts = [
        volume.moved(submap.T_world_sub, unprojected(keyframe, state.camera, cfg.mesh.depth_max, 1, cfg))
        for submap in state.submaps
        for keyframe in submap.keyframes
    ]
    return np.concatenate(parts).astype(np.float32)


def _blended(
    state: SlamState, points: Points, wanted: Callable[[blend.Blended], Any], cfg: Config, colored: bool
) -> Any:
    """What is wanted of the blend at points of the world, in padded chunks of one size: one compilation."""
    count = len(points)
    padded = np.zeros((max(1, -(-count // CHUNK_POINTS)) * CHUNK_POINTS, 3))
    padded[:count] = points
    chunks = padded.reshape(-1, CHUNK_POINTS, 3)
    parts = [jax.device_get(wanted(_blend_chunk(state, chunk, cfg, colored))) for chunk in chunks]
    return jax.tree.map(lambda *columns: np.concatenate(columns)[:count], *parts)


def _blend_chunk(
    state: SlamState, points: Float64[np.ndarray, "C 3"], cfg: Config, colored: bool
) -> blend.Blended:
    """Over the submaps in whose box a point is. They are taken around the chunk's middle, which keeps float32 exact."""
    total, middle = blend.start(CHUNK_POINTS, cfg.field), np.eye(4)
    middle[:3, 3] = points.mean(0)
    near = jnp.asarray(points - middle[:3, 3], jnp.float32)
    for submap in state.submaps:
        T_sub_world = inverse(submap.T_world_sub)
        if volume.inside(submap.box, volume.moved(T_sub_world, points)).any():
            T = jnp.asarray(T_sub_world @ middle, jnp.float32)
            lo, hi = (jnp.asarray(face, jnp.float32) for face in submap.box)
            total = blend.add(total, submap.learned.field, T, lo, hi, near, cfg, colored)
    return total
