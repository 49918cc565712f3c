"""Surface accuracy on the synthetic room, with exact depth and with the sensor model.

    python experiments/surface.py [--seeds 0] [--names room room+noise]

Protocol: the mesh is in the world frame, not aligned. Distances of its vertices to the surface are those of the
analytic scene, exact. The reference is culled to what at least one frame saw (projected, not behind the exact
depth by more than 2 cm). Writes `surface.csv` and a picture of each mesh.
"""

from __future__ import annotations

import argparse
from typing import Any

import jax.numpy as jnp
import numpy as np

from common import OUT, Run, run, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.data.open import open_sequence
from mipsjax.data.synth.mesh import reference_mesh
from mipsjax.mesh.picture import save_picture
from mipsjax.mesh.reconstruct import reconstruct
from mipsjax.metrics.surface import Views, compare_meshes

EVERY = 10  # frames whose exact depth decides what was seen
SAMPLES = (
    1_000_000  # on each mesh: nearest neighbours among fewer would be a centimetre apart by sampling alone
)
REFERENCE_VOXEL = 0.02
CHUNK = 8192


def surface_row(done: Run, cfg: Config) -> dict[str, Any]:
    mesh = reconstruct(done.state, cfg)
    save_picture(OUT / f"{done.row['sequence'].replace(':', '-')}.png", mesh)
    exact = open_sequence(f"{done.row['sequence'].split('+')[0]}", frames=slice(0, None, EVERY))
    views = Views(exact.T_world_cam, exact.intrinsics, (exact[i].depth for i in range(len(exact))))
    reference = reference_mesh(done.sequence.scene, REFERENCE_VOXEL)
    error = compare_meshes(mesh, reference, views, count=SAMPLES).observed_part
    off = np.concatenate(
        [np.asarray(done.sequence.scene.distance(jnp.asarray(part))) for part in chunks(mesh.vertices)]
    )
    return {
        "accuracy_cm": 100 * float(np.abs(off).mean()),
        "accuracy_sampled_cm": 100 * error.accuracy_m,
        "completeness_cm": 100 * error.completeness_m,
        "completion_5cm": error.completion_ratio,
        "f_score_5cm": error.f_score,
        "vertices": len(mesh.vertices),
    }


def chunks(points: np.ndarray) -> list[np.ndarray]:
    """The points in parts of one size, the last one filled up by repetition, so that one shape is compiled."""
    filled = np.resize(points, (-(-len(points) // CHUNK) * CHUNK, 3)).astype(np.float32)
    return np.split(filled, len(filled) // CHUNK)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="*", default=[0])
    parser.add_argument("--names", nargs="*", default=["room", "room+noise"])
    options = parser.parse_args()
    enable_cache()
    OUT.mkdir(exist_ok=True)
    rows = []
    for name in options.names:
        for seed in options.seeds:
            done = run(f"synth:{name}", Config(), seed=seed)
            rows.append(done.row | surface_row(done, Config()))
            show(rows[-1])
            write_rows("surface", rows)


if __name__ == "__main__":
    main()
