"""Loop closure on rings of submaps with a known loop error: how much of it goes away.

    python experiments/posegraph.py [--seeds 5]

Rings of 4, 6 and 10 submaps, 4 m apart. Over all edges of their measured chain go 0.2 m and 5 degrees, 0.5 m and
10 degrees, or 1 m and 20 degrees wrong, either by the same twist in every edge (`bias`), in the same direction of the
world (`steady`), or in the middle edge alone (`jump`); lever arms come on top. One true edge closes the ring: a
relative pose, points on three walls, or both. Then three gross false edges of the same kind are added.

Writes `posegraph.csv`, a row a case, means over seeds: the share of the error removed at the loop end, and in the
mean over all submaps but the first, in translation and rotation. One loop says what went wrong in all and not where,
so the mean over all submaps depends on the kind of drift. `posegraph_sigmas.csv` has the same for sequential edges
that claim other sigmas than their drift deserves.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import product
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from common import show, write_rows
from mipsjax.core.rigid import angles, from_parts, transform
from mipsjax.loops.factors import Factor, PointToPlane, Pose, RelativePose
from mipsjax.loops.posegraph import solve

SPACING = 4.0  # metres between neighbours
DRIFTS = ((0.2, 5.0), (0.5, 10.0), (1.0, 20.0))  # metres and degrees
TRACKING = 0.005, np.radians(0.1)  # noise of a sequential edge beside its drift
LOOP = 0.005, np.radians(0.1)  # noise and sigmas of a relative pose that closes a loop
WALL_POINTS, WALL_NOISE, WALL_SIGMA = 100, 0.005, 0.01  # points a wall, metres, metres
FALSE_LOOPS = 3
CLAIMS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # claimed sigma of a sequential edge, over what its drift deserves
FALSE_M, FALSE_DEG = (2.0, 4.0), (30.0, 120.0)


class World(NamedTuple):
    """What a case is made of; a field of a real sequence fits in as well as a ring."""

    truth: np.ndarray
    """T_world_sub, S x 4 x 4."""
    start: np.ndarray
    """The same with drift."""
    chain: list[Factor]


def pose(rotation: Rotation, translation: np.ndarray) -> Pose:
    return from_parts(rotation.as_matrix(), translation)


def noise(rng: np.random.Generator, metres: float, radians: float) -> Pose:
    return pose(Rotation.from_rotvec(rng.normal(size=3) * radians), rng.normal(size=3) * metres)


def gross(rng: np.random.Generator, metres: float, radians: float) -> Pose:
    """A motion of exactly this length and angle in a random direction."""
    v, w = rng.normal(size=(2, 3))
    return pose(Rotation.from_rotvec(radians * w / np.linalg.norm(w)), metres * v / np.linalg.norm(v))


def relative(T: np.ndarray, first: int, second: int) -> Pose:
    return np.linalg.inv(T[first]) @ T[second]


def ring(submaps: int) -> np.ndarray:
    """True poses on a circle, looking outward."""
    radius = SPACING / (2 * np.sin(np.pi / submaps))
    turns = 2 * np.pi * np.arange(submaps) / submaps
    return np.stack(
        [pose(Rotation.from_rotvec([0, 0, a]), radius * np.array([np.cos(a), np.sin(a), 0])) for a in turns]
    )


def drifted(truth: np.ndarray, kind: str, total: Pose) -> np.ndarray:
    """A chain from the first true pose, with `total` wrong in it."""
    edges = len(truth) - 1
    turn, shift = Rotation.from_matrix(total[:3, :3]).as_rotvec(), total[:3, 3]
    out = [truth[0]]
    for number in range(1, len(truth)):
        turned = np.linalg.inv(truth[number, :3, :3]) if kind == "steady" else np.eye(3)
        share = float(number == len(truth) // 2) if kind == "jump" else 1 / edges
        wrong = pose(Rotation.from_rotvec(turned @ turn * share), turned @ shift * share)
        out.append(out[-1] @ relative(truth, number - 1, number) @ wrong)
    return np.stack(out)


def world(
    rng: np.random.Generator, submaps: int, kind: str, drift: tuple[float, float], claim: float
) -> World:
    """A ring whose sequential edges claim `claim` times the sigma with which this drift is one sigma an axis."""
    truth = ring(submaps)
    wrong = drifted(truth, kind, gross(rng, drift[0], np.radians(drift[1])))
    deserved = claim / np.sqrt(3 * (submaps - 1))
    chain, start = [], [truth[0]]
    for number in range(1, submaps):
        measured = relative(wrong, number - 1, number) @ noise(rng, *TRACKING)
        sigmas = deserved * float(np.radians(drift[1])), deserved * drift[0]
        chain.append(RelativePose(number - 1, number, measured, *sigmas, trusted=True))
        start.append(start[-1] @ measured)
    return World(truth, np.stack(start), chain)


def pose_edge(rng: np.random.Generator, first: int, second: int, T_first_second: Pose) -> list[Factor]:
    return [RelativePose(first, second, T_first_second @ noise(rng, *LOOP), LOOP[1], LOOP[0])]


def wall_edge(rng: np.random.Generator, first: int, second: int, T_first_second: Pose) -> list[Factor]:
    """Two walls and a floor around the middle of both submaps, seen with noise along the normal."""
    T_second_first = np.linalg.inv(T_first_second)
    normals = np.repeat(np.eye(3), WALL_POINTS, axis=0)
    along = rng.uniform(-2, 2, normals.shape)
    p = T_first_second[:3, 3] / 2 + along * (1 - normals) + 1.5 * normals
    seen = p + rng.normal(size=(len(p), 1)) * WALL_NOISE * normals
    q = transform(T_second_first, seen)
    return [PointToPlane(first, second, p, normals, q, WALL_SIGMA)]


Edge = Callable[[np.random.Generator, int, int, Pose], list[Factor]]
EDGES: dict[str, Edge] = {
    "pose": pose_edge,
    "walls": wall_edge,
    "both": lambda rng, j, k, T: pose_edge(rng, j, k, T) + wall_edge(rng, j, k, T),
}


def false_edges(rng: np.random.Generator, truth: np.ndarray, edge: Edge) -> list[Factor]:
    """Gross errors between submaps that are no neighbours."""
    pairs = [(j, k) for j, k in product(range(len(truth)), repeat=2) if k - j >= 2]
    found = []
    for j, k in (pairs[number] for number in rng.choice(len(pairs), FALSE_LOOPS, replace=False)):
        wrong = gross(rng, rng.uniform(*FALSE_M), np.radians(rng.uniform(*FALSE_DEG)))
        found += edge(rng, j, k, relative(truth, j, k) @ wrong)
    return found


def errors(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Metres and degrees, S x 2."""
    turned = np.swapaxes(truth[:, :3, :3], 1, 2) @ T[:, :3, :3]
    return np.stack([np.linalg.norm((T - truth)[:, :3, 3], axis=1), np.degrees(angles(turned))], axis=1)


