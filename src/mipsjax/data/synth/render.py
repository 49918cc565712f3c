"""Rendering of colour and z-depth: closed-form entry into every shape, then sphere tracing to the surface."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Float64, Int, UInt8

from mipsjax.core.camera import Intrinsics
from mipsjax.data.synth.cull import in_view
from mipsjax.data.synth.scene import Components, Scene, Shapes, Surface, components, local, turned
from mipsjax.data.synth.texture import albedo

# A ray this near to a surface (metres) has hit it; the last correction along the ray then leaves micrometres
_HIT = 2e-4
# Most rays hit at their first contact. The others go on in batches of these shares of all rays, by these
# numbers of steps at a time: few rays, which graze a rounded edge, take long
_BATCH_SHARES, _STEPS = (16, 256), (4, 12)
# Bound of the loop, far above the 20 or so rounds that an image takes
_MOST_ROUNDS = 2000
# Two carved boxes meet along a ray if the second begins at most this far (metres) behind the end of the first
_JOINT = 1e-4
# Against division by zero along an axis the ray does not move on
_TINY = 1e-9
# Least cosine between ray and normal for the last correction along the ray, and its bound in metres
_GRAZING, _CORRECTION = 0.02, 5e-3
# Distances from a surface (metres) at which what is around it shades it, and how much
_AMBIENT_REACH = ((0.06, 0.45), (0.28, 0.4))
# What is seen through glass is so far behind it, metres of z-depth
_OUTSIDE = 6.0
# Ambient light from below and from above, linear
_AMBIENT_DOWN, _AMBIENT_UP = 0.22, 0.38
# Display encoding of linear colour
_GAMMA = 1.0 / 2.2


class Rays(NamedTuple):
    """Rays whose parameter is z-depth: direction = R (x, y, 1), of length 1 or more."""

    origin: Components
    """Metres, world frame; one for all rays."""
    direction: Components

    def at(self, depth: Float[Array, "N"]) -> Components:
        """World points at a z-depth."""
        return Components(*(o + depth * d for o, d in zip(self.origin, self.direction, strict=True)))

    def of(self, chosen: Int[Array, "M"]) -> Rays:
        """Some of the rays."""
        return Rays(self.origin, Components(*(d[chosen] for d in self.direction)))


class Image(NamedTuple):
    """A rendered view."""

    color: UInt8[np.ndarray, "H W 3"]
    """RGB."""
    depth: Float32[np.ndarray, "H W"]
    """z-depth, metres."""
    glass: Bool[np.ndarray, "H W"]
    """Pixels that show the outside through glass, which a depth camera does not measure; depth is the glass's."""


