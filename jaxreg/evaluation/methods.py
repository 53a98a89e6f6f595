"""Every method by its name, and how it runs on a batch of pairs or on two clouds.

`choose` is the one way from a name to a method: evaluation and every benchmark go through it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxreg.batching import map_pairs
from jaxreg.config import Config, ModelConfig
from jaxreg.evaluation import baselines
from jaxreg.network.model import Variables
from jaxreg.peers import by_name, cemnet, dcp, fmr, idam, rpmnet
from jaxreg.peers.rienet import load_rienet
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.methods import refine
from jaxreg.refine.point_to_point import icp
from jaxreg.scans.pair import register
from jaxreg.search import load_features, register_global
from jaxreg.search.learned import Network
from jaxreg.types import Pair, PointCloud, RigidTransform
from jaxreg.weights.checkpoint import best_config, load_checkpoint
from jaxreg.weights.released import available_weights, load_pretrained

Batch = Callable[[Pair], RigidTransform]
"""From a batch of pairs (a leading axis on every array) to the stacked transforms; it must not read
the true ones in the batch."""

BatchRefinement = Callable[[Pair, RigidTransform], RigidTransform]
"""From a batch and given poses to better ones."""

AFTER_TRAINING = ("iterations", "n_inliers", "robust_rounds")
"""Fields of the model that cost nothing to change after training."""

_OWN = ("identity", "icp", "register", "register_global", "register_global_learned")


_LOADERS: dict[str, Callable[[str], tuple[Variables, Config]]] = {
    "weights": load_pretrained,
    "rienet": load_rienet,
    "dcp": dcp.load_weights,
    "cemnet": cemnet.load_weights,
    "idam": idam.load_weights,
    "rpmnet": rpmnet.load_weights,
    "fmr": fmr.load_weights,
    "checkpoint": load_checkpoint,
}


class Outcome(NamedTuple):
    """A pose (numpy) and, for a method that judges itself, whether and how far to trust it."""

    transform: RigidTransform
    success: bool | None = None
    probability: float | None = None


class Method(NamedTuple):
    """One method in its two forms: for a batch, and for two clouds (n, 3), (m, 3) in numpy."""

    batch: Batch
    clouds: Callable[[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]], Outcome]


def names() -> tuple[str, ...]:
    """The names that `choose` takes; FILE and DIR stand for a path."""
    released = tuple(f"weights:{name}" for name in available_weights())
    files = (f"{name}:FILE" for name in _LOADERS if name not in ("weights", "checkpoint"))
    return (*_OWN, *released, *files, "checkpoint:DIR", *baselines.NAMES)


def choose(name: str, *, model: ModelConfig | None = None) -> Method:
    """The method by its name, one of `names`.

    `identity` does nothing. From this library: `icp` (point to point, from where the clouds are),
    `register` (with all its defaults), `register_global`, and `register_global_learned` (the same
    with its released features). Trained networks: released weights, an NPZ file of the state dict
    of RIENet, DCP, CEMNet, IDAM, RPM-Net or FMR, the best checkpoint of a run; if `model` is given, its
    `AFTER_TRAINING` fields replace those of the training. The rest are other people's
    (`jaxreg.evaluation.baselines`), optionally with the spacing of the points, as in
    `open3d_fgr@0.02`.

    Raises:
      ValueError: an unknown name (the message lists the known ones), a file or weights that do not
        exist, or a library that is not installed.
    """
    match name:
        case "identity":
            return Method(identity_method, lambda x, y: Outcome(_IDENTITY))
        case "icp":
            return _traced(_plain_icp)
        case "register":
            return _host(_registered)
        case "register_global":
            return _traced(_global(None))
        case "register_global_learned":
            return _traced(_global(load_features()))
    if is_network(name):
        return _network(*load_network_of(name), model)
    if name.partition("@")[0] in baselines.NAMES:
        function = baselines.choose(name)
        return _host(lambda x, y: Outcome(function(x, y)))
    raise ValueError(f"no method '{name}': choose one of {', '.join(names())}.")


def load_network_of(name: str) -> tuple[Variables, Config]:
    """Variables and configuration of `weights:NAME`, `checkpoint:DIR`, or `rienet:FILE` and the like.

    Raises:
      ValueError: there are no such weights, file or checkpoint.
    """
    kind, _, place = name.partition(":")
    return _LOADERS[kind](place)


def trained_config(name: str) -> Config | None:
    """The configuration that a network was trained with, by its name; None if it is not a network.

    Raises what `load_network_of` raises. The arrays of a checkpoint are not read.
    """
    if not is_network(name):
        return None
    kind, _, place = name.partition(":")
    return best_config(place)[0] if kind == "checkpoint" else load_network_of(name)[1]


def is_network(name: str) -> bool:
    """Whether a name is that of weights, of a file of them, or of a run; nothing is read."""
    kind, colon, place = name.partition(":")
    return kind in _LOADERS and bool(colon and place)


def _register_batch(
    variables: Variables, pair: Pair, *, config: Config, padded: bool
) -> RigidTransform:
    def one(source: PointCloud, reference: PointCloud) -> RigidTransform:
        if not padded:
            source, reference = (
                PointCloud(points, jnp.ones(points.shape[0], bool))
                for points in (source.points, reference.points)
            )
        return by_name.pose(variables, source, reference, config=config)

    return map_pairs(one)(pair.source, pair.reference)


_register_batch_jit = jax.jit(_register_batch, static_argnames=("config", "padded"))


def network_method(variables: Variables, config: Config | ModelConfig) -> Batch:
    """The trained network. A batch without padding runs a separate program, a quarter faster."""
    whole = config if isinstance(config, Config) else Config(model=config)

    def method(pair: Pair) -> RigidTransform:
        padded = not all(np.all(cloud.mask) for cloud in (pair.source, pair.reference))
        return _register_batch_jit(variables, pair, config=whole, padded=padded)

    return method


def _network(variables: Variables, trained: Config, model: ModelConfig | None) -> Method:
    config = Config(network=trained.network, **_settings(trained, model))
    one = jax.jit(lambda x, y: by_name.pose(variables, x, y, config=config))
    return Method(network_method(variables, config), _of_clouds(one))


def _settings(trained: Config, model: ModelConfig | None) -> dict[str, Any]:
    """The section that sets up the network; the rest of a configuration would compile it anew."""
    if trained.network != "paper":
        return {trained.network: getattr(trained, trained.network)}
    chosen = {} if model is None else {name: getattr(model, name) for name in AFTER_TRAINING}
    return {"model": dataclasses.replace(trained.model, **chosen)}


_IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


def identity_method(pair: Pair) -> RigidTransform:
    """Do nothing: the row that every method must beat."""
    batch = pair.source.mask.shape[0]
    return RigidTransform(np.tile(np.eye(3), (batch, 1, 1)), np.zeros((batch, 3)))


def _plain_icp(source: PointCloud, reference: PointCloud) -> RigidTransform:
    config = RefineConfig("icp", iterations=50, kernel="none")
    return icp(
        source.points,
        reference.points,
        source_mask=source.mask,
        reference_mask=reference.mask,
        config=config,
    ).transform


def _global(network: Network | None) -> Callable[[PointCloud, PointCloud], RigidTransform]:
    def one(source: PointCloud, reference: PointCloud) -> RigidTransform:
        return register_global(
            source.points,
            reference.points,
            source_mask=source.mask,
            reference_mask=reference.mask,
            network=network,
        ).transform

    return one


def _registered(source: np.ndarray, reference: np.ndarray) -> Outcome:
    found = register(source, reference)
    return Outcome(found.transform, found.success, found.probability)


def _traced(one: Callable[[PointCloud, PointCloud], RigidTransform]) -> Method:
    """Both forms of a pure function of two clouds with masks."""
    many = jax.jit(map_pairs(one))
    return Method(lambda pair: many(pair.source, pair.reference), _of_clouds(jax.jit(one)))


def _of_clouds(one: Callable) -> Callable[[np.ndarray, np.ndarray], Outcome]:
    def clouds(source: np.ndarray, reference: np.ndarray) -> Outcome:
        whole = (
            PointCloud(jnp.asarray(points), jnp.ones(len(points), bool))
            for points in (source, reference)
        )
        return Outcome(jax.tree.map(np.asarray, one(*whole)))

    return clouds


def _host(clouds: Callable[[np.ndarray, np.ndarray], Outcome]) -> Method:
    return Method(host_method(lambda x, y: clouds(x, y).transform), clouds)


def refined_method(method: Batch, refine: BatchRefinement) -> Batch:
    """`method`, then a refinement of its poses (both clouds, nothing learned)."""
    return lambda pair: refine(pair, method(pair))


def refinement(config: RefineConfig) -> BatchRefinement:
    """The ICP family from given poses of a batch."""

    def one(source, reference, initial):
        masks = {"source_mask": source.mask, "reference_mask": reference.mask}
        refined = refine(source.points, reference.points, initial=initial, config=config, **masks)
        return refined.transform

    refine_batch = jax.jit(map_pairs(one))
    return lambda pair, initial: refine_batch(pair.source, pair.reference, initial)


def host_method(
    register: Callable[[np.ndarray, np.ndarray], RigidTransform],
) -> Batch:
    """A method from a function of two numpy clouds (n, 3), (m, 3), called pair by pair."""

    def method(pair: Pair) -> RigidTransform:
        source, reference = jax.tree.map(np.asarray, (pair.source, pair.reference))
        transforms = [
            register(source.points[i][source.mask[i]], reference.points[i][reference.mask[i]])
            for i in range(len(source.mask))
        ]
        return jax.tree.map(lambda *parts: np.stack(parts), *transforms)

    return method
