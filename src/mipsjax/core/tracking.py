"""Tracking of one frame: randomized (RO), then gradient-based (GO) optimisation, as one compiled schedule.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, UInt8

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core import losses, particles
from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, rays, unproject
from mipsjax.core.compiled import compiled
from mipsjax.core.encodings import fields
from mipsjax.core.equations import Points, Prior, robust_cost
from mipsjax.core.photometric import LEVELS, Images, Shades, grey_of, pyramid, with_noise
from mipsjax.core.rigid import transform
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
    return Points(unproject(v, u, d, camera), color[v, u].astype(jnp.float32) / 255, d > 0)


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


@compiled("camera", "cfg")
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
    frame = _Frame(
        field=field,
        depth=depth,
        color=color,
        points=points,
        coarse=coarse,
        views=views,
        landmarks=landmarks,
        known=known,
        images=images,
        finest=None,
        trust=trust,
        prior=prior,
        widening=widening,
        k_ro=k_ro,
        k_adam=k_adam,
        camera=camera,
        cfg=cfg,
    )
    if images is not None:
        frame = frame._replace(finest=frame.compared(1)[0])
    limit = ro.residual if converged is None else converged

    first, *others = _attempts(cfg)
    found, searched = first(frame, start), jnp.bool_(first is _by_search)
    for attempt in others:
        found, tried = _unless_converged(found, attempt, frame, start, limit)
        if attempt is _by_search:
            searched = tried

    T, after = found
    ok = jnp.all(jnp.isfinite(T)) & jnp.isfinite(after.residual)
    T = jnp.where(ok, T, start)
    normals = own_normals(depth, points.p_cam, camera, cfg.sensor.noise_growth)
    holds = information(field, T, frame.evidence(T), normals, camera, cfg)
    return T, TrackInfo(before, after, holds, searched, ok)


class _Found(NamedTuple):
    """Where an attempt at a frame ended."""

    T_sub_cam: Float[Array, "4 4"]
    fit: Fit


class _Frame(NamedTuple):
    """A frame that is to be tracked, and all that attempts at it use; the arguments of `track` say more.

    It lives while `track` is traced and is no argument of compiled code: `camera` and `cfg` are no arrays.
    """

    field: nf.Field
    depth: Float[Array, "H W"]
    color: UInt8[Array, "H W 3"]
    points: Points
    """For the steps on the most accurate field."""
    coarse: Points
    """Fewer, for those on the smooth field and by images alone."""
    views: Views | None
    landmarks: Landmarks | None
    known: Views | None
    images: Images | None
    finest: Shades | None
    """The frame's brightness against `images`, at their full size."""
    trust: Float[Array, ""] | float
    prior: Prior
    widening: Float[Array, ""]
    k_ro: PRNGKeyArray
    k_adam: PRNGKeyArray
    camera: Intrinsics
    cfg: Config

    def compared(self, levels: int) -> list[Shades]:
        """With earlier frames, the finest level first."""
        assert self.images is not None
        return pyramid(self.images, grey_of(self.color), self.depth, levels, self.camera, self.cfg)

    def evidence(self, T: Float[Array, "4 4"]) -> Evidence:
        """What says where the frame is, about at T."""
        trusted, shades = self.points, self.finest
        if shades is not None:
            shades = with_noise(shades, T, self.camera, self.cfg)
        if self.known is not None:
            small = self.camera.decimated(round(self.camera.width / self.known.depth.shape[2]))
            learned = observed(self.known, transform(T, trusted.p_cam), small, BEHIND)
            trusted = trusted._replace(mask=trusted.mask & learned)
        return Evidence(trusted, self.views, self.landmarks, shades, self.trust, self.prior)


_Attempt = Callable[[_Frame, Float[Array, "4 4"]], _Found]


def _attempts(cfg: Config) -> list[_Attempt]:
    """The ways to a pose, in their order: each is tried where those before it have not converged."""
    if cfg.track.ro.when == "always":
        return [_by_search]
    ways: list[_Attempt] = [_by_images]
    if _smooth_first(cfg):
        ways.append(_by_smooth)
    if cfg.track.ro.when == "needed":
        ways.append(_by_search)
    return ways


def _smooth_first(cfg: Config) -> bool:
    """Whether there is a smooth field beside the accurate one, on which second-order steps come from farther off."""
    return cfg.track.go.method == "lm" and fields(cfg.field).two


