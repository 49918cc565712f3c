"""What background refinement does to a submap that the camera has left: its residual on pixels it never learned from.

    python experiments/refinement.py [--name apartment+noise] [--frames 420] [--seeds 0 1 2]

For every submap that was left: mean |distance| (cm) at the measured points of its keyframes, at pixels that decimation
to mapping size leaves out, with what it knew when it was left and with what it knows at the end; poses are those at the
end. Depth up to 3 m, where the sensor is good. Writes `refinement.csv`.
"""

from __future__ import annotations

import argparse

import jax.numpy as jnp
import numpy as np

from common import run, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core.camera import unproject
from mipsjax.core.mapping import Learned
from mipsjax.core.rigid import transform
from mipsjax.data.sequence import Sequence
from mipsjax.submaps.bundle import mapping_stride
from mipsjax.submaps.state import SlamState, Submap

FAR = 3.0  # metres
POINTS = 20_000


class Left:
    """What each submap knew when the camera left it."""

    def __init__(self) -> None:
        self.learned: dict[int, tuple[int, Learned]] = {}
        self._active = 0

    def __call__(self, state: SlamState) -> None:
        if state.active != self._active:
            self.learned.setdefault(self._active, (len(state.records), state.submaps[self._active].learned))
            self._active = state.active


def held_out(submap: Submap, sequence: Sequence, cfg: Config, seed: int) -> np.ndarray:
    """Points in the submap's frame, metres."""
    camera, every, parts = sequence.intrinsics, mapping_stride(sequence.intrinsics, cfg), []
    for keyframe in submap.keyframes:
        depth = sequence[keyframe.id].depth
        assert depth is not None
        v, u = (
            x.ravel() for x in np.mgrid[every // 2 : camera.height : every, every // 2 : camera.width : every]
        )
        z = depth[v, u].astype(np.float64)
        p_cam = unproject(v, u, z, camera)
        parts.append(transform(keyframe.T_sub_cam, p_cam[(z > 0) & (z < FAR)]))
    return np.random.default_rng(seed).permutation(np.concatenate(parts))[:POINTS]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--name", default="apartment+noise")
    parser.add_argument("--frames", type=int, default=420)
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    options = parser.parse_args()
    enable_cache()
    rows = []
    for seed in options.seeds:
        left, online = Left(), []
        cfg = Config(seed=seed)

        def watch(state: SlamState, left: Left = left, online: list = online) -> None:
            left(state)
            online[:] = [state]  # before the adjustment after the last frame

        done = run(f"synth:{options.name}", cfg, frames=slice(0, options.frames), seed=seed, watch=watch)
        for place, (frame, learned) in left.learned.items():
            submap = online[0].submaps[place]
            points = jnp.asarray(held_out(submap, done.sequence, cfg, seed), jnp.float32)
            before, after = (
                100 * float(jnp.abs(nf.tsdf(known.field, points, cfg.field).psi).mean())
                for known in (learned, submap.learned)
            )
            row = {"seed": seed, "submap": place, "left_at": frame, "before_cm": before, "after_cm": after}
            rows.append(row)
            show(row)
            write_rows("refinement", rows)


if __name__ == "__main__":
    main()
