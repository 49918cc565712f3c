"""Second-order refinement of a pose: our scan with the closed 6 x 6 system, and optimistix, on the same rows.

    python experiments/solvers.py [--starts 100]

Exact depth of `synth:room`, a map fitted to true poses, starts up to 5 cm and 5 degrees off, the same points, the
fine field, as many steps as the default takes. Writes `solvers.csv`: share that ends within 1 cm and 0.5 degrees,
median error, and milliseconds of a call after warm-up.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from basin import DONE_M, DONE_RAD, fitted
from common import show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.core import evidence, least_squares, solvers
from mipsjax.core import field as nf
from mipsjax.core.camera import Intrinsics
from mipsjax.core.equations import Points
from mipsjax.core.fit import draw_points
from mipsjax.core.rigid import distance, perturbed
from mipsjax.data.open import open_sequence

OFFSET_M, OFFSET_RAD = 0.05, np.radians(5)


def with_optimistix(
    field: nf.Field, T: jax.Array, points: Points, camera: Intrinsics, cfg: Config
) -> jax.Array:
    sure = evidence.certainties(field, T, points, "whole", cfg)

    def rows(T):
        return [evidence.map_rows(field, T, points, "whole", cfg, sure)]

    return least_squares.solve(rows, T, cfg.track.go.steps, cfg.sensor.noise_floor)


def with_ours(field: nf.Field, T: jax.Array, points: Points, camera: Intrinsics, cfg: Config) -> jax.Array:
    seen = evidence.Evidence(points)
    return solvers.levenberg_marquardt(field, T, seen, "whole", cfg.track.go.steps, camera, cfg)


def measured(
    name: str, solve: Callable[..., jax.Array], cases: list[tuple[Any, ...]], truth: list[np.ndarray]
) -> dict[str, Any]:
    solve = jax.jit(solve)
    solve(*cases[0]).block_until_ready()
    ends, seconds = [], []
    for case in cases:
        began = perf_counter()
        ends.append(np.asarray(solve(*case).block_until_ready(), np.float64))
        seconds.append(perf_counter() - began)
    errors = np.array([distance(T, end) for T, end in zip(truth, ends, strict=True)])
    done = (errors[:, 0] < DONE_M) & (errors[:, 1] < DONE_RAD)
    return {
        "solver": name,
        "starts": len(cases),
        "share": float(done.mean()),
        "median_cm": 100 * float(np.nanmedian(errors[:, 0])),
        "median_deg": float(np.degrees(np.nanmedian(errors[:, 1]))),
        "ms": 1e3 * float(np.median(seconds)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=100)
    options = parser.parse_args()
    enable_cache()
    cfg, sequence = Config(), open_sequence("synth:room")
    submap, poses = fitted(sequence, cfg)
    rng = np.random.default_rng(cfg.seed)
    cases, truth = [], []
    for number in range(options.starts):
        place = int(rng.integers(len(sequence)))
        frame = sequence[place]
        points = draw_points(
            jax.random.key(number), frame.depth, frame.color, cfg.track.go.pixels, sequence.intrinsics
        )
        v, w = (d / np.linalg.norm(d) * rng.random() for d in rng.standard_normal((2, 3)))
        twist = jnp.asarray(np.r_[v * OFFSET_M, w * OFFSET_RAD], jnp.float32)
        start = perturbed(jnp.asarray(poses[place], jnp.float32), twist)
        cases.append((submap.field, start, points))
        truth.append(poses[place])
    rows = [
        measured(name, partial(solve, camera=sequence.intrinsics, cfg=cfg), cases, truth)
        for name, solve in (("closed 6 x 6, scan", with_ours), ("optimistix", with_optimistix))
    ]
    for row in rows:
        show(row)
    print(write_rows("solvers", rows))


if __name__ == "__main__":
    main()
