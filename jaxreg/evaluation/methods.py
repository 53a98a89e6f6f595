"""Every method that can be scored, by its name: one function from a batch of pairs to transforms."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxreg._xla import jit
from jaxreg.batching import map_pairs
from jaxreg.config import ModelConfig
from jaxreg.evaluation import baselines, methods
from jaxreg.network.model import Variables, iterate
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.methods import refine
from jaxreg.scans.pair import register
from jaxreg.search import load_features, register_global
from jaxreg.search.learned import Network
from jaxreg.types import Pair, PointCloud, RigidTransform

Method = Callable[[Pair], RigidTransform]


Refinement = Callable[[Pair, RigidTransform], RigidTransform]
"""Better poses of a batch from given ones."""


def _register_batch(
    variables: Variables, pair: Pair, *, config: ModelConfig, padded: bool
) -> RigidTransform:
    def one(source: PointCloud, reference: PointCloud) -> RigidTransform:
        if not padded:
            source, reference = (
                PointCloud(points, jnp.ones(points.shape[0], bool))
                for points in (source.points, reference.points)
            )
        return iterate(variables, source, reference, config=config)[0]

    return map_pairs(one)(pair.source, pair.reference)


_register_batch_jit = jit(_register_batch, static_argnames=("config", "padded"))


def network_method(variables: Variables, config: ModelConfig) -> Method:
    """The trained network. A batch without padding runs a program of its own, a quarter quicker."""

    def method(pair: Pair) -> RigidTransform:
        padded = not all(np.all(cloud.mask) for cloud in (pair.source, pair.reference))
        return _register_batch_jit(variables, pair, config=config, padded=padded)

    return method


def identity_method(pair: Pair) -> RigidTransform:
    """Doing nothing: the row that every method must beat."""
    batch = pair.source.mask.shape[0]
    return RigidTransform(np.tile(np.eye(3), (batch, 1, 1)), np.zeros((batch, 3)))


@jit
def icp_method(pair: Pair) -> RigidTransform:
    """Plain point-to-point ICP of this library from the identity."""
    config = RefineConfig("icp", iterations=50, kernel="none")

    def one(source, reference):
        masks = {"source_mask": source.mask, "reference_mask": reference.mask}
        return refine(source.points, reference.points, config=config, **masks).transform

    return map_pairs(one)(pair.source, pair.reference)


def global_method(network: Network | None = None) -> Method:
    """`register_global` of this library, from any start; with the features of `network`."""

    def one(source, reference):
        masks = {"source_mask": source.mask, "reference_mask": reference.mask}
        found = register_global(source.points, reference.points, network=network, **masks)
        return RigidTransform(found.rotation, found.translation)

    register_batch = jit(map_pairs(one))
    return lambda pair: register_batch(pair.source, pair.reference)


def refined_method(method: Method, refine: Refinement) -> Method:
    """`method`, then a refinement of its poses (both clouds, nothing learned)."""
    return lambda pair: refine(pair, method(pair))


def refinement(config: RefineConfig) -> Refinement:
    """The ICP family from given poses of a batch."""

    def one(source, reference, initial):
        masks = {"source_mask": source.mask, "reference_mask": reference.mask}
        refined = refine(source.points, reference.points, initial=initial, config=config, **masks)
        return refined.transform

    refine_batch = jit(map_pairs(one))
    return lambda pair, initial: refine_batch(pair.source, pair.reference, initial)


def host_method(
    register: Callable[[np.ndarray, np.ndarray], RigidTransform],
) -> Method:
    """A method from a function of two numpy clouds (n, 3), (m, 3), called pair by pair."""

    def method(pair: Pair) -> RigidTransform:
        source, reference = jax.tree.map(np.asarray, (pair.source, pair.reference))
        transforms = [
            register(source.points[i][source.mask[i]], reference.points[i][reference.mask[i]])
            for i in range(len(source.mask))
        ]
        return jax.tree.map(lambda *parts: np.stack(parts), *transforms)

    return method


def choose_method(name: str) -> methods.Method:
    """A method that no training of a network is needed for.

    `identity`; of this library `icp`, `register` (with all its defaults), `register_global` and
    `register_global_learned` (with its released features); or a classical baseline.

    Raises:
      ValueError: an unknown name (the message lists the baselines), or its library is not installed.
    """
    match name:
        case "identity":
            return methods.identity_method
        case "icp":
            return methods.icp_method
        case "register":
            return methods.host_method(lambda x, y: RigidTransform(*register(x, y)[:2]))
        case "register_global":
            return methods.global_method()
        case "register_global_learned":
            return methods.global_method(load_features())
    return methods.host_method(baselines.choose(name))
