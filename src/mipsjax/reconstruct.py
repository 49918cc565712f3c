"""From a map to a coloured mesh in the world frame: the submap's networks as functions for `host.meshing`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Float, Float32, Float64

from mipsjax.bundle import mapping_stride
from mipsjax.config import Config, FieldConfig
from mipsjax.core import field as nf
from mipsjax.core.camera import Intrinsics
from mipsjax.host.meshing import extract
from mipsjax.state import Keyframe, SlamState

CHUNK_POINTS = 65536
"""Points of one compiled call: few calls for a room, tens of megabytes of activations."""

Out = TypeVar("Out")
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
        lambda points: _in_world(partial(_distances, cfg=cfg.field), state, points),
        observed_points(state, cfg),
        voxel_m,
        margin_m=max(mesh.margin, MARGIN_VOXELS * voxel_m),
        color=lambda points: _in_world(partial(_colors, cfg=cfg.field), state, points),
        band_m=mesh.band,
        max_entropy=mesh.max_entropy * np.log(cfg.field.classes) if cfg.field.classification else None,
        min_component_m2=mesh.min_component_m2,
    )


def observed_points(state: SlamState, cfg: Config) -> Float32[np.ndarray, "N 3"]:
    """What all keyframes measured up to `cfg.mesh.depth_max`: points in the world frame, metres."""
    camera = state.camera.decimated(mapping_stride(state.camera, cfg))
    parts = [_unprojected(keyframe, camera, state.T_world_sub, cfg) for keyframe in state.keyframes]
    return np.concatenate(parts)


def _unprojected(
    keyframe: Keyframe, camera: Intrinsics, T_world_sub: Float64[np.ndarray, "4 4"], cfg: Config
) -> Float32[np.ndarray, "N 3"]:
    v, u = np.nonzero((keyframe.depth > 0) & (keyframe.depth <= cfg.mesh.depth_max))
    depth = keyframe.depth[v, u].astype(np.float64)
    p_cam = np.stack(
        [(u - camera.cx) / camera.fx * depth, (v - camera.cy) / camera.fy * depth, depth], axis=1
    )
    return _moved(T_world_sub @ keyframe.T_sub_cam, p_cam).astype(np.float32)


def _in_world(function: Callable[[nf.Field, Array], Out], state: SlamState, points: Points) -> Out:
    """`function` of the submap at points of the world, in padded chunks of one size: one compilation."""
    p_sub = _moved(np.linalg.inv(state.T_world_sub), points)
    count = len(p_sub)
    padded = np.zeros((max(1, -(-count // CHUNK_POINTS)) * CHUNK_POINTS, 3), np.float32)
    padded[:count] = p_sub
    chunks = padded.reshape(-1, CHUNK_POINTS, 3)
    parts = [jax.device_get(function(state.submap.field, jnp.asarray(chunk))) for chunk in chunks]
    return jax.tree.map(lambda *columns: np.concatenate(columns)[:count], *parts)


@partial(jax.jit, static_argnames="cfg")
def _distances(
    field: nf.Field, points: Float[Array, "C 3"], cfg: FieldConfig
) -> tuple[Float[Array, "C"], Float[Array, "C"]]:
    """Signed distance in metres and entropy in nats."""
    found = nf.tsdf(field, points, cfg)
    return found.psi, found.entropy


@partial(jax.jit, static_argnames="cfg")
def _colors(field: nf.Field, points: Float[Array, "C 3"], cfg: FieldConfig) -> Float[Array, "C 3"]:
    """RGB in 0..1."""
    return nf.color(field, points, cfg)


def _moved(T_a_b: Float64[np.ndarray, "4 4"], p_b: Points) -> Float64[np.ndarray, "N 3"]:
    return np.asarray(p_b, np.float64) @ T_a_b[:3, :3].T + T_a_b[:3, 3]
