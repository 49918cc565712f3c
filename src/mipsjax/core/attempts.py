"""Ways to the pose of a frame: by images, by the smooth field, by a search; each ends on the most accurate field.

Poses are camera-to-submap matrices. One attempt after another is folded into the best pose that was found so far.
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
from mipsjax.core import particles
from mipsjax.core.camera import Intrinsics
from mipsjax.core.encodings import fields
from mipsjax.core.equations import Points, Prior
from mipsjax.core.evidence import Evidence, Landmarks
from mipsjax.core.fit import Fit, draw_points, measure_fit
from mipsjax.core.photometric import LEVELS, Images, Shades, grey_of, pyramid, with_noise
from mipsjax.core.rigid import transform
from mipsjax.core.solvers import adam, approach, levenberg_marquardt
from mipsjax.core.views import Views, observed

# Corners that say where the camera is to a pixel or two: no coarse level of images is needed then
ENOUGH = 100
BEHIND = 0.3  # metres behind what a keyframe saw, to which its surface may still be that of a frame not yet registered


class Found(NamedTuple):
    """Where an attempt at a frame ended."""

    T_sub_cam: Float[Array, "4 4"]
    fit: Fit


class Target(NamedTuple):
    """A frame that is to be tracked, and all that attempts at it use; the arguments of `tracking.track` say more.

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


Attempt = Callable[[Target, Float[Array, "4 4"]], Found]


def attempts(cfg: Config) -> list[Attempt]:
    """The ways to a pose, in their order: each is tried where those before it have not converged."""
    if cfg.track.ro.when == "always":
        return [by_search]
    ways: list[Attempt] = [_by_images]
    if _smooth_first(cfg):
        ways.append(_by_smooth)
    if cfg.track.ro.when == "needed":
        ways.append(by_search)
    return ways


def _smooth_first(cfg: Config) -> bool:
    """Whether there is a smooth field beside the accurate one, on which second-order steps come from farther off."""
    return cfg.track.go.method == "lm" and fields(cfg.field).two


def unless_converged(
    found: Found,
    attempt: Attempt,
    frame: Target,
    start: Float[Array, "4 4"],
    limit: Float[Array, ""] | float,
) -> tuple[Found, Bool[Array, ""]]:
    """The better of what was found and of another attempt, where the first has not converged; and whether it was made.

    It begins anew, at `start`: where the attempts before it led astray, their end is no place to begin from.
    """
    fit = found.fit
    failed = (fit.residual > limit) | (fit.known < frame.cfg.track.ro.inliers) | ~jnp.isfinite(fit.residual)

    def again() -> Found:
        there = attempt(frame, start)
        better = (there.fit.residual < fit.residual) | ~jnp.isfinite(fit.residual)
        return jax.tree.map(partial(jnp.where, better), there, found)

    return jax.lax.cond(failed, again, lambda: found), failed


def _refined(frame: Target, T: Float[Array, "4 4"]) -> Found:
    """GO on the most accurate field: where every attempt ends."""
    go = frame.cfg.track.go
    if go.method == "adam":
        T = adam(frame.field, T, frame.points, frame.trust, frame.k_adam, frame.cfg)
    elif go.method == "lm":
        T = levenberg_marquardt(frame.field, T, frame.evidence(T), "whole", go.steps, frame.camera, frame.cfg)
    return Found(T, measure_fit(frame.field, T, frame.points, "whole", frame.cfg))


def _by_images(frame: Target, T: Float[Array, "4 4"]) -> Found:
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


def _by_smooth(frame: Target, T: Float[Array, "4 4"]) -> Found:
    """First on the smooth field, if there is one beside the other, and by the frame's depth alone."""
    if _smooth_first(frame.cfg):
        steps = frame.cfg.track.go.smooth_steps
        seen = Evidence(frame.coarse)
        T = levenberg_marquardt(frame.field, T, seen, "search", steps, frame.camera, frame.cfg)
    return _refined(frame, T)


def by_search(frame: Target, T: Float[Array, "4 4"]) -> Found:
    """First RO, then the smooth field."""
    there = search(
        frame.field, frame.depth, frame.color, T, frame.widening, frame.k_ro, frame.camera, frame.cfg
    )
    return _by_smooth(frame, there)


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
