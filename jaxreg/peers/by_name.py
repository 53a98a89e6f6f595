"""The network that a configuration names, the paper's or a peer: its start, its pose, its loss."""

from types import ModuleType
from typing import Any

import jax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxreg.config import Config
from jaxreg.network import model
from jaxreg.network.model import Variables
from jaxreg.peers import cemnet, dcp, fmr, idam, rpmnet
from jaxreg.types import PointCloud, Registration, RigidTransform

_PEERS: dict[str, ModuleType] = {
    "dcp": dcp, "cemnet": cemnet, "idam": idam, "rpmnet": rpmnet, "fmr": fmr,
}  # fmt: skip
TRAINED = ("paper", "idam", "rpmnet", "fmr")
"""The networks that `train` trains; of the others there are weights of their authors."""
_TRAINING_ONLY = {"fmr": "decoder"}
"""Parts of `params` that a registration does not use, and which would be most of a file of weights."""


def init_variables(key: PRNGKeyArray, config: Config) -> Variables:
    """Random initial `params` and `batch_stats`."""
    if config.network == "paper":
        return model.init_variables(key, config.model)
    return _PEERS[config.network].init_variables(key, getattr(config, config.network))


def for_registration(variables: Variables, config: Config) -> Variables:
    """`variables` without what only the training uses."""
    left_out = _TRAINING_ONLY.get(config.network)
    return variables | {"params": {k: x for k, x in variables["params"].items() if k != left_out}}


def for_training(variables: Variables, fresh: Variables, config: Config) -> Variables:
    """`variables` with what a file of them lacks, from `fresh` ones.

    That is what only the training uses, and empty parts, such as the statistics of a network without
    BatchNorm.
    """
    part = _TRAINING_ONLY.get(config.network)
    lacks = part in fresh["params"] and part not in variables["params"]
    added = {part: fresh["params"][part]} if lacks else {}
    empty = {name: tree for name, tree in fresh.items() if not jax.tree.leaves(tree)}
    return empty | variables | {"params": variables["params"] | added}


def register(
    variables: Variables,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    config: Config,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
) -> Registration:
    """`jaxreg.register_pair`, or the `register` of a peer."""
    own = config.network == "paper"
    function = model.register_pair if own else _PEERS[config.network].register
    return function(
        variables, source, reference, config=config,
        source_mask=source_mask, reference_mask=reference_mask,
    )  # fmt: skip


def pose(
    variables: Variables, source: PointCloud, reference: PointCloud, *, config: Config
) -> RigidTransform:
    """The transform from source to reference."""
    if config.network == "paper":
        return model.iterate(variables, source, reference, config=config.model)[0]
    return register(
        variables, source.points, reference.points, config=config,
        source_mask=source.mask, reference_mask=reference.mask,
    ).transform  # fmt: skip


def loss(
    variables: Variables,
    source: PointCloud,
    reference: PointCloud,
    truth: RigidTransform,
    *,
    config: Config,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]], Any]:
    """The loss of a peer on a pair, its terms, and the variables with updated statistics."""
    settings = getattr(config, config.network)
    peer = _PEERS[config.network]
    return peer.loss(variables, source, reference, truth, config=settings)
