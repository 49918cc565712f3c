"""Scenes of many submaps: accuracy, loops, seams and memory, with parts of the method switched off.

    python experiments/large.py [--names corridor-loop+noise apartment+noise no-loop+noise living] [--seeds 0 1 2]
                                [--switches full no-lc no-si no-sr frustum surface] [--stride 1] [--no-surface]

`living` is `small_house/living` of the development data. The switches are the paper's: no loop closure, no first fit
of a new submap (SI), no bundle adjustment at a revisit (SR); `frustum` and `surface` are the other definitions of the
volume that a submap governs. ATE RMSE after rigid alignment, over all frames. The
mesh is moved by that same alignment. Accuracy is the mean distance of its vertices to the analytic scene; the sampled
one and completeness by 1,000,000 points on each mesh. The reference is culled to what the sensor measured from within
5 m in every 10th frame. So is the mesh for the sampled accuracy, which drops what lies more than 2 cm behind the true
surface and flatters it; for completeness the mesh is whole. Seams are measured where the scene is analytic
(`seams.py`). Writes `large.csv`, a row a run, `large-memory.csv`, a row each new submap, and for each run the mesh, a
picture of it, and a plan: trajectory and walls from above.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import resource
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
import trimesh

from common import DATA, OUT, Run, changed, run, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.core.rigid import align_rigid, transform
from mipsjax.data.open import open_sequence
from mipsjax.data.synth.mesh import reference_mesh
from mipsjax.mesh.picture import save_picture
from mipsjax.mesh.reconstruct import Blend, reconstruct
from mipsjax.metrics.surface import Views, compare_meshes
from mipsjax.submaps.state import Pose, SlamState, keyframe_bytes, trajectory
from seams import errors, seams

NAMES = ("corridor-loop+noise", "apartment+noise", "no-loop+noise", "living")
SWITCHES = {
    "full": ("loop", {}),
    "no-lc": ("loop", {"enabled": False}),
    "no-si": ("map", {"submap_steps": 0}),
    "no-sr": ("map", {"revisit_steps": 0}),
    "frustum": ("volume", {"governs": "frustum"}),
    "surface": ("volume", {"governs": "surface"}),
}
EVERY = 10  # frames whose depth decides what was seen
SAMPLES = 1_000_000  # on each mesh
REFERENCE_VOXEL = 0.02
FAR = 5.0  # metres
SLICE = 0.1  # metres above and below the camera: what of the mesh is drawn as walls in a plan


def source(name: str) -> str:
    return str(DATA / "small_house" / "living") if name == "living" else f"synth:{name}"


def surface_row(done: Run, mesh: trimesh.Trimesh, name: str) -> dict[str, Any]:
    """Of a mesh in the frame of the true poses."""
    measured, places = done.sequence, range(0, len(done.sequence), EVERY)
    if name == "living":
        exact, reference = measured, trimesh.load(DATA / "small_house" / "mesh_gt.ply")
    else:
        exact = open_sequence(source(name.split("+")[0]), input=Config().input)
        reference = reference_mesh(exact.scene, REFERENCE_VOXEL)
    depths = (np.where(within(measured[i].depth), exact[i].depth, 0) for i in places)
    views = Views(measured.T_world_cam[list(places)], measured.intrinsics, depths)
    error = compare_meshes(mesh, reference, views, count=SAMPLES)
    assert error.observed_part is not None
    return {
        "accuracy_sampled_cm": 100 * error.observed_part.accuracy_m,
        "completeness_cm": 100 * error.all_of_it.completeness_m,
        "completion_5cm": error.all_of_it.completion_ratio,
    }


def within(depth: np.ndarray) -> np.ndarray:
    return (depth > 0) & (depth <= FAR)


def analytic_row(done: Run, mesh: trimesh.Trimesh, submap: np.ndarray) -> dict[str, Any]:
    """Distances of the vertices to the surface of the scene, which is known exactly, and steps between submaps."""
    vertices = np.asarray(mesh.vertices)
    off = errors(done.sequence.scene, vertices)
    return {"accuracy_cm": 100 * float(np.abs(off.signed).mean())} | seams(vertices, submap, off)


def plan(done: Run, T: Pose, mesh: trimesh.Trimesh, path: str) -> None:
    """The camera's way, the true one and the walls from above, metres; submaps by colour, anchors as dots."""
    poses, truth = trajectory(done.state)[:, :3, 3], done.sequence.T_world_cam
    at = transform(T, poses)
    place = np.array([record.submap for record in done.state.records])
    figure, axes = plt.subplots(figsize=(7, 7))
    walls = mesh.vertices[np.abs(mesh.vertices[:, 1] - truth[:, 1, 3].mean()) < SLICE]
    axes.plot(walls[:, 0], walls[:, 2], ",", color="gray")
    axes.plot(truth[:, 0, 3], truth[:, 2, 3], color="black", linewidth=0.8, label="true")
    axes.scatter(at[:, 0], at[:, 2], c=place, cmap="tab20", s=4)
    for submap in done.state.submaps:
        anchor = T @ submap.T_world_sub[:, 3]
        axes.plot(anchor[0], anchor[2], "o", color="red", markersize=4)
    axes.set(xlabel="x, m", ylabel="z, m", aspect="equal", title=path)
    axes.legend()
    figure.savefig(OUT / f"{path}.png", dpi=110)
    plt.close(figure)


