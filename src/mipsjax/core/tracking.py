"""Tracking of one frame: randomized (RO), then gradient-based (GO) optimisation, as one compiled schedule.

Poses are camera-to-submap matrices. Twists are (v, omega), metres and radians, in the camera's own frame:
T(xi) = T exp(xi).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray, UInt8

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core import least_squares, losses
from mipsjax.core.attempts import BEHIND, Target, attempts, by_search, unless_converged
from mipsjax.core.camera import Intrinsics, rays
from mipsjax.core.compiled import compiled
from mipsjax.core.encodings import fields
from mipsjax.core.equations import Points, Prior
from mipsjax.core.evidence import Landmarks, certainties, map_rows, view_rows
from mipsjax.core.fit import Fit, draw_points, measure_fit
from mipsjax.core.information import Information, information
from mipsjax.core.least_squares import prior_rows
from mipsjax.core.photometric import Images
from mipsjax.core.rigid import transform
from mipsjax.core.views import Views, observed, own_normals


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


@compiled("camera", "cfg", reads=("sensor", "field", "sample", "track", "keyframe", "correspond"))
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
    `views` before the map is asked. `trust` is what colour counts for, of what it would. `known` are
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
    frame = Target(
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

    first, *others = attempts(cfg)
    found, searched = first(frame, start), jnp.bool_(first is by_search)
    for attempt in others:
        found, tried = unless_converged(found, attempt, frame, start, limit)
        if attempt is by_search:
            searched = tried

    T, after = found
    ok = jnp.all(jnp.isfinite(T)) & jnp.isfinite(after.residual)
    T = jnp.where(ok, T, start)
    normals = own_normals(depth, points.p_cam, camera, cfg.sensor.noise_growth)
    holds = information(field, T, frame.evidence(T), normals, camera, cfg)
    return T, TrackInfo(before, after, holds, searched, ok)


@compiled("camera", "cfg", reads=("sensor", "field", "track"))
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
        prior = Prior(T, cfg.sensor.noise_floor**2 * firm)
        sure = certainties(field, T, points, "whole", cfg)

        by_prior = prior_rows(prior)

        def rows(T):
            return map_rows(field, T, points, "whole", cfg, sure), by_prior(T)

        return least_squares.solve(rows, T, cfg.track.go.final_steps, cfg.sensor.noise_floor)

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


@compiled("camera", "cfg", reads=("sensor", "field", "track", "keyframe", "correspond"))
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

    def on_map(T, part, sure):
        return map_rows(field, T, points, part, cfg, sure)

    if fields(cfg.field).two:
        sure = certainties(field, T, points, "search", cfg)
        T = least_squares.solve(
            lambda T: [on_map(T, "search", sure)], T, cfg.track.go.smooth_steps, cfg.sensor.noise_floor
        )
    sure = certainties(field, T, points, "whole", cfg)
    T = least_squares.solve(
        lambda T: [on_map(T, "whole", sure), view_rows(T, points, views, camera, cfg)],
        T,
        cfg.track.go.steps,
        cfg.sensor.noise_floor,
    )
    # By the map alone, on which overlap and inliers are judged as well
    hessian = map_rows(field, T, points, "whole", cfg).system().hessian
    held = jnp.linalg.eigvalsh(hessian)[0] / jnp.maximum(jnp.sum(points.mask), 1)
    prediction = nf.tsdf(field, transform(T, every.p_cam), cfg.field)
    certain = known(T) & nf.is_certain(prediction.entropy, cfg.correspond.max_entropy, cfg.field)
    near = (jnp.abs(prediction.psi) < cfg.keyframe.error).astype(jnp.float32)
    overlap = losses.masked_mean(certain.astype(jnp.float32), every.mask)
    return Registration(T, overlap, losses.masked_mean(near, certain), held)
