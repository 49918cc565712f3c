"""What the verdict on a whole run says of a trajectory made elsewhere, by an earlier commit or by another system.

    python experiments/verdict.py SEQUENCE TRAJECTORY [...]

TRAJECTORY is a file of TUM rows or of 16 numbers a row, a pose for each frame of SEQUENCE. Prints for each the greatest
share of what one frame measured that another looks through, and, where that is more than is allowed, where it begins.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from mipsjax.app.evaluate import read_trajectory
from mipsjax.config.sections import SensorConfig
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Sequence
from mipsjax.submaps.state import thumbnail_stride
from mipsjax.uncertainty.agreement import LIMIT, MOST_VIEWS, Agreement, Noise, Views, agreement


def verdict(sequence: Sequence, T_world_cam: np.ndarray) -> Agreement | None:
    """By as many frames as a run is judged by, with places among them made places in the sequence."""
    places = np.arange(len(sequence))[:: max(1, -(-len(sequence) // MOST_VIEWS))]
    every = thumbnail_stride(sequence.intrinsics)
    depth = []
    for place in places:
        image = sequence[place].cleaned().depth
        if image is None:
            raise SystemExit(f"frame {place} has no depth, which every frame needs here")
        depth.append(image[::every, ::every])
    views = Views(np.stack(depth), T_world_cam[places], sequence.intrinsics.decimated(every))
    sensor = SensorConfig()
    found = agreement(views, Noise(sensor.noise_floor, sensor.noise_growth))
    if found is None or found.begins is None:
        return found
    begins = found.begins._replace(first=places[found.begins.first], last=places[found.begins.last])
    return found._replace(begins=begins)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence")
    parser.add_argument("trajectory", type=Path, nargs="+")
    options = parser.parse_args()
    sequence = open_sequence(options.sequence)
    for path in options.trajectory:
        poses = read_trajectory(path).poses
        if len(poses) != len(sequence):
            raise SystemExit(f"{path} has {len(poses)} poses and the sequence {len(sequence)} frames")
        found = verdict(sequence, poses)
        if found is None:
            print(f"{path}: too few frames see the same")
            continue
        words = f"{path}: up to {100 * found.worst.share:.1f} % looked through, {100 * LIMIT:.0f} % allowed"
        if found.begins is not None:
            words += f"; first between frames {found.begins.first} and {found.begins.last}: degraded"
        print(words)


if __name__ == "__main__":
    main()
