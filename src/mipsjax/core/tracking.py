"""Tracking of one frame: randomized (RO), then gradient-based (GO) optimisation, as one compiled schedule.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, UInt8

from mipsjax.config import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, particles
from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, rays, transform
from mipsjax.core.equations import Points, Prior, robust_cost
from mipsjax.core.photometric import LEVELS, Images, grey_of, pyramid, with_noise
from mipsjax.core.solvers import (
    Evidence,
    Information,
    Landmarks,
    adam,
    approach,
    information,
    levenberg_marquardt,
    map_rows,
)
from mipsjax.core.views import Views, observed, own_normals

# Corners that say where the camera is to a pixel or two: no coarse level of images is needed then
ENOUGH = 100
BEHIND = 0.3  # metres behind what a keyframe saw, to which its surface may still be that of a frame not yet registered


class Fit(NamedTuple):
    """How well a frame fits the map at a pose."""

    residual: Float[Array, ""]
    """Root of the mean robust cost, metres."""
    known: Float[Array, ""]
    """Share of measured pixels within `keyframe.error` of the mapped surface."""
    confirmed: Float[Array, ""]
    """The same where the map is also certain: space that was never observed looks like surface, but not certainly."""


class TrackInfo(NamedTuple):
    """What happened to one frame."""

    before: Fit
    """At the candidate it starts from."""
    after: Fit
    information: Information
    """At the pose found."""
    searched: Bool[Array, ""]
    """RO was run."""
    ok: Bool[Array, ""]
    """Everything is finite; if not, the pose is the candidate."""


def draw_points(
    key: PRNGKeyArray,
    depth: Float[Array, "H W"],
    color: UInt8[Array, "H W 3"],
    pixels: int,
    camera: Intrinsics,
) -> Points:
    """Points of a stripe grid of about `pixels` cells, shifted by a random part of a cell."""
    height, width = depth.shape
    v, u = pixel_grid(*grid_shape(pixels, height, width), jax.random.uniform(key, (2,)), height, width)
    d = depth[v, u]
    return Points(rays(v, u, camera) * d[:, None], color[v, u].astype(jnp.float32) / 255, d > 0)


def measure_fit(field: nf.Field, T: Float[Array, "4 4"], points: Points, part: nf.Part, cfg: Config) -> Fit:
    """Residual and shares of known pixels at a pose."""
    prediction = nf.tsdf(field, transform(T, points.p_cam), cfg.field, part)
    cost = losses.masked_mean(robust_cost(prediction.psi, cfg.track.go.robust), points.mask)
    near = jnp.abs(prediction.psi) < cfg.keyframe.error
    certain = nf.is_certain(prediction.entropy, cfg.correspond.max_entropy, cfg.field)
    known, confirmed = (
        losses.masked_mean(m.astype(jnp.float32), points.mask) for m in (near, near & certain)
    )
    return Fit(jnp.sqrt(cost), known, confirmed)


@partial(jax.jit, static_argnames=("camera", "cfg"))
def track(
    field: nf.Field,
    depth: Float[Array, "H W"],
    color: UInt8[Array, "H W 3"],
    candidates: Float[Array, "K 4 4"],
    widening: Float[Array, ""],
    key: PRNGKeyArray,
    camera: Intrinsics,
    cfg: Config,
    views: Views | None = None,
    converged: Float[Array, ""] | None = None,
    landmarks: Landmarks | None = None,
    known: Views | None = None,
    images: Images | None = None,
    trust: Float[Array, ""] | float = 1.0,
) -> tuple[Float[Array, "4 4"], TrackInfo]:
    """Pose of one frame in the submap, from a few candidates of the motion prior.

    `views` are depth images of keyframes, decimated by a whole factor, that the second-order steps on the fine
    field also align the frame to. `landmarks` are corners of earlier frames, which these steps keep where the frame
    shows them, and `images` are the same frames as they looked: where landmarks are few, it comes near by these and
    `views` before the map is asked. `trust` is what landmarks and images count for, of what they would. `known` are
    more keyframes: points count in the second-order steps only where these observed something.

    The first candidate is the expected pose. It starts from that one, or from another whose residual on the smooth
    field is below `track.rest` times as much: where surfaces hardly hold a frame, all fit almost alike.

    With `track.ro.when = "always"` this is the paper's RO then GO. With "needed", GO comes first. Where that ends above
    the residual `converged` (metres, `track.ro.residual` if not given), GO by way of the smooth field follows, and
    where that does too, RO then GO; the better end is kept. `widening` is a factor on the swarm's first radii.
    """
    k_go, k_smooth, k_ro, k_adam = jax.random.split(key, 4)
    ro, go = cfg.track.ro, cfg.track.go
    points = draw_points(k_go, depth, color, go.pixels, camera)
    coarse = draw_points(k_smooth, depth, color, go.smooth_pixels, camera)
    search_cost = jax.vmap(lambda T: measure_fit(field, T, coarse, "search", cfg).residual)(candidates)
    start = candidates[jnp.argmin(search_cost.at[0].multiply(cfg.track.rest))]
    before = measure_fit(field, start, points, "whole", cfg)
    # So weak that it counts only where nothing else holds the frame
    prior = Prior(start, (cfg.sensor.noise_floor / cfg.track.prior) ** 2 * jnp.eye(6))

    def compared(levels):
        """With earlier frames, the finest level first."""
        return [] if images is None else pyramid(images, grey_of(color), depth, levels, camera, cfg)

    def closer(T):
        """By images and depth images of earlier frames alone, from coarse to fine."""
        for level in reversed(compared(LEVELS)[1:]):
            seen = Evidence(coarse, views, landmarks, level, trust, prior)
            T = approach(T, seen, cfg.track.brightness.coarse_steps, camera, cfg)
        return T

    finest = next(iter(compared(1)), None)
    few = jnp.bool_(False) if images is None else jnp.any(images.mask)  # without colour the map comes first
    if landmarks is not None:
        few &= jnp.sum(landmarks.mask) < ENOUGH

    def evidence(T):
        """Of the frame about at T."""
        trusted, shade = points, finest and with_noise(finest, T, camera, cfg)
        if known is not None:
            small = camera.decimated(round(camera.width / known.depth.shape[2]))
            learned = observed(known, transform(T, points.p_cam), small, BEHIND)
            trusted = points._replace(mask=points.mask & learned)
        return Evidence(trusted, views, landmarks, shade, trust, prior)

    limit = ro.residual if converged is None else converged
    smooth = go.method == "lm" and cfg.field.encoding == "both"

    def near(T):
        if go.method == "adam":
            T = adam(field, T, points, k_adam, cfg)
        elif go.method == "lm":
            T = levenberg_marquardt(field, T, evidence(T), "whole", go.steps, camera, cfg)
        return T, measure_fit(field, T, points, "whole", cfg)

    def far(T):
        if smooth:
            T = levenberg_marquardt(field, T, Evidence(coarse), "search", go.smooth_steps, camera, cfg)
        return near(T)

    def searched(T):
        return far(search(field, depth, color, T, widening, k_ro, camera, cfg))

    def tried(attempt, found):
        """The better of what was found and of another attempt, where the first has not converged; and whether."""
        fit = found[1]
        failed = (fit.residual > limit) | (fit.known < ro.inliers) | ~jnp.isfinite(fit.residual)

        def again():
            there = attempt(start)
            better = (there[1].residual < fit.residual) | ~jnp.isfinite(fit.residual)
            return jax.tree.map(partial(jnp.where, better), there, found)

        return jax.lax.cond(failed, again, lambda: found), failed

    used_ro = jnp.bool_(ro.when == "always")
    if ro.when == "always":
        T, after = searched(start)
    else:
        # Where that leads astray, the attempts that follow begin anew
        found = near(start if images is None else jax.lax.cond(few, closer, lambda T: T, start))
        if smooth:
            found, _ = tried(far, found)
        if ro.when == "needed":
            found, used_ro = tried(searched, found)
        T, after = found
    ok = jnp.all(jnp.isfinite(T)) & jnp.isfinite(after.residual)
    T = jnp.where(ok, T, start)
    normals = own_normals(depth, points.p_cam, camera, cfg.sensor.noise_growth)
    holds = information(field, T, evidence(T), normals, camera, cfg)
    return T, TrackInfo(before, after, holds, used_ro, ok)


@partial(jax.jit, static_argnames=("camera", "cfg"))
def align(
    field: nf.Field,
    depth: Float[Array, "F H W"],
    T: Float[Array, "F 4 4"],
    colour: Float[Array, "F 6 6"],
    camera: Intrinsics,
    cfg: Config,
) -> Float[Array, "F 4 4"]:
    """Poses of F frames after a few second-order steps on every pixel of their (small) depth images.

    `colour` is how firmly images held each of them where it is (corners and brightness of `Information`): what surfaces
    leave free stays as it was. So does a frame that does not come out finite.
    """
    v, u = jnp.mgrid[: camera.height, : camera.width].reshape(2, -1)
    ray = rays(v, u, camera)

    def one(d, T, firm):
        d = d.reshape(-1)
        points = Points(ray * d[:, None], jnp.zeros_like(ray), d > 0)
        seen = Evidence(points, prior=Prior(T, cfg.sensor.noise_floor**2 * firm))
        there = levenberg_marquardt(field, T, seen, "whole", cfg.track.go.final_steps, camera, cfg)
        return jnp.where(jnp.all(jnp.isfinite(there)), there, T)

    return jax.vmap(one)(depth, T, colour)


class Registration(NamedTuple):
    """A frame in a submap that may or may not show what it sees."""

    T_sub_cam: Float[Array, "4 4"]
    overlap: Float[Array, ""]
    """Share of measured pixels that the submap's keyframes observed and where it is certain of its distance."""
    inliers: Float[Array, ""]
    """Share of those that are within `keyframe.error` of its surface."""
    held: Float[Array, ""]
    """How firmly the surface holds the pose in the direction where it holds it least: mean square, weighted as in
    tracking, of metres of distance for a metre, or a radian, of motion. Near 0 the frame slides or turns freely, as in
    a bare corridor, and the guess says where it is."""