def figures(case: World, true_loops: list[Factor], false_loops: list[Factor]) -> dict[str, float]:
    """Errors before and after, and which loops were kept."""
    began = perf_counter()
    found = solve(case.start, [*case.chain, *true_loops, *false_loops])
    ms = 1e3 * (perf_counter() - began)
    before, after = errors(case.start, case.truth), errors(found.T_world_sub, case.truth)
    loops = found.weights[len(case.chain) :]
    row: dict[str, float] = {}
    for place, b, a in (("end", before[-1], after[-1]), ("mean", before[1:].mean(0), after[1:].mean(0))):
        row |= {f"{place}_before_cm": 100 * b[0], f"{place}_after_cm": 100 * a[0]}
        row |= {f"{place}_before_deg": b[1], f"{place}_after_deg": a[1]}
    row |= {"true_kept": loops[: len(true_loops)].mean(), "ok": float(found.ok), "ms": ms}
    return row | ({"false_kept": loops[len(true_loops) :].mean()} if false_loops else {})


def shares(row: dict[str, Any]) -> dict[str, float]:
    """Of the mean errors: the mean of shares would be that of the seed in which drift happens to cancel."""
    return {
        f"{place}_removed_{unit}": 1 - row[f"{place}_after_{of}"] / row[f"{place}_before_{of}"]
        for place in ("end", "mean")
        for unit, of in (("m", "cm"), ("deg", "deg"))
    }


def measured(
    submaps: int, kind: str, drift: tuple[float, float], name: str, false: bool, claim: float, seeds: int
) -> dict[str, Any]:
    """One row: means over seeds."""
    rows, last = [], submaps - 1
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        case = world(rng, submaps, kind, drift, claim)
        true_loops = EDGES[name](rng, 0, last, relative(case.truth, 0, last))
        false_loops = false_edges(rng, case.truth, EDGES[name]) if false else []
        rows.append(figures(case, true_loops, false_loops))
    row = {"submaps": submaps, "drift": kind, "drift_m": drift[0], "drift_deg": drift[1], "loop": name}
    row |= {"false_loops": FALSE_LOOPS * false, "claim": claim}
    row |= {key: float(np.mean([r[key] for r in rows])) for key in rows[0]}
    return row | shares(row)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=5)
    seeds = parser.parse_args().seeds
    rows = []
    for case in product((4, 6, 10), ("bias", "steady", "jump"), DRIFTS, EDGES, (False, True)):
        rows.append(measured(*case, 1.0, seeds))
        show(rows[-1])
    print(write_rows("posegraph", rows))
    cases = product((4, 10), ("bias",), DRIFTS[1:2], ("pose",), (False, True), CLAIMS)
    print(write_rows("posegraph_sigmas", [measured(*case, seeds) for case in cases]))


if __name__ == "__main__":
    main()
