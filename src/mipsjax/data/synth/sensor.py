"""A depth camera's errors, for exact rendered images: noise, quantisation, missing pixels, colour noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from mipsjax.core.camera import Intrinsics, rays


class SensorModel(NamedTuple):
    """Errors of a structured-light depth camera and of its colour camera."""

    noise_floor: float = 0.0012
    """Standard deviation of depth at `noise_from`, metres. With the next two fields, the axial noise measured
    for the first Kinect by Nguyen, Izadi and Lovell (3DIMPVT 2012)."""
    noise_growth: float = 0.0019
    """Growth of the standard deviation with the square of the range beyond `noise_from`, 1/metres."""
    noise_from: float = 0.4
    """Metres."""
    disparity_step: float = 0.0029
    """Quantisation of inverse depth, 1/metres: 1/8 pixel over a focal length of 580 pixels and 7.5 cm."""
    jitter_px: float = 0.4
    """Standard deviation of where on the image a depth pixel looks, pixels."""
    range_min: float = 0.4
    """Metres; nearer surfaces are not measured."""
    range_max: float = 6.0
    """Metres; farther surfaces are not measured."""
    edge_step: float = 0.04
    """Relative step in depth from which a pixel counts as lying at an edge."""
    edge_loss: float = 0.55
    """Share of pixels lost at an edge."""
    grazing_deg: tuple[float, float] = (70.0, 86.0)
    """Angles of incidence from which pixels begin to be lost, and at which all are lost."""
    color_sigma: float = 2.0
    """Standard deviation of colour noise, in 8-bit values."""
    exposure_sigma: float = 0.01
    """Relative standard deviation of a frame's exposure."""


def depth_sigma(model: SensorModel, depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Standard deviation in metres of the axial noise at a depth in metres, before quantisation."""
    return model.noise_floor + model.noise_growth * (depth - model.noise_from) ** 2


def measured_depth(
    model: SensorModel, depth: Float32[np.ndarray, "H W"], intrinsics: Intrinsics, rng: np.random.Generator
) -> Float32[np.ndarray, "H W"]:
    """What the camera reports for an exact depth image in metres; 0 where it reports nothing."""
    lost = rng.random(depth.shape) < _loss(model, depth, intrinsics)
    seen = _jittered(model, depth, rng)
    out_of_range = (seen < model.range_min) | (seen > model.range_max)
    noisy = seen + depth_sigma(model, seen) * rng.standard_normal(depth.shape)
    # Noise may lead to the lens and behind it, where depth has no inverse
    inverse = np.round(1.0 / np.maximum(noisy, model.noise_floor) / model.disparity_step)
    # A disparity of 0 would be infinitely far
    reported = 1.0 / (model.disparity_step * np.maximum(inverse, 1.0))
    return np.where(lost | out_of_range, 0.0, reported).astype(np.float32)


def measured_color(
    model: SensorModel, color: UInt8[np.ndarray, "H W 3"], rng: np.random.Generator
) -> UInt8[np.ndarray, "H W 3"]:
    """The colour image with noise, at a slightly wrong exposure."""
    gain = 1.0 + model.exposure_sigma * rng.standard_normal()
    noisy = gain * color + model.color_sigma * rng.standard_normal(color.shape)
    return np.clip(np.round(noisy), 0.0, 255.0).astype(np.uint8)


def _jittered(
    model: SensorModel, depth: Float32[np.ndarray, "H W"], rng: np.random.Generator
) -> Float32[np.ndarray, "H W"]:
    """Depth at pixels picked up to a few pixels aside."""
    height, width = depth.shape
    v, u = np.mgrid[:height, :width] + model.jitter_px * rng.standard_normal((2, height, width))
    rows = np.clip(np.round(v), 0, height - 1).astype(np.intp)
    columns = np.clip(np.round(u), 0, width - 1).astype(np.intp)
    return depth[rows, columns]


def _loss(
    model: SensorModel, depth: Float32[np.ndarray, "H W"], intrinsics: Intrinsics
) -> Float[np.ndarray, "H W"]:
    """Probability that a pixel is lost."""
    begin, end = np.radians(model.grazing_deg)
    grazing = np.clip((incidence(depth, intrinsics) - begin) / (end - begin), 0.0, 1.0)
    return np.maximum(grazing, model.edge_loss * _at_edge(model, depth))


def _at_edge(model: SensorModel, depth: Float32[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Where inverse depth bends: on a plane it is linear over the image, however slanted."""
    inverse = np.pad(1.0 / depth, 1, mode="edge")
    bends = np.diff(inverse, n=2, axis=0)[:, 1:-1], np.diff(inverse, n=2, axis=1)[1:-1]
    # Times depth: relative, so that a step counts alike close by and far away
    return np.maximum(np.abs(bends[0]), np.abs(bends[1])) * depth > model.edge_step


def incidence(depth: Float32[np.ndarray, "H W"], intrinsics: Intrinsics) -> Float[np.ndarray, "H W"]:
    """Angle in radians between the line of sight and the surface's normal, from the neighbouring pixels.

    Of the neighbours on both sides the nearer in depth counts, so that a normal does not bridge an edge.
    """
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    sight = rays(v, u, intrinsics)
    points = sight * depth[..., None]
    normal = np.cross(_tangent(points, axis=1), _tangent(points, axis=0))
    lengths = np.linalg.norm(normal, axis=-1) * np.linalg.norm(sight, axis=-1)
    cosine = np.abs(np.sum(normal * sight, axis=-1)) / np.maximum(lengths, np.finfo(np.float32).tiny)
    return np.arccos(np.clip(cosine, 0.0, 1.0))


def _tangent(points: Float[np.ndarray, "H W 3"], axis: int) -> Float[np.ndarray, "H W 3"]:
    """Difference to the next or to the previous pixel along an axis, whichever is smaller in depth."""
    steps = np.diff(points, axis=axis)
    first, last = np.take(steps, [0], axis=axis), np.take(steps, [-1], axis=axis)
    # The last pixel has no next one and the first none before: the step on the other side counts
    ahead, behind = np.concatenate([steps, last], axis=axis), np.concatenate([first, steps], axis=axis)
    return np.where(np.abs(ahead[..., 2:]) < np.abs(behind[..., 2:]), ahead, behind)