@partial(jax.jit, static_argnames=("camera", "cfg"))
def register(
    field: nf.Field,
    depth: Float[Array, "H W"],
    T: Float[Array, "4 4"],
    camera: Intrinsics,
    cfg: Config,
    views: Views,
) -> Registration:
    """Second-order steps from a guess `T`, and what speaks for where they end. `depth` is at mapping size, as that of
    `views`, the submap's keyframes near the guess.

    Only pixels that they observed count, at the guess: elsewhere the submap is certain of surfaces that it made up, as
    behind a shelf, and a frame that sees past the shelf would be drawn along it.
    """
    color = jnp.zeros((*depth.shape, 3), jnp.uint8)
    every = draw_points(jax.random.key(0), depth, color, cfg.track.go.pixels, camera)

    def known(T):
        return every.mask & observed(views, transform(T, every.p_cam), camera, BEHIND)

    points = every._replace(mask=known(T))
    if cfg.field.encoding == "both":
        T = levenberg_marquardt(field, T, Evidence(points), "search", cfg.track.go.smooth_steps, camera, cfg)
    T = levenberg_marquardt(field, T, Evidence(points, views), "whole", cfg.track.go.steps, camera, cfg)
    hessian = map_rows(field, T, points, "whole", cfg).system().hessian
    held = jnp.linalg.eigvalsh(hessian)[0] / jnp.maximum(jnp.sum(points.mask), 1)
    prediction = nf.tsdf(field, transform(T, every.p_cam), cfg.field)
    certain = known(T) & nf.is_certain(prediction.entropy, cfg.correspond.max_entropy, cfg.field)
    near = (jnp.abs(prediction.psi) < cfg.keyframe.error).astype(jnp.float32)
    overlap = losses.masked_mean(certain.astype(jnp.float32), every.mask)
    return Registration(T, overlap, losses.masked_mean(near, certain), held)


def search(
    field: nf.Field,
    depth: Float[Array, "H W"],
    color: UInt8[Array, "H W 3"],
    T: Float[Array, "4 4"],
    widening: Float[Array, ""],
    key: PRNGKeyArray,
    camera: Intrinsics,
    cfg: Config,
) -> Float[Array, "4 4"]:
    """RO: the swarm's iterations by `lax.scan`, on another shift of the pixel grid each."""
    ro = cfg.track.ro
    swarm_template = jnp.asarray(particles.template(ro.particles))

    def step(swarm, k):
        points = draw_points(k, depth, color, ro.pixels, camera)
        return particles.step(swarm, swarm_template, field, points.p_cam, points.mask, cfg.field, ro), None

    radii = widening * jnp.array([ro.rotation] * 3 + [ro.translation] * 3)
    swarm = particles.Swarm(T, jnp.float32(jnp.inf), radii)
    return jax.lax.scan(step, swarm, jax.random.split(key, ro.steps))[0].T_sub_cam
