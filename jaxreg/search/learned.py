"""Learned features: the moments of a point, passed along the surface around it.

They are invariant to rigid motion like the moments, because only these, lengths and cosines enter.
Trained on pairs of procedural shapes by `python -m research.train_features`.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxreg.geometry.neighbors import knn, without_padding
from jaxreg.geometry.numerics import safe_norm
from jaxreg.search.config import FeatureConfig, SearchConfig
from jaxreg.search.descriptors import INVARIANTS, NORMAL_RADIUS, OPENNESS_RADIUS
from jaxreg.weights.released import load_arrays

Network = Mapping[str, Float[Array, "..."] | Float[np.ndarray, "..."]]
"""A matrix for every layer, and its bias under the same name with "_bias"."""

_DEFAULT = SearchConfig()
_WIDTH = 64
_NEIGHBORS = 64
"""Neighbours of a point: the nearest 16 pass the first messages, every fourth the second."""
_ROUNDS = (("near", slice(0, 16), 0.15), ("far", slice(3, None, 4), 0.3))
_EDGE = 4


def init_network(key: PRNGKeyArray, inputs: int = len(_DEFAULT.radii) * INVARIANTS) -> Network:
    """Random weights of `learned_features` for that many moments per point, Glorot uniform."""
    sizes = {"lift": (inputs + 1, _WIDTH), "last": (_WIDTH, _WIDTH)}
    for name, _, _ in _ROUNDS:
        sizes |= {
            f"{name}_edge": (_EDGE, _WIDTH),
            f"{name}_there": (_WIDTH, _WIDTH),
            f"{name}_here": (_WIDTH, _WIDTH),
            f"{name}_pool": (2 * _WIDTH, _WIDTH),
            f"{name}_add": (_WIDTH, _WIDTH),
        }
    keys = jax.random.split(key, len(sizes))
    draw = jax.nn.initializers.glorot_uniform()
    weights = {
        name: draw(k, size, jnp.float32)
        for k, (name, size) in zip(keys, sizes.items(), strict=True)
    }
    return weights | {
        f"{name}_bias": jnp.zeros(size[1], jnp.float32) for name, size in sizes.items()
    }


def feature_config(config: SearchConfig = _DEFAULT) -> FeatureConfig:
    """What a network is trained on for this search."""
    return FeatureConfig(config.radii, NORMAL_RADIUS, OPENNESS_RADIUS)


def load_features(name: str = "features", *, config: SearchConfig = _DEFAULT) -> Network:
    """Load the weights (numpy arrays) of a feature network, for the `network` of `register_global`.

    `name` is that of released weights, or the path of your own without a suffix.

    Raises:
      ValueError: there are no such weights, they are not those of a feature network, or they were
        trained for a search with other descriptors than that of `config`.
    """
    network, card = load_arrays(name)
    trained = card["config"]
    for field, value in dataclasses.asdict(feature_config(config)).items():
        if field not in trained:
            raise ValueError(
                f"the weights '{name}' are not those of a feature network: their card says "
                f"nothing about {field}. The released ones are called 'features'."
            )
        if not np.array_equal(trained[field], value):
            raise ValueError(
                f"the weights '{name}' were trained with {field} = {trained[field]}, but this search "
                f"has {value}: set it as in training, or train others (research/train_features.py)."
            )
    check_network(network, len(config.radii) * INVARIANTS)
    return network


def check_network(network: Network, inputs: int) -> None:
    """Raise ValueError unless `network` takes `inputs` moments per point."""
    expected = jax.eval_shape(lambda: init_network(jax.random.key(0), inputs))
    for name, weights in expected.items():
        if name not in network:
            raise ValueError(
                f"the network has no weights '{name}': take them from load_features()."
            )
        if network[name].shape != weights.shape:
            raise ValueError(
                f"the weights '{name}' of the network have shape {network[name].shape}, but need "
                f"{weights.shape} for {inputs} moments per point: choose as many radii in "
                "SearchConfig as the network was trained with."
            )


def learned_features(
    network: Network,
    moments: Float[Array, "n d"],
    openness: Float[Array, "n"],
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    mask: Bool[Array, "n"] | None = None,
) -> Float[Array, "n c"]:
    """Features of length 1, whose cosines measure how alike two points and their surroundings are.

    `moments` are those of `standardized`. Two rounds of messages over edges (i, j) follow, to the 16
    nearest points and to 16 of the 64 nearest: ``h_i += A gelu(B [max_j m_ij, mean_j m_ij])`` with
    ``m_ij = gelu(E e_ij + T h_j + H h_i)``, where ``e_ij`` holds the length of the edge and the
    absolute cosines between it, the normal there and the normal here (normals have no sign).
    """
    points = without_padding(points, mask)
    inputs = [moments * moments.shape[1] ** 0.5, 4 * openness[:, None]]
    hidden = jax.nn.gelu(_layer(network, "lift", jnp.concatenate(inputs, axis=1)))
    graph = knn(points, min(_NEIGHBORS, len(points) - 1), mask)
    for name, chosen, radius in _ROUNDS:
        neighbors = graph[:, chosen] if graph.shape[1] > 3 else graph  # a cloud of four points
        edges = _edge_invariants(points, normals, neighbors, radius)
        there = _layer(network, f"{name}_there", hidden)[neighbors]
        here = _layer(network, f"{name}_here", hidden)[:, None]
        messages = jax.nn.gelu(_layer(network, f"{name}_edge", edges) + there + here)
        pooled = jnp.concatenate([jnp.max(messages, axis=1), jnp.mean(messages, axis=1)], axis=1)
        pooled = jax.nn.gelu(_layer(network, f"{name}_pool", pooled))
        hidden = hidden + _layer(network, f"{name}_add", pooled)
    found = _layer(network, "last", jax.nn.gelu(hidden))
    found = found / jnp.maximum(safe_norm(found), 1e-6)[:, None]
    return found if mask is None else jnp.where(mask[:, None], found, 0)


def _layer(network: Network, name: str, x: Float[Array, "*n i"]) -> Float[Array, "*n o"]:
    bias = jnp.asarray(network[f"{name}_bias"], x.dtype)
    weights = jnp.asarray(network[name], x.dtype)
    product = jnp.matmul(x, weights, precision=Precision.HIGHEST)
    return product + jnp.expand_dims(bias, range(product.ndim - 1))


def _edge_invariants(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    neighbors: Int[Array, "n k"],
    radius: float,
) -> Float[Array, "n k 4"]:
    offset = points[neighbors] - points[:, None]
    length = safe_norm(offset)
    direction = offset / jnp.maximum(length, 1e-6)[..., None]
    here, there = normals[:, None], normals[neighbors]
    pairs = ((here, direction), (there, direction), (here, there))
    cosines = [jnp.abs(jnp.sum(a * b, axis=-1)) for a, b in pairs]
    return jnp.stack([length / radius, *cosines], axis=-1)
