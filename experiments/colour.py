"""Corners and brightness of the image against each other, alone and together: two frames by what both measured.

    python experiments/colour.py [--only NAME] [--pairs 40]
    python experiments/colour.py --table

Of each sequence so many pairs of frames, spread evenly, one and eight frames apart; the first pose and the guess, which
goes on as before, are true ones. Forms: surfaces (depth images alone), corners and brightness (each alone: trusted a
hundred million times as much as usual), and these with surfaces. Errors are those of the later frame's pose in the
earlier one's camera, median and ninth tenth. Writes `colour.csv`, of one sequence (`--only`) its rows anew; `--table`
prints it for docs/trials.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from common import DATA, Altered, changed, read_rows, show, write_rows
from mipsjax.app.compilation import enable_cache
from mipsjax.config.presets import preset
from mipsjax.config.sections import Config
from mipsjax.core import relative
from mipsjax.core.rigid import distance, inverse
from mipsjax.data.open import open_sequence
from mipsjax.data.sequence import Frame, Sequence
from mipsjax.images.following import follow
from mipsjax.slam.landmarks import Seen, corners_of, images_of, landmarks
from mipsjax.submaps.state import Pose

DARKER = ", darker"
SEQUENCES = (
    "bookstore",
    f"bookstore{DARKER}",
    "corridor_walk",
    "small_house/living",
    "synth:home-101-fast+noise+blur",
    "synth:home-106+noise",
)
APART = (1, 8)
"""Frames between the two of a pair."""
ALONE = 1e8
"""Trust in colour with which surfaces say nothing beside it."""


class Form(NamedTuple):
    corners: bool
    brightness: bool
    trust: float = 1.0


FORMS = {
    "surfaces": Form(False, False),
    "corners": Form(True, False, ALONE),
    "brightness": Form(False, True, ALONE),
    "surfaces, corners": Form(True, False),
    "surfaces, brightness": Form(False, True),
    "all": Form(True, True),
}


def darker(sequence: Sequence, place: int) -> Frame:
    """Every second frame at seven tenths of its brightness and a little more: another exposure."""
    frame = sequence[place]
    if place % 2 or frame.color is None:
        return frame
    return frame._replace(color=(0.7 * frame.color + 10).astype(np.uint8))


def rows(name: str, count: int, cfg: Config) -> Iterator[dict[str, Any]]:
    path = name.removesuffix(DARKER)
    sequence = open_sequence(path if ":" in path else str(DATA / path), input=cfg.input)
    if name.endswith(DARKER):
        sequence = Altered(sequence, darker)
    for apart in APART:
        places = np.linspace(apart + 2, len(sequence) - 1, count).astype(int)
        for form, switched in FORMS.items():
            off = [error(sequence, place, apart, switched, cfg) for place in places.tolist()]
            metres, radians = np.array(off).T
            yield {
                "sequence": name.removeprefix("synth:"),
                "apart": apart,
                "form": form,
                "error_mm": 1000 * float(np.median(metres)),
                "error_9_mm": 1000 * float(np.quantile(metres, 0.9)),
                "error_deg": float(np.degrees(np.median(radians))),
                "error_9_deg": float(np.degrees(np.quantile(radians, 0.9))),
            }


def error(sequence: Sequence, place: int, apart: int, form: Form, cfg: Config) -> tuple[float, float]:
    """Metres and radians by which a frame's pose in an earlier one is wrong."""
    true = sequence.T_world_cam
    assert true is not None
    before, now = sequence[place - apart].cleaned(), sequence[place].cleaned()
    home = inverse(true[place - apart])
    guess = home @ true[place - 1] @ inverse(true[place - 2]) @ true[place - 1]
    T = measured(before, now, guess, sequence, form, cfg)
    return distance(home @ true[place], T)


def measured(before: Frame, now: Frame, guess: Pose, sequence: Sequence, form: Form, cfg: Config) -> Pose:
    """Pose of one frame in the one before, by one form."""
    camera = sequence.intrinsics
    first, second = corners_of(before, 0, camera, cfg), corners_of(now, 1, camera, cfg)
    assert first is not None and second is not None and before.depth is not None and now.depth is not None
    followed = follow(first, second.grey, guess, cfg.track.corners.fewest, camera) if form.corners else None
    seen = [] if followed is None else [Seen(first, np.eye(4), followed)]
    shown = None
    if form.brightness:
        shown = relative.Shown(images_of([(first, np.eye(4))], 1, camera, cfg), jnp.asarray(second.grey))  # pyright: ignore[reportArgumentType]
    every = max(1, round(camera.width / 160))
    pair = relative.Pairs(
        jnp.asarray(before.depth[::every, ::every]),
        jnp.asarray(now.depth[::every, ::every]),
        jnp.asarray(guess if followed is None else followed.T_ref_cam, jnp.float32),
        jnp.asarray(guess, jnp.float32),
        landmarks(seen, 1, camera, cfg) if form.corners else None,
        shown,
    )
    stacked = jax.tree.map(lambda part: part[None], pair)
    found = relative.measure(stacked, np.float32(form.trust), camera, cfg)
    return np.asarray(found.T_first_second[0], np.float64)


def print_forms(found: list[dict[str, str]]) -> None:
    """A row for each sequence and distance, a column for each form: median and ninth tenth of the errors, mm."""
    print("| sequence | frames apart | " + " | ".join(FORMS) + " |\n" + "|---" * (2 + len(FORMS)) + "|")
    for name, apart in dict.fromkeys((row["sequence"], row["apart"]) for row in found):
        of = {row["form"]: row for row in found if (row["sequence"], row["apart"]) == (name, apart)}
        cells = (f"{float(of[form]['error_mm']):.2g}, {float(of[form]['error_9_mm']):.2g}" for form in FORMS)
        print(f"| {name} | {apart} | " + " | ".join(cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--only", choices=SEQUENCES)
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    if options.table:
        print_forms(read_rows("colour"))
        return
    enable_cache()
    # The steps alone are to be compared: they go on to the end
    cfg = changed(preset("default"), "track.go", steps=20)
    kept = read_rows("colour") if options.only else []
    found = {(row["sequence"], str(row["apart"]), row["form"]): row for row in kept}
    for name in [options.only] if options.only else SEQUENCES:
        for row in rows(name, options.pairs, cfg):
            found[row["sequence"], str(row["apart"]), row["form"]] = row
            show(row)
            write_rows("colour", found.values())


if __name__ == "__main__":
    main()
