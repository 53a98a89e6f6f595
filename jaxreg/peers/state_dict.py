"""Arrays of a PyTorch state dict, saved as a plain ``.npz``, as the variables of our layers."""

from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np

from jaxreg.network.model import Variables

Arrays = Mapping[str, np.ndarray]


def joined(networks: Mapping[str, Variables]) -> Variables:
    """``{"params": {name: ...}, "batch_stats": {name: ...}}`` of the networks by their names."""
    return {
        kind: {name: tree[kind] for name, tree in networks.items()}
        for kind in ("params", "batch_stats")
    }


def dgcnn(arrays: Arrays, root: str, layers: int) -> Variables:
    """The `DGCNN` whose layers are `root`conv1, `root`bn1, and so on."""
    return dense_and_norm(
        arrays, [(f"{root}conv{i}", f"{root}bn{i}") for i in range(1, layers + 1)]
    )


def dense_and_norm(
    arrays: Arrays, layers: Sequence[tuple[str, str]], last: str | None = None
) -> Variables:
    """Dense layers, each with its BatchNorm, and one at the end without, in Flax's order."""
    params, statistics = {}, {}
    for i, (linear, norm) in enumerate(layers):
        params[f"Dense_{i}"] = dense(arrays, linear)
        batch_norm(arrays, norm, f"BatchNorm_{i}", params, statistics)
    if last is not None:
        params[f"Dense_{len(layers)}"] = dense(arrays, last)
    return {"params": params, "batch_stats": statistics}


def dense(arrays: Arrays, name: str) -> Variables:
    """A convolution of width 1 as a dense layer: weight (out, in, 1, ...) to kernel (in, out)."""
    weight = arrays[f"{name}.weight"]
    layer = {"kernel": jnp.asarray(weight.reshape(weight.shape[:2]).T)}
    if f"{name}.bias" in arrays:
        layer["bias"] = jnp.asarray(arrays[f"{name}.bias"])
    return layer


def batch_norm(
    arrays: Arrays, name: str, ours: str, params: Variables, statistics: Variables
) -> None:
    """Adds a BatchNorm to `params` and `statistics`, in place; both nest one module in another."""
    scale, bias, mean, var = (
        jnp.asarray(arrays[f"{name}.{part}"])
        for part in ("weight", "bias", "running_mean", "running_var")
    )
    params[ours] = {"BatchNorm_0": {"scale": scale, "bias": bias}}
    statistics[ours] = {"BatchNorm_0": {"mean": mean, "var": var}}
