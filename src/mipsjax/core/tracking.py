"""Tracking of one frame: randomized, then gradient-based optimisation, as one compiled schedule."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from mipsjax.config import Config, FieldConfig, RefineConfig
from mipsjax.core import field as nf
from mipsjax.core import particles as ro
from mipsjax.core.camera import Intrinsics, grid_shape, pixel_grid, rays, transform

SATURATED = 0.95  # of the truncation: beyond it the field is flat and says nothing about direction


class Points(NamedTuple):
    p_cam: Float[Array, "P 3"]
    mask: Bool[Array, " P"]


class Fit(NamedTuple):
    """How well a frame fits the map at a pose."""

    residual: Float[Array, ""]
    """Root of the mean robust cost, metres."""
    inliers: Float[Array, ""]
    """Share of measured pixels within 5 cm of the surface."""


class TrackInfo(NamedTuple):
    before: Fit
    after: Fit
    searched: Bool[Array, ""]
    ok: Bool[Array, ""]


def draw_points(key, depth: Float[Array, "H W"], pixels: int, camera: Intrinsics) -> Points:
    """Points of a randomly shifted stripe grid, camera frame."""
    height, width = depth.shape
    v, u = pixel_grid(*grid_shape(pixels, height, width), jax.random.uniform(key, (2,)), height, width)
    d = depth[v, u]
    return Points(rays(v, u, camera) * d[:, None], d > 0)


def robust_cost(psi, cfg: RefineConfig):
    """Cauchy, square metres."""
    return cfg.robust**2 * jnp.log1p((psi / cfg.robust) ** 2)


def fit(field, T, points: Points, part, cfg: Config) -> Fit:
    psi = nf.tsdf(field, transform(T, points.p_cam), cfg.field, part).psi
    n = jnp.maximum(jnp.sum(points.mask), 1)
    res = jnp.sqrt(jnp.sum(robust_cost(psi, cfg.track.go) * points.mask) / n)
    return Fit(res, jnp.sum((jnp.abs(psi) < 0.05) & points.mask) / n)


def refine_lm(field, T0, points: Points, part, cfg: Config, steps: int):
    """Levenberg-Marquardt on d2t with a Cauchy weight; the closed 6 x 6 system."""
    go, tau = cfg.track.go, cfg.field.truncation

    def system(T):
        p = transform(T, points.p_cam)
        psi, pull = jax.vjp(lambda x: nf.tsdf(field, x, cfg.field, part).psi, p)
        (gradient,) = pull(jnp.ones_like(psi))
        g_cam = gradient @ T[:3, :3]
        J = jnp.concatenate([g_cam, jnp.cross(points.p_cam, g_cam)], -1)
        w = points.mask * (jnp.abs(psi) < SATURATED * tau) / (1 + (psi / go.robust) ** 2)
        cost = jnp.sum(robust_cost(psi, go) * points.mask)
        return cost, (J.T * w) @ J, (J.T * w) @ psi

    def step(carry, _):
        T, cost, H, b, damping = carry
        A = H + damping * jnp.diag(jnp.diag(H)) + 1e-3 * jnp.eye(6)
        xi = -jnp.linalg.solve(A, b)
        T_new = T @ jaxlie.SE3.exp(xi).as_matrix()
        cost_new, H_new, b_new = system(T_new)
        better = cost_new < cost
        pick = partial(jax.tree.map, lambda a, b: jnp.where(better, a, b))
        T, cost, H, b = pick((T_new, cost_new, H_new, b_new), (T, cost, H, b))
        return (T, cost, H, b, jnp.where(better, damping * 0.3, damping * 4.0)), cost

    start = (T0, *system(T0), jnp.float32(1e-3))
    (T, *_), costs = jax.lax.scan(step, start, None, length=steps)
    return T, costs


@partial(jax.jit, static_argnames=("camera", "cfg"))
def track(
    field: nf.Field,
    depth: Float[Array, "H W"],
    candidates: Float[Array, "K 4 4"],
    radii: Float[Array, "6"],
    force: Bool[Array, ""],
    key: PRNGKeyArray,
    camera: Intrinsics,
    cfg: Config,
):
    k_go, k_ro, k_fit = jax.random.split(key, 3)
    points = draw_points(k_go, depth, cfg.track.go.pixels, camera)
    coarse = jax.vmap(lambda T: fit(field, T, points, "search", cfg).residual)(candidates)
    T0 = candidates[jnp.argmin(coarse)]
    before = fit(field, T0, points, "whole", cfg)

    def go(T):
        if cfg.field.encoding == "both":
            T, _ = refine_lm(field, T, points, "search", cfg, cfg.track.go.steps // 2)
        T, _ = refine_lm(field, T, points, "whole", cfg, cfg.track.go.steps)
        return T, fit(field, T, points, "whole", cfg)

    def search(T):
        particles = jnp.asarray(ro.template(cfg.track.ro.particles))

        def one(swarm, k):
            sample = draw_points(k, depth, cfg.track.ro.pixels, camera)
            return ro.step(swarm, particles, field, sample.p_cam, sample.mask, cfg.field, cfg.track.ro), swarm.cost

        swarm = ro.Swarm(T, jnp.float32(jnp.inf), radii)
        swarm, _ = jax.lax.scan(one, swarm, jax.random.split(k_ro, cfg.track.ro.steps))
        return swarm.T_sub_cam

    T, after = go(T0)
    searched = jnp.bool_(False)
    if cfg.track.ro.when != "never":
        searched = force | (after.residual > cfg.track.ro.residual) | (after.inliers < cfg.track.ro.inliers)

        def retry():
            T2, after2 = go(search(T0))
            better = after2.residual < after.residual
            return jax.tree.map(lambda a, b: jnp.where(better, a, b), (T2, after2), (T, after))

        T, after = jax.lax.cond(searched, retry, lambda: (T, after))
    ok = jnp.all(jnp.isfinite(T)) & jnp.isfinite(after.residual)
    return jnp.where(ok, T, T0), TrackInfo(before, after, searched, ok)
