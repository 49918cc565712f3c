"""Basin of convergence: starts up to 0.3 m and 30 degrees off, on the analytic room with exact depth.

A field is fitted to frames of `synth:room` at their true poses. Then single frames are tracked from disturbed
starts, with RO then GO, and with GO alone. A start counts where it ends within 1 cm and 0.5 degrees.

    python experiments/basin.py [--starts 200]
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np

from common import changed, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.sections import Config
from mipsjax.core import mapping, tracking
from mipsjax.core.rigid import distance, exp
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Sequence
from mipsjax.submaps.bundle import adjust, make_keyframe
from mipsjax.submaps.chance import Purpose, key_for

OFFSET_M, OFFSET_RAD = 0.3, np.radians(30)
DONE_M, DONE_RAD = 0.01, np.radians(0.5)
KEYFRAMES, STEPS = 24, 1500
WIDENING = 2.0  # of the first swarm, so that it reaches the farthest start


def fitted(sequence: Sequence, cfg: Config) -> tuple[mapping.Learned, list[np.ndarray]]:
    """A submap fitted to evenly spaced frames, and the true pose of each frame in it."""
    truth = np.linalg.inv(sequence.T_world_cam[0]) @ sequence.T_world_cam
    picked = np.linspace(0, len(sequence) - 1, KEYFRAMES).astype(int)
    keyframes = [make_keyframe(sequence[i], i, truth[i], cfg, sequence.intrinsics) for i in picked]
    submap = mapping.create(jax.random.key(cfg.seed), cfg)
    rng = np.random.default_rng(cfg.seed)
    for number in range(STEPS // cfg.map.steps):
        batch = [keyframes[i] for i in rng.choice(KEYFRAMES, cfg.map.frames, replace=False)]
        rates, key = [0.0] * cfg.map.frames, key_for(cfg, Purpose.MAP, number)
        submap, _, _ = adjust(submap, batch, rates, cfg.map.steps, key, sequence.intrinsics, cfg)
    return submap, list(truth)


def starts(count: int, frames: int, seed: int) -> list[tuple[int, np.ndarray]]:
    """Frame and twist of each start: uniform length up to the limits, uniform direction."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        v, w = (d / np.linalg.norm(d) for d in rng.standard_normal((2, 3)))
        out.append(
            (int(rng.integers(frames)), np.r_[v * rng.random() * OFFSET_M, w * rng.random() * OFFSET_RAD])
        )
    return out


def share(
    submap: mapping.Learned, truth: list[np.ndarray], sequence: Sequence, cfg: Config, count: int
) -> float:
    done = 0
    for number, (frame, twist) in enumerate(starts(count, len(sequence), cfg.seed)):
        start = truth[frame] @ np.asarray(exp(jnp.asarray(twist, jnp.float32)), np.float64)
        image = sequence[frame]
        T, _ = tracking.track(
            submap.field,
            image.depth,
            image.color,
            np.stack([start, start]).astype(np.float32),
            np.float32(WIDENING),
            jax.random.key(number),
            sequence.intrinsics,
            cfg,
        )
        metres, radians = distance(truth[frame], np.asarray(T, np.float64))
        done += metres < DONE_M and radians < DONE_RAD
    return done / count


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--starts", type=int, default=200)
    parser.add_argument("--encodings", nargs="*", default=["both"])
    options = parser.parse_args()
    enable_cache()
    sequence = open_sequence("synth:room")
    rows = []
    for encoding in options.encodings:
        cfg = changed(Config(), "field", encoding=encoding)
        submap, truth = fitted(sequence, cfg)
        for name, when in (("RO then GO", "always"), ("RO where needed", "needed"), ("GO alone", "never")):
            method = changed(cfg, "track.ro", when=when)
            reached = share(submap, truth, sequence, method, options.starts)
            rows.append({"encoding": encoding, "method": name, "starts": options.starts, "share": reached})
            show(rows[-1])
    print(write_rows("basin", rows))


if __name__ == "__main__":
    main()
