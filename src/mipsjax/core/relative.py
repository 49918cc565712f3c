"""The pose of one frame in another, by what the two measured: their depth images, and their images, corners of these
and brightness. No map is asked, so that none can hand its errors on.

Twists are (v, omega), metres and radians, in the second frame's camera: T(xi) = T exp(xi).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from mipsjax.config.sections import Config
from mipsjax.core import losses
from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, unproject
from mipsjax.core.compiled import compiled
from mipsjax.core.equations import Points, Prior, descend, mean_precision, prior_system
from mipsjax.core.evidence import Landmarks, as_independent, colour_systems, view_errors, view_rows
from mipsjax.core.information import steady_hessian
from mipsjax.core.photometric import Images, pyramid, with_noise
from mipsjax.core.views import Views, own_normals

LEVELS = 2
"""Of the pyramid of images: a pair is known to a few pixels before."""


class Shown(NamedTuple):
    """P pairs of images."""

    first: Images
    """Of each pair one, with a second axis of length 1."""
    second: UInt8[Array, "P H W"]
    """Grey."""


class Pairs(NamedTuple):
    """P pairs of frames that see the same."""

    first: Float[Array, "P h w"]
    """Depth, decimated by a whole factor; metres, 0 for no measurement."""
    second: Float[Array, "P h w"]
    T_first_second: Float[Array, "P 4 4"]
    """Where the steps begin: pose of the second camera in the first."""
    T_expected: Float[Array, "P 4 4"]
    """That pose where nothing measures it."""
    landmarks: Landmarks | None
    """Corners of each first frame, in its camera, where the second one shows them."""
    shown: Shown | None
    """How they looked; None where brightness is not wanted."""


class Relative(NamedTuple):
    """What P pairs say. Inverse covariances are of a twist, 1/m^2 and 1/rad^2, as if points and corners that err
    together were one (`track.held`)."""

    T_first_second: Float[Array, "P 4 4"]
    surfaces: Float[Array, "P 6 6"]
    """Inverse covariance of the pose by depth images, and by what was expected where these say nothing."""
    colour: Float[Array, "P 6 6"]
    """By corners and brightness of the images, at the trust that was given."""
    to_surfaces: Float[Array, "P 6"]
    """The twist from that pose to where depth images alone would have it."""
    to_colour: Float[Array, "P 6"]
    """To where images alone would have it; not finite where these leave something open."""
    matched: Float[Array, " P"]
    """Share of the second frame's points that lie on surfaces of the first."""


@compiled("camera", "cfg", reads=("sensor", "track", "pairs"))
def measure(pairs: Pairs, trust: Float[Array, ""], camera: Intrinsics, cfg: Config) -> Relative:
    """Robust second-order steps on point-to-plane distances, errors of corners in the image and differences of
    brightness, one pair after the other.

    `trust` is what images count for, relative to `track.held`. `camera` is theirs.
    """
    return jax.lax.map(lambda pair: _measured(Pairs(*pair), trust, camera, cfg), tuple(pairs))


def _measured(pair: Pairs, trust: Float[Array, ""], camera: Intrinsics, cfg: Config) -> Relative:
    """One of them, without the first axis."""
    points = _points(pair.second, camera, cfg)
    views = Views(pair.first[None], jnp.eye(4)[None])
    # Points weigh relative to each other, images by what they are worth: here both do, and as few as are independent
    of_points = mean_precision(points, cfg) / cfg.track.held.points
    # As weak as in tracking: it counts only where nothing else holds the frame
    prior = Prior(pair.T_expected, (cfg.sensor.noise_floor / cfg.track.prior) ** 2 * jnp.eye(6))

    def on_surfaces(T):
        system = view_rows(T, points, views, camera, cfg).system()
        expected = prior_system(T, prior)
        return jax.tree.map(lambda part, weak: of_points * part + weak, system, expected)

    def on_images(T, seen):
        both = colour_systems(T, pair.landmarks, seen, camera, cfg)
        return jax.tree.map(lambda part: trust * part, as_independent(*both, cfg))

    def on_both(T, seen):
        return jax.tree.map(jnp.add, on_surfaces(T), on_images(T, seen))

    T, seen = pair.T_first_second, None
    if pair.shown is not None:
        first, grey = pair.shown.first, pair.shown.second.astype(jnp.float32)
        seen, coarse = pyramid(first, grey, pair.second, LEVELS, camera, cfg)
        T = descend(partial(on_both, seen=coarse), T, cfg.track.brightness.coarse_steps)
        seen = with_noise(seen, T, camera, cfg)
    T = descend(partial(on_both, seen=seen), T, cfg.track.go.steps)
    surfaces, colour = on_surfaces(T), on_images(T, seen)
    # What the steps went by takes the noise of normals for a hold; what is stated does not
    small = camera.decimated(round(camera.width / pair.second.shape[1]))
    normals = own_normals(pair.second, points.p_cam, small, cfg.sensor.noise_growth)
    rows = view_rows(T, points, views, camera, cfg)
    held = of_points * steady_hessian([rows], points, normals) + prior.weight
    hit = view_errors(T, points, views, camera, cfg).mask[0].astype(jnp.float32)
    # In units: the inverse variance of a depth measured close by
    close_by = 1 / cfg.sensor.noise_floor**2
    return Relative(
        T,
        close_by * held,
        close_by * colour.hessian,
        -jnp.linalg.solve(surfaces.hessian, surfaces.slope),
        -jnp.linalg.solve(colour.hessian, colour.slope),
        losses.masked_mean(hit, points.mask),
    )


def _points(depth: Float[Array, "h w"], camera: Intrinsics, cfg: Config) -> Points:
    """Of a stripe grid of about `pairs.pixels` cells, none of them shifted: the same in each call."""
    small = camera.decimated(round(camera.width / depth.shape[1]))
    # The middle of each cell: a draw would make the result depend on a key
    middle = jnp.full(2, 0.5)
    v, u = pixel_grid(*grid_shape(cfg.pairs.pixels, *depth.shape), middle, *depth.shape)
    d = depth[v, u]
    p_cam = unproject(v, u, d, small)
    return Points(p_cam, jnp.zeros_like(p_cam), d > 0)
