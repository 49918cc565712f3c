"""The same part of several meshes, seen from the same place, side by side.

    python experiments/closeup.py experiments/out/mesh-a.ply experiments/out/mesh-b.ply \\
        --low -2 -2 -2 --high 3 2 4 [--azimuth 0] [--elevation 55] [--out closeup]

`--low` and `--high` are opposite corners of what is shown, metres, in the frame of the meshes (y down). Faces seen from
behind are left out, as in `mesh/picture.py`. Writes a PNG.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64, UInt8

from common import OUT
from mipsjax.core.camera import Intrinsics
from mipsjax.core.rigid import from_parts
from mipsjax.mesh.picture import facing, save_png, with_faces
from mipsjax.mesh.render import render_mesh

WIDTH, HEIGHT = 480, 400
FIELD_OF_VIEW_DEG = 30.0  # from top to bottom, the shorter side


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("meshes", type=Path, nargs="+")
    parser.add_argument("--low", type=float, nargs=3, required=True)
    parser.add_argument("--high", type=float, nargs=3, required=True)
    parser.add_argument("--azimuth", type=float, default=0.0, help="degrees; 0 looks along z")
    parser.add_argument("--elevation", type=float, default=55.0, help="degrees; 90 looks straight down")
    parser.add_argument("--out", default="closeup", help="name of the PNG")
    options = parser.parse_args()
    low, high = np.array(options.low), np.array(options.high)
    T_world_cam = pose(low, high, np.radians(options.azimuth), np.radians(options.elevation))
    panels = [panel(trimesh.load(path), low, high, T_world_cam) for path in options.meshes]
    OUT.mkdir(exist_ok=True)
    save_png(OUT / f"{options.out}.png", np.concatenate(panels, axis=1))


def pose(
    low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"], azimuth: float, elevation: float
) -> Float64[np.ndarray, "4 4"]:
    """Camera to world; sees the whole sphere around the box."""
    down = np.array([0.0, 1.0, 0.0])
    heading = np.array([np.sin(azimuth), 0.0, np.cos(azimuth)])
    forward = np.cos(elevation) * heading + np.sin(elevation) * down
    right = np.cross(down, heading)
    away = np.linalg.norm(high - low) / 2 / np.sin(np.radians(FIELD_OF_VIEW_DEG) / 2)
    axes = np.stack([right, np.cross(forward, right), forward], axis=1)
    return from_parts(axes, (low + high) / 2 - away * forward)


def panel(
    mesh: trimesh.Trimesh,
    low: Float64[np.ndarray, "3"],
    high: Float64[np.ndarray, "3"],
    T_world_cam: Float64[np.ndarray, "4 4"],
) -> UInt8[np.ndarray, "H W 3"]:
    inside = ((mesh.vertices >= low) & (mesh.vertices <= high)).all(axis=1)
    part = with_faces(mesh, inside[mesh.faces].all(axis=1) & facing(mesh, T_world_cam[:3, 3]))
    focal = HEIGHT / 2 / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2)
    camera = Intrinsics(focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
    return render_mesh(part, T_world_cam, camera).color


if __name__ == "__main__":
    main()
