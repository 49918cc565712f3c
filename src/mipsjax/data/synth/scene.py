"""Analytic scenes: rooms carved out of a solid, furnished with boxes and cylinders, as signed distances.

World frame as the camera at rest: x right, y down (gravity is +y), z forward; metres. The floor of a scene
is at y = 0, so that what stands on it has negative y.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mipsjax.data.synth.texture import Materials, albedo

# Keeps square roots differentiable at zero; its root, 1e-10 m, is far below float32 resolution here
_TINY_SQUARE = 1e-20
# Where normals are taken, sharp edges of solids are rounded and rooms enlarged by this (metres): it moves the
# kink between inner and outer distance off the surface, where a rounding error would choose the side
_SOFT_EDGE = 1e-3
# Cosine above which a face counts as horizontal when its material is chosen
_HORIZONTAL = 0.7


class Shapes(NamedTuple):
    """K boxes, or K upright cylinders, turned about the vertical axis. A sphere is a fully rounded box."""

    center: Float[Array, "*k 3"]
    """Metres, world frame."""
    half: Float[Array, "*k 3"]
    """Outer half size in metres, rounding included; a cylinder has (radius, half height, radius)."""
    rounding: Float[Array, "*k"]
    """Radius of the rounded edges in metres, at most the smallest half size."""
    turn: Float[Array, "*k 2"]
    """Cosine and sine of the turn about the vertical."""
    material: Int[Array, "*k 3"]
    """Material of the faces that look up, sideways and down."""


class Lights(NamedTuple):
    """Point lights; they cast no shadows."""

    position: Float[Array, "L 3"]
    """Metres, world frame."""
    color: Float[Array, "L 3"]
    """Linear RGB irradiance at one metre, facing the light."""


class Components(NamedTuple):
    """Points or directions by component: contiguous rows vectorise, triplets do not."""

    x: Float[Array, "*n"]
    y: Float[Array, "*n"]
    z: Float[Array, "*n"]


def components(vectors: Float[Array, "*n 3"]) -> Components:
    """Vectors by component."""
    return Components(vectors[..., 0], vectors[..., 1], vectors[..., 2])


class Surface(NamedTuple):
    """The surface nearest to each of some points."""

    distance: Float[Array, "N"]
    """Signed, metres."""
    normal: Float[Array, "N 3"]
    """Unit vectors into free space."""
    material: Int[Array, "N"]
    """Row of the scene's materials."""


