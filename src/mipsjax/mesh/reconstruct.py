"""From a map to a coloured mesh in the world frame: the blended submaps as functions for `mesh.meshing`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Float, Float32, Float64, Int

from mipsjax.config.sections import Config
from mipsjax.core import blend
from mipsjax.core.losses import precision
from mipsjax.core.rigid import inverse, transform
from mipsjax.mesh.meshing import extract
from mipsjax.mesh.observed import Observed, observe, trust_at
from mipsjax.submaps.bundle import unprojected
from mipsjax.submaps.state import Keyframe, SlamState, Submap

CHUNK_POINTS = 65536
"""Points of one compiled call: few calls for a room, tens of megabytes of activations."""

MARGIN_VOXELS = 2.0
"""Least margin: all eight corners of a cell that holds a measured point are within sqrt(3) voxels of it."""

FAR_M = 1000.0
"""Coordinates beyond are meshed around the first submap: the steps of single precision there are 0.06 mm and grow with
the distance, and the lattice of the mesh ends after half a million voxels."""

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
    margin_m = max(mesh.margin, MARGIN_VOXELS * voxel_m)
    # In surveyed coordinates all of it is done near the origin, and only the result is moved to where it is
    away = _away(state)
    state = _moved(state, -away)
    blended = Blend(state, cfg, margin_m)
    found = extract(
        # Without colours, which are wanted at the vertices alone
        lambda points: blended(points, lambda b: (b.psi, b.entropy), colored=False),
        observed_points(state, cfg),
        voxel_m,
        margin_m=margin_m,
        color=lambda points: blended(points, lambda b: b.color, colored=True),
        band_m=mesh.band,
        # A share of log C, the entropy of an even distribution; a regressed distance has none to judge by
        max_entropy=mesh.max_entropy * np.log(cfg.field.classes) if cfg.field.classification else None,
        min_component_m2=mesh.min_component_m2,
    )
    if away.any():
        found.vertices = np.asarray(found.vertices, np.float64) + away
    return found


def _away(state: SlamState) -> Float64[np.ndarray, "3"]:
    """Where the first submap lies, in whole metres of the world, if that is far from the origin; otherwise zeros."""
    place = state.submaps[0].T_world_sub[:3, 3]
    return np.rint(place) if np.abs(place).max() > FAR_M else np.zeros(3)


def _moved(state: SlamState, shift: Float64[np.ndarray, "3"]) -> SlamState:
    """The same map elsewhere in the world, without a turn."""
    if not shift.any():
        return state
    move = np.eye(4)
    move[:3, 3] = shift
    submaps = tuple(submap._replace(T_world_sub=move @ submap.T_world_sub) for submap in state.submaps)
    return state._replace(submaps=submaps)


def observed_points(state: SlamState, cfg: Config) -> Float32[np.ndarray, "N 3"]:
    """What all keyframes measured up to `cfg.mesh.depth_max`: points in the world frame, metres."""
    parts = [
        transform(submap.T_world_sub, _measured(state, keyframe, cfg))
        for submap in state.submaps
        for keyframe in submap.keyframes
    ]
    return np.concatenate(parts).astype(np.float32)


def _measured(state: SlamState, keyframe: Keyframe, cfg: Config) -> Float64[np.ndarray, "N 3"]:
    return unprojected(keyframe, state.camera, cfg.mesh.depth_max, 1, cfg)


class Blend:
    """The blend of all submaps as a function of points of the world, metres.

    A submap counts as far as its trust reaches (`mesh/observed.py`), which is `margin_m` and the truncation at least
    from what it has measured, fading on the way.
    """

    def __init__(self, state: SlamState, cfg: Config, margin_m: float = 0.0) -> None:
        self._state, self._cfg = state, cfg
        # Cells as wide as the margin, since trust reaches one cell beyond what was measured
        self._reach = max(margin_m, cfg.field.truncation)
        self._observed = [self._of_submap(submap) for submap in state.submaps]

    def _of_submap(self, submap: Submap) -> Observed:
        points = [_measured(self._state, keyframe, self._cfg) for keyframe in submap.keyframes]
        ranges = [
            np.linalg.norm(p - k.T_sub_cam[None, :3, 3], axis=1)
            for p, k in zip(points, submap.keyframes, strict=True)
        ]
        # By the nearest range a surface was measured from: noise of depth grows with its square
        trust = precision(np.concatenate(ranges), self._cfg.sensor)
        return observe(np.concatenate(points), trust, self._reach)

    def __call__(self, points: Points, wanted: Callable[[blend.Blended], Any], colored: bool) -> Any:
        """What is wanted of the blend, in padded chunks of one size: one compilation."""
        count = len(points)
        # One chunk at least, so that no points, too, have a result of the right form
        padded = np.zeros((max(1, -(-count // CHUNK_POINTS)) * CHUNK_POINTS, 3))
        padded[:count] = points
        chunks = padded.reshape(-1, CHUNK_POINTS, 3)
        parts = [jax.device_get(wanted(self._chunk(chunk, colored))) for chunk in chunks]
        return jax.tree.map(lambda *columns: np.concatenate(columns)[:count], *parts)

    def leading(self, points: Points) -> Int[np.ndarray, " N"]:
        """The submap that is trusted most at each point; -1 where none is."""
        trust = np.stack(
            [
                trust_at(observed, transform(inverse(submap.T_world_sub), points))
                for submap, observed in zip(self._state.submaps, self._observed, strict=True)
            ]
        )
        return np.where(trust.max(0) > 0, trust.argmax(0), -1)

    def _chunk(self, points: Float64[np.ndarray, "C 3"], colored: bool) -> blend.Blended:
        """Over the submaps that have measured near a point, which need not be in their boxes.

        They are taken around the chunk's middle, which keeps float32 exact.
        """
        cfg = self._cfg
        total, middle = blend.start(CHUNK_POINTS, cfg.field), np.eye(4)
        middle[:3, 3] = points.mean(0)
        near = jnp.asarray(points - middle[:3, 3], jnp.float32)
        for submap, observed in zip(self._state.submaps, self._observed, strict=True):
            T_sub_world = inverse(submap.T_world_sub)
            there = transform(T_sub_world, points)
            trust = trust_at(observed, there)
            # Where a submap counts for nothing its networks, the costly part, are not asked
            if (trust > 0).any():
                T = jnp.asarray(T_sub_world @ middle, jnp.float32)
                total = blend.add(total, submap.learned.field, T, jnp.asarray(trust), near, cfg, colored)
        return total
