"""How firmly a frame is held at the pose that was found, and by what."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mipsjax.config.sections import Config
from mipsjax.core import field as nf
from mipsjax.core.camera import Intrinsics
from mipsjax.core.equations import Points, Rows, System, mean_precision
from mipsjax.core.evidence import Evidence, as_independent, by_twist, colour_systems, map_rows, view_rows

DOUBTED = 3  # weakest directions along which it is asked whether noise alone holds a frame
SURE = 3.0  # standard errors of what is found there by which the frame may be held less


class Information(NamedTuple):
    """How firmly a frame is held: inverse covariances of its pose, for a twist (v, omega) in the camera's frame,
    1/m^2 and 1/rad^2, each point, corner and pixel with its weight in the steps; `track.held` says how many of them err
    together."""

    surfaces: Float[Array, "6 6"]
    """By the map and the depth images of keyframes."""
    corners: Float[Array, "6 6"]
    """By corners of the image."""
    brightness: Float[Array, "6 6"]
    """By the brightness of all of it."""
    to_surfaces: Float[Array, "6"]
    """The twist from the pose to where surfaces alone would have it; not finite where these leave something open."""
    to_colour: Float[Array, "6"]
    """To where corners and brightness alone would; the same."""


def information(
    field: nf.Field,
    T: Float[Array, "4 4"],
    seen: Evidence,
    normals: Float[Array, "P 3"],
    camera: Intrinsics,
    cfg: Config,
) -> Information:
    """What holds a frame at the pose that was found. `normals` are those of its own depth image at the points, in the
    camera's frame (`views.own_normals`)."""
    points = seen.points
    parts = [map_rows(field, T, points, "whole", cfg)]
    if seen.views is not None:
        parts.append(view_rows(T, points, seen.views, camera, cfg))
    surfaces = mean_precision(points, cfg) * steady_hessian(parts, points, normals)
    close_by = 1 / cfg.sensor.noise_floor**2
    # Points weigh relative to each other, colour relative to points: here each by what it is worth
    corners, brightness = colour_systems(T, seen.landmarks, seen.shades, camera, cfg)
    return Information(
        close_by * surfaces,
        close_by * corners.hessian,
        close_by * brightness.hessian,
        _step(*(part.system() for part in parts)),
        _step(as_independent(corners, brightness, cfg)),
    )


def _step(*systems: System) -> Float[Array, "6"]:
    """The twist to where these alone would have the frame."""
    together = jax.tree.map(lambda *parts: sum(parts), *systems)
    return -jnp.linalg.solve(together.hessian, together.slope)


def steady_hessian(parts: list[Rows], points: Points, normals: Float[Array, "P 3"]) -> Float[Array, "6 6"]:
    """The Hessian of the points' distances to some surfaces, without what only noise makes of it.

    Normals are noisy, and surfaces that were learned have bumps: along a bare wall both seem to hold a frame that
    slides freely. Surfaces and the frame's own `normals` do not know of each other's noise, so that the Hessian of
    both has the right mean, of points that lie on a plane of the frame. Along the directions in which that is weakest
    only that counts, less its own noise.
    """
    hessian = sum(part.system().hessian for part in parts)
    own = by_twist(points.p_cam, normals)
    # A point's own noise is the same against each surface
    each = [(part.weight[..., None] * part.jacobian).reshape(-1, *own.shape) for part in parts]
    # Over all surfaces that a point was measured against
    weighted = jnp.sum(jnp.concatenate(each), 0)
    # Noise of the two factors is independent, so that the mean of their product is that without noise
    agreed = weighted.T @ own
    # Not those of the Hessian: by noise they lean towards what is held, which is a hundred times as firm
    strength, directions = jnp.linalg.eigh((agreed + agreed.T) / 2)
    weakest = directions[:, :DOUBTED]
    noise = jnp.linalg.norm((weighted @ weakest) * (own @ weakest), axis=0)
    steady = jnp.maximum(strength[:DOUBTED] - SURE * noise, 0)
    others = jnp.eye(6) - weakest @ weakest.T
    return others @ hessian @ others + (weakest * steady[None]) @ weakest.T