def render(scene: Scene, intrinsics: Intrinsics, T_world_cam: Float64[np.ndarray, "K 4 4"]) -> Image:
    """One image exposed along K camera-to-world poses: the mean of their light, the depth of the middle one.

    Every pixel has a depth, exact to float32. The cameras must stand in free space.
    """
    fx, fy, cx, cy, width, height = intrinsics
    pinhole = jnp.array([fx, fy, cx, cy], jnp.float32)
    views = [
        _view(in_view(scene, intrinsics, pose), jnp.asarray(pose, jnp.float32), pinhole, height, width)
        for pose in T_world_cam
    ]
    # Before the display's encoding: light adds up, grey levels do not
    light = np.mean([np.asarray(color) for color, _, _ in views], axis=0)
    _, depth, glass = views[len(views) // 2]
    return Image(display(light), np.asarray(depth), np.asarray(glass))


def display(light: Float[np.ndarray, "*n 3"]) -> UInt8[np.ndarray, "*n 3"]:
    """Linear RGB as 8-bit display values."""
    return np.round(255.0 * np.clip(light, 0.0, 1.0) ** _GAMMA).astype(np.uint8)


def pixel_rays(T_world_cam: Float[Array, "4 4"], pinhole: Float[Array, "4"], height: int, width: int) -> Rays:
    """Rays through the pixel centres, row by row. `pinhole` is (fx, fy, cx, cy) in pixels."""
    fx, fy, cx, cy = pinhole
    v, u = jnp.mgrid[:height, :width].reshape(2, -1)
    x, y = (u - cx) / fx, (v - cy) / fy
    direction = Components(*(row[0] * x + row[1] * y + row[2] for row in T_world_cam[:3, :3]))
    return Rays(components(T_world_cam[:3, 3]), direction)


def _slab(origin: Array, direction: Array, half: Array) -> tuple[Array, Array]:
    """Where rays enter and leave |coordinate| < half."""
    safe = jnp.where(jnp.abs(direction) < _TINY, _TINY, direction)
    inverse = 1.0 / safe
    middle, reach = -origin * inverse, half * jnp.abs(inverse)
    return middle - reach, middle + reach


def _through_box(rays: Rays, shape: Shapes) -> tuple[Float[Array, "N"], Float[Array, "N"]]:
    """Where rays enter and leave a box; a miss has entry > leave."""
    origin, direction = local(shape, rays.origin), turned(shape, rays.direction)
    slabs = [_slab(o, d, h) for o, d, h in zip(origin, direction, shape.half, strict=True)]
    entry = jnp.maximum(jnp.maximum(slabs[0][0], slabs[1][0]), slabs[2][0])
    leave = jnp.minimum(jnp.minimum(slabs[0][1], slabs[1][1]), slabs[2][1])
    return entry, leave


def _through_rounded_box(rays: Rays, shape: Shapes) -> tuple[Float[Array, "N"], Float[Array, "N"]]:
    """Where rays enter and leave the box and the ball that both enclose a rounded box; exact for a sphere."""
    entry, leave = _through_box(rays, shape)
    o, d = local(shape, rays.origin), turned(shape, rays.direction)
    core = shape.half - shape.rounding
    radius = jnp.sqrt(jnp.sum(core**2)) + shape.rounding
    a = d.x**2 + d.y**2 + d.z**2
    low, high = _quadratic(a, o.x * d.x + o.y * d.y + o.z * d.z, o.x**2 + o.y**2 + o.z**2 - radius**2)
    return jnp.maximum(entry, low), jnp.minimum(leave, high)


def _quadratic(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
    """Both solutions of a t^2 + 2 b t + c = 0, or (inf, -inf) where there is none; a > 0."""
    square = b * b - a * c
    root = jnp.sqrt(jnp.maximum(square, 0.0))
    real = square > 0.0
    inverse = 1.0 / a
    return jnp.where(real, (-b - root) * inverse, jnp.inf), jnp.where(real, (-b + root) * inverse, -jnp.inf)


def _through_cylinder(rays: Rays, shape: Shapes) -> tuple[Float[Array, "N"], Float[Array, "N"]]:
    """Where rays enter and leave an upright cylinder; a miss has entry > leave."""
    o, d = local(shape, rays.origin), turned(shape, rays.direction)
    a = jnp.maximum(d.x**2 + d.z**2, _TINY)
    low, high = _quadratic(a, o.x * d.x + o.z * d.z, o.x**2 + o.z**2 - shape.half[0] ** 2)
    below, above = _slab(o.y, d.y, shape.half[1])
    return jnp.maximum(low, below), jnp.minimum(high, above)


def _first_contact(scene: Scene, rays: Rays, after: Float[Array, "N"]) -> Float[Array, "N"]:
    """A z-depth up to which every ray is free if it is free up to `after`: exact but for rounded edges."""
    free = _end_of_room(scene.carved, rays)
    for shapes, through in ((scene.boxes, _through_rounded_box), (scene.cylinders, _through_cylinder)):

        def nearer(best: Array, shape: Shapes, through=through) -> tuple[Array, None]:
            entry, leave = through(rays, shape)
            hit = (entry < leave) & (leave > after)
            return jnp.where(hit, jnp.minimum(best, entry), best), None

        free, _ = jax.lax.scan(nearer, free, shapes)
    return jnp.maximum(free, after)


def _end_of_room(carved: Shapes, rays: Rays) -> Float[Array, "N"]:
    """Where rays leave the union of the carved boxes, passing from one into the next."""
    entry, leave = jax.vmap(lambda shape: _through_box(rays, shape))(carved)
    # A box that a ray misses leads nowhere
    leave = jnp.where(entry < leave, leave, 0.0)

    def pass_on(_: Array, reached: Array) -> Array:
        return jnp.maximum(
            reached, jnp.max(jnp.where(entry <= reached[None, :] + _JOINT, leave, 0.0), axis=0)
        )

    return jax.lax.fori_loop(0, entry.shape[0], pass_on, jnp.zeros(entry.shape[1]))


def trace(scene: Scene, rays: Rays) -> Float[Array, "N"]:
    """z-depth of the first surface along each ray, to within `_HIT`. The origin must be in free space."""
    count = rays.direction.x.shape[0]
    state = _Tracing(*_approach(scene, rays, jnp.zeros(count), steps=1), jnp.int32(0))
    sizes = [-(-count // share) for share in _BATCH_SHARES]
    for size, steps, left in zip(sizes, _STEPS, [*sizes[1:], 0], strict=True):
        state = _trace_down_to(left, scene, rays, state, size, steps)
    return state.depth


class _Tracing(NamedTuple):
    depth: Float[Array, "N"]
    moving: Bool[Array, "N"]
    """Whether the ray has not hit yet."""
    rounds: Int[Array, ""]


def _trace_down_to(left: int, scene: Scene, rays: Rays, state: _Tracing, size: int, steps: int) -> _Tracing:
    """Advance rays in batches of `size` until at most `left` of them have not hit."""

    def under_way(state: _Tracing) -> Bool[Array, ""]:
        return (jnp.sum(state.moving) > left) & (state.rounds < _MOST_ROUNDS)

    def advance(state: _Tracing) -> _Tracing:
        (chosen,) = jnp.nonzero(state.moving, size=size, fill_value=state.moving.shape[0])
        depth, moving = _approach(scene, rays.of(chosen), state.depth[chosen], steps)
        return _Tracing(
            state.depth.at[chosen].set(depth), state.moving.at[chosen].set(moving), state.rounds + 1
        )

    return jax.lax.while_loop(under_way, advance, state)


def _approach(
    scene: Scene, rays: Rays, depth: Float[Array, "N"], steps: int
) -> tuple[Float[Array, "N"], Bool[Array, "N"]]:
    """Rays moved to their next contact in closed form, then by sphere tracing; which have not hit yet."""
    length = jnp.sqrt(sum(d**2 for d in rays.direction))
    start = _first_contact(scene, rays, depth)

    def step(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        depth, _ = carry
        free = scene.distance_at(rays.at(depth))
        moving = free > _HIT
        return depth + jnp.where(moving, free / length, 0.0), moving

    return jax.lax.fori_loop(0, steps, step, (start, jnp.zeros(start.shape, bool)))


def irradiance(scene: Scene, surface: Surface, points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Linear RGB light that points receive: from every light by the cosine, ambient less in corners."""

    def feel(openness: Array, tap: Float[Array, "2"]) -> tuple[Array, None]:
        reach, weight = tap
        free = scene.distance(points + reach * surface.normal)
        return openness - weight * jnp.clip(1.0 - free / reach, 0.0, 1.0), None

    openness, _ = jax.lax.scan(feel, jnp.ones(points.shape[0]), jnp.array(_AMBIENT_REACH))
    up = 0.5 - 0.5 * surface.normal[:, 1]
    light = (openness * (_AMBIENT_DOWN + (_AMBIENT_UP - _AMBIENT_DOWN) * up))[:, None] * jnp.ones((1, 3))
    for position, color in zip(scene.lights.position, scene.lights.color, strict=True):
        to_light = position[None, :] - points
        square = jnp.sum(to_light**2, axis=-1)
        cosine = jnp.sum(to_light * surface.normal, axis=-1) / jnp.sqrt(square + _TINY)
        # Softer than the inverse square, which would burn out what is next to the light
        received = openness * jnp.maximum(cosine, 0.0) / (1.0 + square)
        light = light + received[:, None] * color[None, :]
    return light


@jax.jit
def radiance(scene: Scene, points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Linear RGB light that surface points send out, the same in every direction."""
    return _radiance(scene, scene.surface(points), points)


def _radiance(scene: Scene, surface: Surface, points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    light = irradiance(scene, surface, points)
    if scene.glow is not None:
        glow = scene.glow[surface.material][:, None]
        light = jnp.where(glow > 0.0, glow, light)
    return albedo(scene.materials, surface.material, points) * light


def _settle(surface: Surface, rays: Rays, depth: Float[Array, "N"]) -> Float[Array, "N"]:
    """One Newton step along each ray to the surface it has hit, where it does not graze."""
    slope = sum(n * d for n, d in zip(components(surface.normal), rays.direction, strict=True))
    step = -surface.distance / jnp.where(slope < -_GRAZING, slope, -1.0)
    return depth + jnp.where(slope < -_GRAZING, jnp.clip(step, -_CORRECTION, _CORRECTION), 0.0)


@partial(jax.jit, static_argnames=("height", "width"))
def _view(
    scene: Scene, T_world_cam: Float[Array, "4 4"], pinhole: Float[Array, "4"], height: int, width: int
) -> tuple[Float[Array, "H W 3"], Float[Array, "H W"], Bool[Array, "H W"]]:
    rays = pixel_rays(T_world_cam, pinhole, height, width)
    hit = trace(scene, rays)
    surface = scene.surface(jnp.stack(rays.at(hit), axis=-1))
    depth = _settle(surface, rays, hit)
    glass, shown = jnp.zeros(depth.shape, bool), depth
    if scene.glow is not None:
        glass = scene.glow[surface.material] > 0.0
        shown = depth + jnp.where(glass, _OUTSIDE, 0.0)
    color = _radiance(scene, surface, jnp.stack(rays.at(shown), axis=-1))
    return color.reshape(height, width, 3), depth.reshape(height, width), glass.reshape(height, width)
