"""The neural field of one submap: truncated signed distance by classification, and colour.

All points are in the submap's frame, metres. The distance is positive in front of the surface.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from mipsjax.config.sections import FieldConfig
from mipsjax.core.encodings import Encoding, fields
from mipsjax.core.encodings.encoding import Parameters

Part = Literal["search", "whole"]


class Net(NamedTuple):
    """A multilayer perceptron, and what its encoding learns."""

    weights: tuple[Float[Array, "I O"], ...]
    biases: tuple[Float[Array, " O"], ...]
    table: Parameters
    """Of the encoding (`core/encodings`); None where that learns nothing, and of a network that shares another's."""


class Field(NamedTuple):
    """Parameters of a submap; the same shapes for every submap of one config."""

    smooth: Net | None
    """Distance on which poses are searched for; `core/encodings` says which fields there are."""
    fine: Net | None
    """The accurate distance; None where the smooth one is all that there is."""
    color: Net
    """Colour from what the finest distance is read from."""


class Tsdf(NamedTuple):
    """Prediction at N points."""

    psi: Float[Array, " N"]
    """Truncated signed distance, metres (Eq. 2)."""
    entropy: Float[Array, " N"]
    """Shannon entropy of the class distribution, nats; 1 everywhere where the distance is regressed."""
    logits: Float[Array, "N C"]
    """Logarithm of the class probabilities; C = 1, psi itself, where the distance is regressed."""


def class_values(cfg: FieldConfig) -> Float[np.ndarray, " C"]:
    """The distances the classes stand for, evenly over [-tau, tau]. Metres."""
    return np.linspace(-cfg.truncation, cfg.truncation, cfg.classes, dtype=np.float32)


def init(key: PRNGKeyArray, cfg: FieldConfig) -> Field:
    """Fresh parameters: He initialisation, encodings as they begin."""
    k_smooth, k_fine, k_color = jax.random.split(key, 3)
    has = fields(cfg)
    outputs = cfg.classes if cfg.classification else 1
    smooth = fine = None
    if has.smooth is not None:
        smooth = _init_net(k_smooth, (has.smooth.width(cfg), *cfg.hidden, outputs), has.smooth, cfg)
    if has.fine is not None:
        fine = _init_net(k_fine, (has.fine.width(cfg), *cfg.hash_hidden, outputs), has.fine, cfg)
    color = _init_net(k_color, (has.finest.width(cfg), *cfg.color_hidden, 3), None, cfg)
    return Field(smooth, fine, color)


def tsdf(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig, part: Part = "whole") -> Tsdf:
    """Distance and its uncertainty (Section 3.1 of the paper).

    `part="search"` is the smooth field where there are two; `whole` the most accurate one.
    """
    if part == "search" and fields(cfg).two:
        return smooth_tsdf(field, points, cfg)
    return decode_tsdf(field, encode(field, points, cfg), cfg)


def smooth_tsdf(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig) -> Tsdf:
    """Distance from the smooth field, where there is one."""
    encoding = fields(cfg).smooth
    assert encoding is not None and field.smooth is not None
    return classify(field.smooth, encoding.apply(field.smooth.table, points, cfg), cfg)


def color(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig) -> Float[Array, "N 3"]:
    """RGB in 0..1."""
    return decode_color(field, encode(field, points, cfg))


def encode(field: Field, points: Float[Array, "N 3"], cfg: FieldConfig) -> Float[Array, "N E"]:
    """What the finest distance and the colour are read from, to be computed once for both."""
    return fields(cfg).finest.apply(_finest(field).table, points, cfg)


def decode_tsdf(field: Field, encoded: Float[Array, "N E"], cfg: FieldConfig) -> Tsdf:
    """The finest distance from `encode`."""
    return classify(_finest(field), encoded, cfg)


def _finest(field: Field) -> Net:
    """The network of the most accurate distance."""
    net = field.smooth if field.fine is None else field.fine
    assert net is not None
    return net


def decode_color(field: Field, encoded: Float[Array, "N E"]) -> Float[Array, "N 3"]:
    """RGB in 0..1 from `encode`."""
    return jax.nn.sigmoid(_mlp(field.color, encoded))


def classify(net: Net, encoded: Float[Array, "N E"], cfg: FieldConfig) -> Tsdf:
    """Distance and uncertainty from encoded points (Eq. 2 and the entropy below it)."""
    z = _mlp(net, encoded)
    if not cfg.classification:
        # Bounded as the soft argmax is, so that the losses and the robust steps can stay the same
        psi = cfg.truncation * jnp.tanh(z[:, 0])
        return Tsdf(psi, jnp.ones_like(psi), psi[:, None])
    # Each by itself: numbers that sum to 1 saturate before the soft argmax (docs/method.md, b)
    z = jax.nn.sigmoid(z) if cfg.normalised else z
    # By the logarithm: the entropy stays finite where a probability is 0 in single precision
    log_p = jax.nn.log_softmax(cfg.coldness * z)
    p = jnp.exp(log_p)
    return Tsdf(p @ class_values(cfg), -jnp.sum(p * log_p, -1), log_p)


def is_certain(entropy: Float[Array, " N"], share: float, cfg: FieldConfig) -> Bool[Array, " N"]:
    """Entropy below a share of that of an even distribution; everywhere where the distance is regressed."""
    if not cfg.classification:
        return jnp.ones(entropy.shape, bool)
    # An even distribution, which is what space that was never observed has, has the entropy log C
    return entropy < share * np.log(cfg.classes)


def _init_net(key: PRNGKeyArray, widths: tuple[int, ...], encoding: Encoding | None, cfg: FieldConfig) -> Net:
    """Fresh layers between these widths. Without an encoding of its own, a network reads what another one does."""
    # The first key is drawn even where there is nothing to draw: an encoding moves no weights
    k_encoding, *k_layers = jax.random.split(key, len(widths))
    weights, biases = [], []
    for k, (inputs, outputs) in zip(k_layers, pairwise(widths), strict=True):
        weights.append(jax.random.normal(k, (inputs, outputs)) * np.float32(np.sqrt(2 / inputs)))
        biases.append(jnp.zeros(outputs))
    table = None if encoding is None else encoding.init(k_encoding, cfg)
    return Net(tuple(weights), tuple(biases), table)


def _mlp(net: Net, x: Float[Array, "N I"]) -> Float[Array, "N O"]:
    for w, b in zip(net.weights[:-1], net.biases[:-1], strict=True):
        x = jax.nn.relu(x @ w + b[None])
    return x @ net.weights[-1] + net.biases[-1][None]
