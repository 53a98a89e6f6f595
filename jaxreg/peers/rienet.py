"""RIENet's published weights (AAAI 2022), the single-neighbourhood predecessor, as our variables.

The file is a plain ``.npz`` of the arrays of its PyTorch state dict under their own names; no torch
is needed to read it.
"""

from collections.abc import Mapping
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxreg.config import Config, LossConfig, ModelConfig
from jaxreg.network.model import Variables, init_variables
from jaxreg.peers import state_dict

_MODEL = ModelConfig(
    k=4,  # Its k = 5 counts the point itself; its neighbourhood sum leaves it out again.
    k_matching=4,
    include_self=True,
    channels=(32, 32, 64, 128),
    width=256,
    alpha=0.7,
    one_nn="none",
    edge="vector",
    angles="none",
    inlier_network="rienet",
    inlier_width=8,
    n_inliers=256,
    svd="all",
    iterations=3,
)
_LOSS = LossConfig(rho=0.0, l_in="squared", l_sc="F")


def load_rienet(path: str | Path) -> tuple[Variables, Config]:
    """Load RIENet's published weights for ModelNet40: their variables and their configuration.

    Raises:
      ValueError: the file is missing or not an ``.npz``, or an array of the network is missing or has
        another shape.
    """

    def read(arrays: state_dict.Arrays) -> tuple[Variables, ModelConfig]:
        features = state_dict.dgcnn(arrays, "emb_nn.model.", layers=5)
        return state_dict.joined({"features": features, "inliers": _inliers(arrays)}), _MODEL

    variables, config = state_dict.load(path, "RIENet", read, init_variables)
    return variables, Config(model=config, loss=_LOSS)


def _inliers(arrays: Mapping[str, np.ndarray]) -> Variables:
    root, params, statistics = "forwards.weight_function.model", {}, {}
    # Each layer of its sequences is (linear map, BatchNorm, activation), hence the steps of three.
    for i, layer in enumerate(("1.0", "1.3")):
        params[f"Conv_{i}"] = _convolution(arrays, root + layer)
    # Flax numbers the last layer before the one it is applied to.
    for i, layer in enumerate(("2.0", "2.3", "3.0", "3.3", "4.3", "4.0")):
        params[f"Dense_{i}"] = state_dict.dense(arrays, root + layer)
    for i, layer in enumerate(("1.1", "1.4", "2.1", "2.4", "3.1", "3.4", "4.1")):
        state_dict.batch_norm(arrays, root + layer, f"BatchNorm_{i}", params, statistics)
    return {"params": params, "batch_stats": statistics}


def _convolution(arrays: Mapping[str, np.ndarray], name: str) -> Variables:
    """A convolution along the neighbours: weight (out, in, 3, 1) to kernel (3, in, out)."""
    kernel = arrays[f"{name}.weight"][..., 0].transpose(2, 1, 0)
    return {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(arrays[f"{name}.bias"])}
