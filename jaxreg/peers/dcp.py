"""Deep Closest Point, version 1 (Wang and Solomon, ICCV 2019): one soft assignment, one Procrustes.

Every point of the source is compared with every point of the reference; nothing is left out. So it
needs full overlap, and the authors' weights know clouds of the same points only.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxreg._xla import on_any_mesh
from jaxreg.config import Config, DCPConfig
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.network.features import DGCNN
from jaxreg.network.model import Variables
from jaxreg.peers import pair, state_dict
from jaxreg.types import PointCloud, Registration

_BN_MOMENTUM = 0.9


@on_any_mesh
def register(
    variables: Variables,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    config: Config | DCPConfig,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
) -> Registration:
    """Register two clouds with DCP v1; pure: jit, vmap and differentiate it.

    ``m(x_i) = softmax_j(F_x[i] . F_y[j] / sqrt(width))``, ``y_i = sum_j m(x_i)[j] y[j]``, and R, t of
    least ``sum_i |R x_i + t - y_i|^2``: a cropped or noisy cloud is beyond it. `correspondences` are
    the ``y_i``; `confidence` is 1 for every valid point, since the method trusts all alike.

    Clouds should be in the unit sphere. Padding and empty clouds are as in `jaxreg.register_pair`.

    Raises:
      ValueError: a cloud is not ``(n, 3)`` of float32 or float64; a mask is not ``(n,)`` of bools; a
        cloud has fewer than `config.k` points; `config` is not that of DCP.
    """
    config = pair.settings(config, "dcp", DCPConfig)
    moving, fixed = pair.clouds(source, reference, source_mask, reference_mask)
    variables = pair.in_dtype(variables, moving.points.dtype)
    embeddings = [embedding(variables, cloud, config=config) for cloud in (moving, fixed)]
    copy = soft_pointer(embeddings[0], embeddings[1], fixed)
    weights = jnp.asarray(moving.mask & jnp.any(fixed.mask), copy.dtype)
    transform = weighted_procrustes(moving.points, copy, weights)
    return pair.registration(transform, moving, fixed, jnp.ones_like(weights), copy)


def init_variables(key: PRNGKeyArray, config: DCPConfig) -> Variables:
    """Random initial `params` and `batch_stats`."""
    edges, mask = jnp.ones((1, config.k, 6), jnp.float32), jnp.ones(1, bool)
    found = _network(config).init(key, edges, mask, train=False)
    return state_dict.joined({"features": found})


def embedding(
    variables: Variables, cloud: PointCloud, *, config: DCPConfig
) -> Float[Array, "n width"]:
    """F of a cloud: a DGCNN over the edges ``(x_j, x_i)``, absolute, so that every motion changes it.

    Raises:
      ValueError: the cloud has fewer than `config.k` points.
    """
    own = {kind: tree["features"] for kind, tree in variables.items()}
    edges = pair.absolute_edges(cloud, config.k)
    return _network(config).apply(own, edges, cloud.mask, train=False)


def soft_pointer(
    source: Float[Array, "n c"], reference: Float[Array, "m c"], cloud: PointCloud
) -> Float[Array, "n 3"]:
    """Where the source's points point to in the reference: the mean of `cloud` by the softmax."""
    product = jnp.matmul(source, reference.T, precision=Precision.HIGHEST)
    scores = pair.row_softmax(product / jnp.sqrt(source.shape[1]).astype(product.dtype), cloud.mask)
    return pair.soft_copy(scores, cloud)


def _network(config: DCPConfig) -> Any:
    return DGCNN(config.channels, config.width, _BN_MOMENTUM)


def load_weights(path: str | Path) -> tuple[Variables, Config]:
    """Load DCP v1's published weights, an ``.npz`` of its state dict; PyTorch is not needed.

    Raises:
      ValueError: the file is missing or not an ``.npz``, or an array of the network is missing or has
        another shape.
    """

    def read(arrays: state_dict.Arrays) -> tuple[Variables, DCPConfig]:
        features = state_dict.dgcnn(arrays, "emb_nn.", layers=5)
        return state_dict.joined({"features": features}), DCPConfig()

    variables, config = state_dict.load(path, "DCP", read, init_variables)
    return variables, Config(network="dcp", dcp=config)