class Memory:
    """Each time the number of submaps has grown: all arrays of the state, and resident memory without what other
    processes could share, after the allocator gave back what it had kept (glibc keeps tens of megabytes more or less).

    Resident memory also grows by what is loaded once, when it is needed: programs and, with the first loop, GTSAM.
    """

    def __init__(self, about: dict[str, Any]) -> None:
        self.rows: list[dict[str, Any]] = []
        self._about = about
        self._trim = ctypes.CDLL("libc.so.6").malloc_trim

    def __call__(self, state: SlamState) -> None:
        if self.rows and self.rows[-1]["submaps"] == len(state.submaps):
            return
        gc.collect()
        self._trim(0)
        with open("/proc/self/statm") as file:
            _, resident, shared, *_ = (int(pages) * resource.getpagesize() for pages in file.read().split())
        kept = {k.id: k for submap in state.submaps for k in submap.keyframes}.values()
        pixels = sum(k.depth.nbytes + k.color.nbytes for k in kept)
        arrays = {id(a): a.nbytes for a in jax.tree.leaves(state) if isinstance(a, np.ndarray | jax.Array)}
        sizes = {
            "resident": resident - shared,
            "arrays": sum(arrays.values()),
            "pixels": pixels,
            "features": sum(map(keyframe_bytes, kept)) - pixels,
            "thumbnails": sum(r.depth.nbytes for r in state.records if r.depth is not None),
        }
        counts = {"frame": len(state.records), "submaps": len(state.submaps), "keyframes": len(kept)}
        self.rows.append(self._about | counts | {f"{k}_mb": v / 1e6 for k, v in sizes.items()})

    def growth_mb(self) -> float:
        """Slope of the arrays over the number of submaps, from two on, without the pixels of keyframes."""
        several = [row for row in self.rows if row["submaps"] > 1]
        if len(several) < 2:
            return float("nan")
        rest = [row["arrays_mb"] - row["pixels_mb"] for row in several]
        return float(np.polyfit([row["submaps"] for row in several], rest, 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--names", nargs="*", default=list(NAMES))
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--switches", nargs="*", default=["full"], choices=list(SWITCHES))
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--no-surface", action="store_true", help="leaves accuracy and seams out")
    parser.add_argument("--out", default="large", help="name of the CSV files")
    options = parser.parse_args()
    enable_cache()
    OUT.mkdir(exist_ok=True)
    rows, memory = [], []
    for name, seed, switch in (
        (n, s, w) for n in options.names for s in options.seeds for w in options.switches
    ):
        section, fields = SWITCHES[switch]
        cfg, title = changed(Config(), section, **fields), f"{name}-{seed}-{switch}"
        watch = Memory({"sequence": name, "seed": seed, "switch": switch})
        done = run(source(name), cfg, frames=slice(0, None, options.stride), seed=seed, watch=watch)
        memory += watch.rows
        T = align_rigid(trajectory(done.state)[:, :3, 3], done.sequence.T_world_cam[:, :3, 3])
        mesh = reconstruct(done.state, cfg)
        leading = Blend(done.state, cfg).leading(mesh.vertices)  # in the frame of the map
        mesh.apply_transform(T)
        row = {"switch": switch} | done.row | {"growth_mb_per_submap": watch.growth_mb()}
        if not options.no_surface:
            row |= surface_row(done, mesh, name)
            row |= {} if name == "living" else analytic_row(done, mesh, leading)
        rows.append(row)
        show(row)
        for closed in done.state.loops:
            print("   ", closed, flush=True)
        write_rows(options.out, rows)
        write_rows(f"{options.out}-memory", memory)
        plan(done, T, mesh, f"plan-{title}")
        mesh.export(OUT / f"mesh-{title}.ply")
        save_picture(OUT / f"mesh-{title}.png", mesh)


if __name__ == "__main__":
    main()
