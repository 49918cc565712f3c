"""A coloured mesh as a PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from mipsjax.files import write_atomically
from mipsjax.mesh.render import vertex_colors

DOUBLE_FROM_M = 1000.0
"""Coordinates of the world beyond this are written in double precision."""


def export_ply(path: Path, mesh: trimesh.Trimesh) -> None:
    """Writes a binary PLY: float positions, uint8 colours, float `uncertainty` where the mesh has it.

    Positions beyond DOUBLE_FROM_M are double, which single precision would round to visible steps. The same
    mesh gives the same bytes. The file appears whole or not at all; an empty mesh gives a valid file.

    Raises:
        OutputError: the file cannot be written.
    """
    vertices = np.asarray(mesh.vertices)
    far = len(vertices) > 0 and bool(np.abs(vertices).max() > DOUBLE_FROM_M)
    vertex = np.zeros(len(vertices), _vertex_type("uncertainty" in mesh.vertex_attributes, far))
    vertex["x"], vertex["y"], vertex["z"] = vertices.T
    vertex["red"], vertex["green"], vertex["blue"] = vertex_colors(mesh).T
    if "uncertainty" in mesh.vertex_attributes:
        vertex["uncertainty"] = mesh.vertex_attributes["uncertainty"]
    face = np.zeros(len(mesh.faces), [("count", "u1"), ("vertex_indices", "<i4", (3,))])
    face["count"], face["vertex_indices"] = 3, mesh.faces
    write_atomically(Path(path), _ply_header(vertex, face) + vertex.tobytes() + face.tobytes())


def restore_uncertainty(mesh: trimesh.Trimesh) -> None:
    """Makes `uncertainty` an attribute of the vertices again in a mesh that trimesh read from a PLY.

    trimesh keeps properties that it does not know apart, as they were in the file. A mesh without it stays as it is.
    """
    vertex = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = getattr(getattr(vertex, "dtype", None), "names", None) or ()
    if "uncertainty" in names and len(vertex) == len(mesh.vertices):
        mesh.vertex_attributes["uncertainty"] = np.asarray(vertex["uncertainty"], np.float32).reshape(-1)


def _vertex_type(with_uncertainty: bool, far: bool) -> np.dtype:
    position = "<f8" if far else "<f4"
    fields = [(name, position) for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    return np.dtype(fields + ([("uncertainty", "<f4")] if with_uncertainty else []))


def _ply_header(vertex: np.ndarray, face: np.ndarray) -> bytes:
    names = {np.dtype("<f4"): "float", np.dtype("<f8"): "double", np.dtype("u1"): "uchar"}
    fields = vertex.dtype.fields or {}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}"]
    lines += [f"property {names[kind[0]]} {name}" for name, kind in fields.items()]
    lines += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header", ""]
    return "\n".join(lines).encode("ascii")
