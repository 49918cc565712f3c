"""Throughput of the compiled stages at the sizes they run at; no wall time is asserted.

`pytest benchmarks` prints a table at the end. A point is one position at which the distance is asked for: a
pixel under one particle's pose, a pixel in one step of the refinement, a sample of a ray.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from flops import matrix_flops
from mipsjax.config.presets import PRESETS
from mipsjax.config.sections import Config
from mipsjax.core import draws, mapping, particles, tracking
from mipsjax.core import field as nf
from mipsjax.core.camera import Intrinsics, grid_shape
from mipsjax.core.encodings import fields
from mipsjax.core.views import Views

CAMERA = Intrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
KEY = jax.random.key(0)
QUERIES = 100_000
FIT_STEPS = 100


def wall(camera: Intrinsics, frames: int) -> draws.Frames:
    """A slanted wall 2 m off, `frames` times."""
    depth = np.broadcast_to(
        np.linspace(1.5, 2.5, camera.width, dtype=np.float32), (camera.height, camera.width)
    )
    color = np.full((frames, camera.height, camera.width, 3), 128, np.uint8)
    poses = np.broadcast_to(np.eye(4, dtype=np.float32), (frames, 4, 4))
    return draws.Frames(np.tile(depth, (frames, 1, 1)), color, poses, np.arange(frames) > 0)


def pixels_of(wanted: int, camera: Intrinsics) -> int:
    rows, columns = grid_shape(wanted, camera.height, camera.width)
    return rows * columns


def small(cfg: Config) -> Intrinsics:
    """Size at which a config maps."""
    return CAMERA.decimated(max(1, round(CAMERA.width / cfg.map.width_px)))


def fitted(cfg: Config) -> mapping.Learned:
    """A submap that knows the wall, so that tracking takes its ordinary way."""
    camera = small(cfg)
    submap = mapping.create(KEY, cfg)
    frames = wall(camera, cfg.map.frames)
    return mapping.refine(submap, frames, jnp.int32(FIT_STEPS), KEY, camera, cfg)[0]


def products(net: nf.Net) -> int:
    """Multiplications and additions of one point's way through a network."""
    return sum(2 * w.size for w in net.weights)


def test_fitness(throughput):
    """2048 particles x 384 pixels in the paper's field: one iteration of RO."""
    cfg = PRESETS["paper"]
    count, pixels = 2048, 384
    field = nf.init(KEY, cfg.field)
    poses = particles.delta_pose(particles.template(count) * np.float32(0.1))
    points = np.random.default_rng(0).uniform(-2, 2, (pixels, 3)).astype(np.float32)
    mask = np.ones(pixels, bool)
    fitness = jax.jit(lambda f, T, p, m: particles.fitness(f, T, p, m, cfg.field, cfg.track.ro))
    flops = matrix_flops(fitness, field, poses, points, mask)
    # The count, against the sizes of the layers; the rest is the rotation of the points
    assert 1 <= flops / (count * pixels * products(field.smooth)) < 1.01
    throughput(count * pixels, flops, fitness, field, poses, points, mask)


@pytest.mark.parametrize("name", ["default", "paper"])
def test_track(throughput, name):
    """One frame from a start about 1 cm off: refinement alone (default), search and refinement (paper)."""
    cfg = PRESETS[name]
    field = fitted(cfg).field
    frame = wall(CAMERA, 1)
    start = np.eye(4, dtype=np.float32)
    start[:3, 3] = 0.005
    keyframes = wall(small(cfg), cfg.track.go.views)
    views = Views(keyframes.depth, keyframes.T_sub_cam)
    ro, go = cfg.track.ro, cfg.track.go
    args = (field, frame.depth[0], frame.color[0], np.stack([start, start]), np.float32(1), KEY)
    more = (views, np.float32(ro.residual))

    def run(*args):
        return tracking.track(*args, CAMERA, cfg, *more)

    searched = bool(run(*args)[1].searched)
    points = go.steps * pixels_of(go.pixels, CAMERA)
    if go.method == "lm" and fields(cfg.field).two:
        points += go.smooth_steps * pixels_of(go.smooth_pixels, CAMERA)
    points += searched * ro.steps * ro.particles * pixels_of(ro.pixels, CAMERA)
    throughput(points, matrix_flops(run, *args, searched=searched), run, *args)


@pytest.mark.parametrize("name", ["default", "paper"])
def test_mapping_step(throughput, name):
    """One step of local bundle adjustment; the paper's is 5 frames x 384 pixels x 50 samples."""
    cfg = PRESETS[name]
    camera = small(cfg)
    submap, frames = mapping.create(KEY, cfg), wall(camera, cfg.map.frames)
    samples = cfg.sample.uniform + cfg.sample.truncation + cfg.sample.surface
    points = cfg.map.frames * pixels_of(cfg.map.pixels, camera) * samples

    def run(submap, frames, steps):
        return mapping.refine(submap, frames, steps, KEY, camera, cfg)

    args = submap, frames, jnp.int32(1)
    throughput(points, matrix_flops(run, *args), run, *args)


@pytest.mark.parametrize("name", ["default", "paper"])
def test_query(throughput, name):
    """The distance at 100,000 points at once, as meshing asks for it."""
    cfg = PRESETS[name].field
    field = nf.init(KEY, cfg)
    points = np.random.default_rng(0).uniform(-2, 2, (QUERIES, 3)).astype(np.float32)
    query = jax.jit(lambda f, p: nf.tsdf(f, p, cfg).psi)
    throughput(QUERIES, matrix_flops(query, field, points), query, field, points)
