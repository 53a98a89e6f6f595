"""Evaluation on many pairs: made batch by batch, registered by any method, in constant memory.

A method is a function of a batch of pairs (a `Pair` with a leading axis on every array) to the
stacked transforms from source to reference; it must not read `Pair.transform`.
"""

import dataclasses
import inspect
import time
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jaxreg import rigid
from jaxreg.compilation import jit
from jaxreg.config import ModelConfig, PairConfig, RefineConfig
from jaxreg.cpu import map_pairs
from jaxreg.data.pairs import make_pair, make_pair_from_scans
from jaxreg.dense import register_dense
from jaxreg.dense.learned import Network
from jaxreg.model import Variables, iterate
from jaxreg.refine.gicp import gicp
from jaxreg.refine.icp import icp
from jaxreg.refine.point_to_plane import point_to_plane
from jaxreg.types import Pair, PointCloud, RigidTransform

Method = Callable[[Pair], RigidTransform]
Refinement = Callable[[Pair, RigidTransform], RigidTransform]
"""Better poses of a batch from given ones."""

_TEST, _VALIDATION = 0, 1  # Streams of random keys below the seed of the test pairs.


def test_key(seed: int) -> PRNGKeyArray:
    """Key of the stream of test pairs; pair `i` of it is made from ``fold_in(key, i)``."""
    return jax.random.fold_in(jax.random.key(seed), _TEST)


def validation_key(seed: int) -> PRNGKeyArray:
    """Key of the stream of validation pairs."""
    return jax.random.fold_in(jax.random.key(seed), _VALIDATION)


def _make_batch(key, numbers, shapes, *, config: PairConfig) -> Pair:
    one = lambda number, shape: make_pair(jax.random.fold_in(key, number), shape, config)  # noqa: E731
    return jax.vmap(one)(numbers, shapes)


_make_batch_jit = jit(_make_batch, static_argnames="config")


def pair_batches(
    shapes: Float[np.ndarray, "s p 3"], key: PRNGKeyArray, *, config: PairConfig, batch: int
) -> Iterator[tuple[Pair, int]]:
    """One pair a shape, in batches; pair `i` depends on `key`, `i` and shape `i` only.

    Every batch has the same size, so that nothing is compiled twice: the last is filled up with
    pairs from the start. The number of pairs that count comes with each batch.
    """
    for start in range(0, len(shapes), batch):
        numbers = np.arange(start, start + batch) % len(shapes)
        yield (
            _make_batch_jit(key, jnp.asarray(numbers), shapes[numbers], config=config),
            min(batch, len(shapes) - start),
        )


def _given_batch(key, numbers, source, target, transform, *, config: PairConfig) -> Pair:
    def one(number, source, target, matrix):
        pose = RigidTransform(matrix[:3, :3], matrix[:3, 3])
        everywhere = jnp.ones(source.shape[0], bool)
        still = rigid.apply(rigid.inverse(pose), target)
        clouds = (PointCloud(points, everywhere) for points in (source, still))
        return make_pair_from_scans(jax.random.fold_in(key, number), *clouds, config, pose)

    return jax.vmap(one)(numbers, source, target, transform)


_given_batch_jit = jit(_given_batch, static_argnames="config")


def given_pair_batches(
    clouds: tuple[Float[np.ndarray, "s p 3"], Float[np.ndarray, "s p 3"]],
    transforms: Float[np.ndarray, "s 4 4"],
    key: PRNGKeyArray,
    *,
    config: PairConfig,
    batch: int,
) -> Iterator[tuple[Pair, int]]:
    """As `pair_batches`, of given sources and references in the pose that `transforms` says."""
    source, target = clouds
    for start in range(0, len(source), batch):
        numbers = np.arange(start, start + batch) % len(source)
        matrices = transforms[numbers].astype(source.dtype)
        chosen = (jnp.asarray(numbers), source[numbers], target[numbers], matrices)
        yield _given_batch_jit(key, *chosen, config=config), min(batch, len(source) - start)


def true_transforms(batches: Iterator[tuple[Pair, int]]) -> RigidTransform:
    """The true transforms of the pairs (numpy, stacked)."""
    parts = [jax.tree.map(lambda x, c=n: np.array(x)[:c], pair.transform) for pair, n in batches]
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def evaluate_method(
    method: Callable[..., RigidTransform],
    batches: Iterator[tuple[Pair, int]],
    progress: Callable[[int], None] = lambda done: None,
    *,
    initial: RigidTransform | None = None,
) -> tuple[RigidTransform, RigidTransform, float]:
    """Predicted and true transforms (numpy, stacked), and the seconds that `method` takes a pair.

    With `initial`, transforms of all pairs, the method (a `refinement`) also gets those of the batch.
    The first batch is registered twice and not timed the first time, since it compiles.
    """
    results, seconds, done = [], 0.0, 0
    for pair, count in batches:
        inputs = (pair,)
        if initial is not None:
            # The last batch is filled up with pairs that are not counted.
            rows = np.arange(done, done + pair.source.mask.shape[0])
            inputs = pair, jax.tree.map(lambda x, r=rows: x.take(r, axis=0, mode="clip"), initial)
        if not results:
            jax.block_until_ready(method(*inputs))
        begin = time.perf_counter()
        predicted = jax.block_until_ready(method(*inputs))
        seconds += time.perf_counter() - begin
        done += pair.source.mask.shape[0]
        # Copies: a numpy view would keep the array that it looks at alive on the device.
        results.append(
            jax.tree.map(lambda x, c=count: np.array(x)[:c], (predicted, pair.transform))
        )
        progress(count)
    predicted, truth = jax.tree.map(lambda *parts: np.concatenate(parts), *results)
    return predicted, truth, seconds / done


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
    """Point-to-point ICP of this library from the identity."""
    one = lambda source, reference: icp(  # noqa: E731
        source.points,
        reference.points,
        iterations=50,
        source_mask=source.mask,
        reference_mask=reference.mask,
    )
    return map_pairs(one)(pair.source, pair.reference)


def dense_method(network: Network | None = None) -> Method:
    """`register_dense` of this library, from any start; with the features of `network`."""

    def one(source, reference):
        masks = {"source_mask": source.mask, "reference_mask": reference.mask}
        found = register_dense(source.points, reference.points, network=network, **masks)
        return RigidTransform(found.rotation, found.translation)

    register_batch = jit(map_pairs(one))
    return lambda pair: register_batch(pair.source, pair.reference)


def refined_method(method: Method, refine: Refinement) -> Method:
    """`method`, then a refinement of its poses (both clouds, nothing learned)."""
    return lambda pair: refine(pair, method(pair))


def refinement(config: RefineConfig) -> Refinement:
    """The ICP family from given poses of a batch; each gets the fields of `config` it takes."""
    refine = {"icp": icp, "point_to_plane": point_to_plane, "gicp": gicp}[config.method]
    taken = inspect.signature(refine).parameters
    names = [field.name for field in dataclasses.fields(config) if field.name in taken]
    options = {name: getattr(config, name) for name in names}

    def one(source, reference, initial):
        masks = {"source_mask": source.mask, "reference_mask": reference.mask}
        return refine(source.points, reference.points, initial=initial, **masks, **options)

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
