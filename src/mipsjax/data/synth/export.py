"""Synthetic sequences as folders in the TUM layout, for other programs and for tests of the readers."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from mipsjax.data.sequence import Frame
from mipsjax.data.synth.mesh import reference_mesh
from mipsjax.data.synth.sequence import SynthSequence
from mipsjax.data.trajectory import write_tum
from mipsjax.errors import OutputError

DEPTH_UNITS_PER_METRE = 5000.0
"""Of the 16-bit depth images, as in TUM RGB-D: steps of 0.2 mm, up to 13.1 m."""


def export_tum(sequence: SynthSequence, folder: Path, voxel_m: float | None = 0.01) -> None:
    """Writes images, lists, true poses, `camera.json` and, unless `voxel_m` is None, `mesh.ply`.

    The mesh is the whole scene in cells of `voxel_m` metres. Raises OutputError if the folder has content
    already or cannot be written.
    """
    try:
        _make_empty(folder)
        for position in range(len(sequence)):
            _write_frame(folder, sequence[position])
        _write_lists(folder, sequence)
        if voxel_m is not None:
            reference_mesh(sequence.scene, voxel_m).export(folder / "mesh.ply")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error})") from error


def _make_empty(folder: Path) -> None:
    if folder.is_dir() and any(folder.iterdir()):
        raise OutputError(f"{folder}: is not empty; name a new folder")
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)


def _write_frame(folder: Path, frame: Frame) -> None:
    assert frame.color is not None and frame.depth is not None, "synthetic frames are whole"
    _write_png(folder / _file("rgb", frame.timestamp), cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
    units = np.round(frame.depth * DEPTH_UNITS_PER_METRE)
    # Where 16 bits would wrap round to something near
    beyond = units > np.iinfo(np.uint16).max
    _write_png(folder / _file("depth", frame.timestamp), np.where(beyond, 0.0, units).astype(np.uint16))


def _write_lists(folder: Path, sequence: SynthSequence) -> None:
    for kind in ("rgb", "depth"):
        rows = [f"{time:.6f} {_file(kind, time)}" for time in sequence.timestamps]
        (folder / f"{kind}.txt").write_text(
            "\n".join(["# timestamp filename", *rows]) + "\n", encoding="ascii"
        )
    assert sequence.T_world_cam is not None, "synthetic poses are known"
    write_tum(folder / "groundtruth.txt", sequence.timestamps, sequence.T_world_cam)
    camera = {**sequence.intrinsics._asdict(), "depth_scale": DEPTH_UNITS_PER_METRE, "fps": sequence.fps}
    (folder / "camera.json").write_text(json.dumps(camera, indent=2) + "\n", encoding="ascii")


def _file(kind: str, timestamp: float) -> str:
    return f"{kind}/{timestamp:.6f}.png"


def _write_png(path: Path, image: np.ndarray) -> None:
    encoded, data = cv2.imencode(".png", image)
    if not encoded:
        raise OutputError(f"{path}: cannot be encoded as PNG")
    path.write_bytes(data.tobytes())