def _unless_converged(
    found: _Found,
    attempt: _Attempt,
    frame: _Frame,
    start: Float[Array, "4 4"],
    limit: Float[Array, ""] | float,
) -> tuple[_Found, Bool[Array, ""]]:
    """The better of what was found and of another attempt, where the first has not converged; and whether it was made.

    It begins anew, at `start`: where the attempts before it led astray, their end is no place to begin from.
    """
    fit = found.fit
    failed = (fit.residual > limit) | (fit.known < frame.cfg.track.ro.inliers) | ~jnp.isfinite(fit.residual)

    def again() -> _Found:
        there = attempt(frame, start)
        better = (there.fit.residual < fit.residual) | ~jnp.isfinite(fit.residual)
        return jax.tree.map(partial(jnp.where, better), there, found)

    return jax.lax.cond(failed, again, lambda: found), failed


def _refined(frame: _Frame, T: Float[Array, "4 4"]) -> _Found:
    """GO on the most accurate field: where every attempt ends."""
    go = frame.cfg.track.go
    if go.method == "adam":
        T = adam(frame.field, T, frame.points, frame.k_adam, frame.cfg)
    elif go.method == "lm":
        T = levenberg_marquardt(frame.field, T, frame.evidence(T), "whole", go.steps, frame.camera, frame.cfg)
    return _Found(T, measure_fit(frame.field, T, frame.points, "whole", frame.cfg))


def _by_images(frame: _Frame, T: Float[Array, "4 4"]) -> _Found:
    """First by images and depth images of earlier frames alone, from coarse to fine, where there are few landmarks."""
    if frame.images is None:
        return _refined(frame, T)
    few = jnp.any(frame.images.mask)  # without colour the map comes first
    if frame.landmarks is not None:
        few &= jnp.sum(frame.landmarks.mask) < ENOUGH

    def closer(T):
        # The finest level is left to the steps on the map, which have it, too
        for level in reversed(frame.compared(LEVELS)[1:]):
            seen = Evidence(frame.coarse, frame.views, frame.landmarks, level, frame.trust, frame.prior)
            steps = frame.cfg.track.brightness.coarse_steps
            T = approach(T, seen, steps, frame.camera, frame.cfg)
        return T

    return _refined(frame, jax.lax.cond(few, closer, lambda T: T, T))


def _by_smooth(frame: _Frame, T: Float[Array, "4 4"]) -> _Found:
    """First on the smooth field, if there is one beside the other, and by the frame's depth alone."""
    if _smooth_first(frame.cfg):
        steps = frame.cfg.track.go.smooth_steps
        seen = Evidence(frame.coarse)
        T = levenberg_marquardt(frame.field, T, seen, "search", steps, frame.camera, frame.cfg)
    return _refined(frame, T)


def _by_search(frame: _Frame, T: Float[Array, "4 4"]) -> _Found:
    """First RO, then the smooth field."""
    there = search(
        frame.field, frame.depth, frame.color, T, frame.widening, frame.k_ro, frame.camera, frame.cfg
    )
    return _by_smooth(frame, there)


@compiled("camera", "cfg")
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
    # Every pixel: the images are small, and what is not drawn needs no key
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


@compiled("camera", "cfg")
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
    # No term reads it here; the points only need one
    color = jnp.zeros((*depth.shape, 3), jnp.uint8)
    every = draw_points(jax.random.key(0), depth, color, cfg.track.go.pixels, camera)

    def known(T):
        return every.mask & observed(views, transform(T, every.p_cam), camera, BEHIND)

    points = every._replace(mask=known(T))
    if fields(cfg.field).two:
        T = levenberg_marquardt(field, T, Evidence(points), "search", cfg.track.go.smooth_steps, camera, cfg)
    T = levenberg_marquardt(field, T, Evidence(points, views), "whole", cfg.track.go.steps, camera, cfg)
    # By the map alone, on which overlap and inliers are judged as well
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

    # Rotation first, as the quaternion part comes first in a particle
    radii = widening * jnp.array([ro.rotation] * 3 + [ro.translation] * 3)
    # Its cost is not asked for before the first step, which evaluates the centre on its own pixels
    swarm = particles.Swarm(T, jnp.float32(jnp.inf), radii)
    return jax.lax.scan(step, swarm, jax.random.split(key, ro.steps))[0].T_sub_cam
