"""Arrays of a PyTorch state dict, saved as a plain ``.npz``, as the variables of our layers."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path

from jaxreg.io.arrays import read_arrays
from jaxreg.network.model import Variables

Arrays = Mapping[str, np.ndarray]
C = TypeVar("C")

_WRAPPER = "module."
"""What PyTorch's DataParallel writes before every name."""


def load(
    path: str | Path,
    whose: str,
    read: Callable[[Arrays], tuple[Variables, C]],
    init: Callable[[Any, C], Variables],
) -> tuple[Variables, C]:
    """What `read` makes of the arrays of a file; every array must have the shape that `init` gives it.

    `whose` is the name of the method in messages. Variables may lack what only the training uses.

    Raises:
      ValueError: the file is missing or not an ``.npz``, or an array is missing or has another shape.
    """
    remedy = f"give {whose}'s whole state dict"
    arrays = read_arrays(path, remedy=f"give the .npz of {whose}'s state dict")
    arrays = {name.removeprefix(_WRAPPER): array for name, array in arrays.items()}
    try:
        variables, config = read(arrays)
    except KeyError as error:
        raise ValueError(f"{path} has no array {error}: {remedy}.") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}: {remedy}.") from None
    fresh = jax.eval_shape(lambda: init(jax.random.key(0), config))
    for kind, networks in variables.items():
        for name in networks:
            expected, found = (_shapes(tree[kind][name]) for tree in (fresh, variables))
            for place, shape in expected.items():
                part = f"{kind}['{name}']{place}"
                if place not in found:
                    raise ValueError(f"{path} has no array for {part} of {whose}: {remedy}.")
                if found[place] != shape:
                    raise ValueError(
                        f"{path}: the array for {part} of {whose} has the shape {found[place]}, not "
                        f"{shape}: {remedy}."
                    )
    return variables, config


def _shapes(tree: Any) -> dict[str, tuple[int, ...]]:
    return {keystr(place): leaf.shape for place, leaf in tree_flatten_with_path(tree)[0]}


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


def count(arrays: Arrays, root: str, first: int = 0) -> int:
    """How many parts `root` has, which are numbered from `first` on; one where there are none."""
    found = (re.match(re.escape(root) + r"(\d+)\.", name) for name in arrays)
    return max((int(part[1]) for part in found if part), default=first) + 1 - first


def dense(arrays: Arrays, name: str) -> Variables:
    """A convolution of width 1 as a dense layer: weight (out, in, 1, ...) to kernel (in, out).

    Raises:
      ValueError: the weight has another shape.
    """
    weight = arrays[f"{name}.weight"]
    if weight.ndim < 2 or weight.shape[2:] != (1,) * (weight.ndim - 2):
        raise ValueError(f"'{name}.weight' has the shape {weight.shape}, not (out, in, 1, ...)")
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