class Scene(NamedTuple):
    """All that can be seen. Free space is the union of `carved`, less `boxes` and `cylinders`.

    A pytree of arrays, so that scenes of equal numbers of shapes share compiled code.
    """

    carved: Shapes
    """Axis-aligned boxes without rounding; neighbours must overlap, or a wall stands between them."""
    boxes: Shapes
    cylinders: Shapes
    materials: Materials
    lights: Lights
    bounds: Float[Array, "2 3"]
    """Lower and upper corner of a box that holds every visible surface, metres."""
    glow: Float[Array, "M"] | None = None
    """Light of the outside that shines through each material, 0 for what is no glass; None if nothing is."""

    def distance(self, points: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
        """Signed distance in metres, positive in free space.

        Its zero set is the surface, and in free space it never exceeds the true distance: a ball of this
        radius around the point is free.
        """
        return self.distance_at(components(points.reshape(-1, 3))).reshape(points.shape[:-1])

    def distance_at(self, points: Components) -> Float[Array, "N"]:
        """`distance`, for points by component."""
        return _nearest(self, points)[0]

    def surface(self, points: Float[Array, "N 3"]) -> Surface:
        """Distance, normal and material of the surface nearest to each point."""
        distance, index = _nearest(self, components(points))
        shapes = jax.tree.map(
            lambda *rows: jnp.concatenate(rows)[index], self.carved, self.boxes, self.cylinders
        )
        normal = _normals(shapes, self._kind(index), points)
        # y is down: the normal of a floor has -1 there, that of a ceiling 1
        face = (normal[:, 1] > -_HORIZONTAL).astype(jnp.int32) + (normal[:, 1] > _HORIZONTAL)
        material = jnp.take_along_axis(shapes.material, face[:, None], axis=1)[:, 0]
        return Surface(distance, normal, material)

    def color(self, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """Linear RGB reflectance in 0..1 of the surface nearest to each point."""
        flat = points.reshape(-1, 3)
        return albedo(self.materials, self.surface(flat).material, flat).reshape(points.shape)

    def _kind(self, index: Int[Array, "N"]) -> Int[Array, "N"]:
        """0 for carved, 1 for boxes, 2 for cylinders."""
        carved, boxes = self.carved.rounding.shape[0], self.boxes.rounding.shape[0]
        return (index >= carved).astype(jnp.int32) + (index >= carved + boxes)


def turned(shape: Shapes, v: Components) -> Components:
    """World directions in the axes of one shape (a row of `Shapes`)."""
    c, s = shape.turn[..., 0], shape.turn[..., 1]
    return Components(c * v.x - s * v.z, v.y, s * v.x + c * v.z)


def local(shape: Shapes, p: Components) -> Components:
    """World points relative to one shape, in its axes."""
    center = components(shape.center)
    return turned(shape, Components(p.x - center.x, p.y - center.y, p.z - center.z))


def _box_distance(shape: Shapes, p: Components) -> Float[Array, "*n"]:
    core = components(shape.half - shape.rounding[..., None])
    qx, qy, qz = (jnp.abs(a) - b for a, b in zip(local(shape, p), core, strict=True))
    square = jnp.maximum(qx, 0.0) ** 2 + jnp.maximum(qy, 0.0) ** 2 + jnp.maximum(qz, 0.0) ** 2
    inside = jnp.minimum(jnp.maximum(jnp.maximum(qx, qy), qz), 0.0)
    return jnp.sqrt(jnp.maximum(square, _TINY_SQUARE)) + inside - shape.rounding


def _cylinder_distance(shape: Shapes, p: Components) -> Float[Array, "*n"]:
    core, q = components(shape.half - shape.rounding[..., None]), local(shape, p)
    qr = jnp.sqrt(jnp.maximum(q.x**2 + q.z**2, _TINY_SQUARE)) - core.x
    qy = jnp.abs(q.y) - core.y
    square = jnp.maximum(qr, 0.0) ** 2 + jnp.maximum(qy, 0.0) ** 2
    inside = jnp.minimum(jnp.maximum(qr, qy), 0.0)
    return jnp.sqrt(jnp.maximum(square, _TINY_SQUARE)) + inside - shape.rounding


def _carved_distance(shape: Shapes, p: Components) -> Float[Array, "*n"]:
    return -_box_distance(shape, p)


class _Best(NamedTuple):
    """Running choice of a surface over the shapes seen so far."""

    distance: Float[Array, "N"]
    shape: Int[Array, "N"]
    seen: Int[Array, ""]


def _choose(best: _Best, candidate: Float[Array, "N"], better: Array) -> _Best:
    return _Best(
        jnp.where(better, candidate, best.distance),
        jnp.where(better, best.seen, best.shape),
        best.seen + 1,
    )


def _nearest(scene: Scene, p: Components) -> tuple[Float[Array, "N"], Int[Array, "N"]]:
    """Signed distance, and which shape of (carved, boxes, cylinders) in a row it belongs to.

    Inside a union of carved boxes the largest of their inner distances counts; around solids the least.
    """

    def widest(best: _Best, shape: Shapes) -> tuple[_Best, None]:
        candidate = _carved_distance(shape, p)
        return _choose(best, candidate, candidate > best.distance), None

    def least(of: Callable[[Shapes, Components], Array]) -> Callable[[_Best, Shapes], tuple[_Best, None]]:
        def step(best: _Best, shape: Shapes) -> tuple[_Best, None]:
            candidate = of(shape, p)
            return _choose(best, candidate, candidate < best.distance), None

        return step

    start = _Best(jnp.full(p.x.shape, -jnp.inf), jnp.zeros(p.x.shape, jnp.int32), jnp.int32(0))
    best, _ = jax.lax.scan(widest, start, scene.carved)
    best, _ = jax.lax.scan(least(_box_distance), best, scene.boxes)
    best, _ = jax.lax.scan(least(_cylinder_distance), best, scene.cylinders)
    return best.distance, best.shape


def _normals(shapes: Shapes, kind: Int[Array, "N"], points: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Unit gradient of the distance to one chosen shape per point, instead of to the whole scene."""
    carved = kind == 0
    soft = shapes._replace(
        half=shapes.half + jnp.where(carved, _SOFT_EDGE, 0.0)[:, None],
        rounding=jnp.where(carved, 0.0, jnp.maximum(shapes.rounding, _SOFT_EDGE)),
    )

    def of_one(shape: Shapes, which: Int[Array, ""], point: Float[Array, "3"]) -> Float[Array, ""]:
        p = components(point)
        box = _box_distance(shape, p)
        return jnp.where(which == 0, -box, jnp.where(which == 1, box, _cylinder_distance(shape, p)))

    gradient = jax.vmap(jax.grad(of_one, argnums=2))(soft, kind, points)
    norm = jnp.sqrt(jnp.sum(gradient**2, axis=-1, keepdims=True))
    return gradient / jnp.maximum(norm, _TINY_SQUARE)
