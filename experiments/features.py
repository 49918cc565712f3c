"""Loops without a prior: how often two frames are joined rightly and wrongly, and whether the right one is found.

Pairs are sorted by true overlap (share of measured pixels that the other frame saw, the lesser of both ways); those
without any, and frames of two different places, must not be joined. "right" is within 5 cm and 3 degrees; the true
poses of the kitchen are only good to 3 cm and 0.8 degrees at revisits.

Retrieval asks `similar` for the frames most like one, its neighbours in time left out; it succeeds where one of those
named overlaps by at least 0.35.

    python experiments/features.py [--pairs 60]
"""

from __future__ import annotations

import argparse
import time
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from common import DATA, show, write_rows
from mipsjax.core.camera import Intrinsics, unproject
from mipsjax.core.rigid import distance, transform_in_order
from mipsjax.data.open import open_sequence
from mipsjax.images.features import Features, detect, similar
from mipsjax.loops.registration import Match, relative_pose

SEQUENCES = (("redkitchen", 10), ("small_house/living", 4))  # and every how many frames
BINS = ((0.0, 0.005), (0.05, 0.15), (0.15, 0.3), (0.3, 0.5), (0.5, 0.7), (0.7, 0.95))
RIGHT_M, RIGHT_DEG = 0.05, 3.0
NEAR_M, NEAR_DEG = 0.2, 8.0  # from here on the tracker's search finds the rest
SAME_DEPTH_M = 0.1
OVERLAPS, NEIGHBOURS = 0.35, 6


class Place(NamedTuple):
    name: str
    camera: Intrinsics
    poses: Float64[np.ndarray, "F 4 4"]
    features: list[Features]
    overlap: Float64[np.ndarray, "F F"]


def load(path: str, every: int) -> tuple[Place, float]:
    """A sequence with its features, and the milliseconds of `detect` a frame."""
    sequence = open_sequence(str(DATA / path), frames=slice(None, None, every))
    frames = [sequence[i] for i in range(len(sequence))]
    began = time.perf_counter()
    found = [detect(frame.color, frame.depth, sequence.intrinsics) for frame in frames]
    ms = 1000 * (time.perf_counter() - began) / len(frames)
    views = list(zip([frame.depth for frame in frames], sequence.T_world_cam, strict=True))
    overlap = np.array(
        [
            [seen_share(a, b, np.linalg.inv(T_b) @ T_a, sequence.intrinsics) for b, T_b in views]
            for a, T_a in views
        ]
    )
    return Place(path, sequence.intrinsics, sequence.T_world_cam, found, np.minimum(overlap, overlap.T)), ms


def seen_share(a: np.ndarray, b: np.ndarray, T_b_a: np.ndarray, camera: Intrinsics) -> float:
    """Share of some measured pixels of depth a whose points depth b measured as well."""
    v, u = np.mgrid[4 : camera.height : 12, 4 : camera.width : 12].reshape(2, -1)
    z = a[v, u].astype(np.float64)
    p = transform_in_order(T_b_a, unproject(v, u, z, camera)[z > 0])
    p = p[p[:, 2] > 0.1]
    at = np.rint(p[:, :2] / p[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]).astype(int)
    inside = np.all((at >= 0) & (at < [camera.width, camera.height]), axis=1)
    seen = b[at[inside, 1], at[inside, 0]]
    return float(np.sum((seen > 0) & (np.abs(seen - p[inside, 2]) < SAME_DEPTH_M)) / max(1, np.sum(z > 0)))


def judge(name: str, low: float, found: list[tuple[Match, np.ndarray | None]], ms: float) -> dict[str, Any]:
    """One row of the table; `None` for a true motion that does not exist."""
    errors = np.array(
        [
            (np.inf, np.inf) if truth is None else distance(match.T_other_current, truth)
            for match, truth in found
        ]
    ) * [1.0, np.degrees(1.0)]
    accepted = np.array([match.ok for match, _ in found])
    right = accepted & (errors < [RIGHT_M, RIGHT_DEG]).all(axis=1)
    near = accepted & (errors < [NEAR_M, NEAR_DEG]).all(axis=1)
    return {
        "pairs_of": name,
        "overlap_from": low,
        "pairs": len(found),
        "accepted": accepted.mean(),
        "right": right.mean(),
        "within_20cm_8deg": near.mean(),
        "false": (accepted & ~near).mean(),
        "median_cm": 100 * np.median(errors[accepted, 0]) if accepted.any() else float("nan"),
        "median_deg": np.median(errors[accepted, 1]) if accepted.any() else float("nan"),
        "inliers": np.median([match.inliers for match, _ in found]),
        "ms": ms,
    }


def joined(a: Place, b: Place, rows: np.ndarray, low: float) -> dict[str, Any]:
    began, found = time.perf_counter(), []
    for i, j in rows:
        truth = np.linalg.inv(b.poses[j]) @ a.poses[i] if a is b and low > 0 else None
        found.append((relative_pose(a.features[i], b.features[j], a.camera, 0), truth))
    ms = 1000 * (time.perf_counter() - began) / len(rows)
    return judge(a.name if a is b else "different places", low, found, ms)


def retrieval(places: list[Place]) -> list[dict[str, Any]]:
    rows = []
    for place in places:
        others = [f for p in places if p is not place for f in p.features]
        hits = {1: [], 3: [], 5: [], 10: []}
        for i, current in enumerate(place.features):
            far = np.flatnonzero(np.abs(np.arange(len(place.features)) - i) >= NEIGHBOURS)
            good = place.overlap[i, far] >= OVERLAPS
            if good.any():
                named = np.array(similar(current, [place.features[j] for j in far] + others, max(hits)))
                useful = np.r_[good, np.zeros(len(others), bool)][named]
                for top, hit in hits.items():
                    hit.append(useful[:top].any())
        rows.append(
            {"retrieval": place.name, "frames": len(hits[1])}
            | {f"top_{k}": np.mean(v) for k, v in hits.items()}
        )
    everything = [f for p in places for f in p.features]
    for count in (100, 400):
        database = [everything[i % len(everything)] for i in range(count)]
        began = time.perf_counter()
        for current in everything[::10]:
            similar(current, database, 5)
        ms = 1000 * (time.perf_counter() - began) / len(everything[::10])
        rows.append({"retrieval": f"time with {count} keyframes", "ms": ms})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=2)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    rows, places = [], []
    for path, every in SEQUENCES:
        place, ms = load(path, every)
        places.append(place)
        counts = [len(f.descriptors) for f in place.features]
        kilobytes = np.mean([sum(a.nbytes for a in f) for f in place.features]) / 1000
        rows.append(
            {"detect": path, "features": np.median(counts), "least": min(counts), "kB": kilobytes, "ms": ms}
        )
        show(rows[-1])
        for low, high in BINS:
            pairs = np.argwhere((place.overlap >= low) & (place.overlap < high))
            rows.append(
                joined(place, place, rng.permutation(pairs)[: options.pairs * (1 if low else 4)], low)
            )
            show(rows[-1])
    a, b = places
    across = np.stack([rng.integers(len(p.features), size=6 * options.pairs) for p in (a, b)], 1)
    rows.append(joined(a, b, across, 0.0))
    show(rows[-1])
    for row in retrieval(places):
        rows.append(row)
        show(row)
    print(write_rows("features", rows))


if __name__ == "__main__":
    main()
