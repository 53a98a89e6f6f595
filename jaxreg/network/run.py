"""One of the networks of a method, applied with its own part of the variables."""

from typing import Any

import jax

from jaxreg.network.features import BATCH_AXIS

Variables = dict[str, Any]


def run_network(
    module: Any, name: str, variables: Variables, *inputs: Any, train: bool
) -> tuple[Any, Variables]:
    """Apply a network; returns its output and `variables` with the statistics it updated.

    Raises:
      ValueError: `variables` are those of another network, or `train` without the `vmap` axis
        `features.BATCH_AXIS`, over which it takes the statistics.
    """
    if lacking := [kind for kind, tree in variables.items() if name not in tree]:
        raise ValueError(
            f"variables have no '{name}' in {lacking[0]}, so they are those of another network than "
            "config's: give both as jaxreg.load_pretrained returns them."
        )
    own = {kind: tree[name] for kind, tree in variables.items()}
    if not train:
        return module.apply(own, *inputs, train=False), variables
    try:
        jax.lax.axis_index(BATCH_AXIS)
    except NameError:
        raise ValueError(
            "training takes the statistics of a batch: call it under jax.vmap(..., "
            f"axis_name={BATCH_AXIS!r})."
        ) from None
    output, updated = module.apply(own, *inputs, train=True, mutable=["batch_stats"])
    statistics = variables["batch_stats"] | {name: updated["batch_stats"]}
    return output, variables | {"batch_stats": statistics}
