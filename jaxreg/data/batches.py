"""Streams of pairs in batches of equal size: made from shapes, or given by a data set."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jaxreg.config import PairConfig
from jaxreg.data.pairs import make_pair, make_pair_from_scans
from jaxreg.geometry import rigid
from jaxreg.types import Pair, PointCloud, RigidTransform

_TEST, _VALIDATION = 0, 1  # Streams of random keys below the seed of the test pairs.


def key_of(seed: int) -> PRNGKeyArray:
    """The key of a seed, whatever generator is the default of the process."""
    return jax.random.key(seed, impl="threefry2x32")


def same_streams() -> AbstractContextManager:
    """Compile programs in here, so that the numbers of a key do not follow the process' settings."""
    return jax.threefry_partitionable(True)


def key_of_tests(seed: int) -> PRNGKeyArray:
    """Key of the stream of test pairs; pair `i` of it is made from ``fold_in(key, i)``."""
    return jax.random.fold_in(key_of(seed), _TEST)


def validation_key(seed: int) -> PRNGKeyArray:
    """Key of the stream of validation pairs."""
    return jax.random.fold_in(key_of(seed), _VALIDATION)


def _make_batch(key, numbers, shapes, *, config: PairConfig) -> Pair:
    one = lambda number, shape: make_pair(jax.random.fold_in(key, number), shape, config)  # noqa: E731
    return jax.vmap(one)(numbers, shapes)


_make_batch_jit = jax.jit(_make_batch, static_argnames="config")


def pair_batches(
    shapes: Float[np.ndarray, "s p 3"],
    key: PRNGKeyArray,
    *,
    config: PairConfig,
    batch: int,
    only: Sequence[int] | None = None,
) -> Iterator[tuple[Pair, int]]:
    """One pair per shape, in batches; pair `i` depends on `key`, `i` and shape `i` only.

    All batches have the same size, so nothing is compiled twice: the last is filled up with pairs
    from the start. Each batch comes with the number of its pairs that count. `only` are the numbers
    of the batches to make.
    """
    for start in _starts(len(shapes), batch, only):
        numbers = np.arange(start, start + batch) % len(shapes)
        with same_streams():
            pairs = _make_batch_jit(key, jnp.asarray(numbers), shapes[numbers], config=config)
        yield pairs, min(batch, len(shapes) - start)


def _starts(count: int, batch: int, only: Sequence[int] | None) -> Iterable[int]:
    return range(0, count, batch) if only is None else (number * batch for number in only)


def _given_batch(key, numbers, source, target, transform, *, config: PairConfig) -> Pair:
    def one(number, source, target, matrix):
        pose = RigidTransform(matrix[:3, :3], matrix[:3, 3])
        everywhere = jnp.ones(source.shape[0], bool)
        still = rigid.apply(rigid.inverse(pose), target)
        x, y = PointCloud(source, everywhere), PointCloud(still, everywhere)
        return make_pair_from_scans(jax.random.fold_in(key, number), x, y, config, pose)

    return jax.vmap(one)(numbers, source, target, transform)


_given_batch_jit = jax.jit(_given_batch, static_argnames="config")


def given_pair_batches(
    clouds: tuple[Float[np.ndarray, "s p 3"], Float[np.ndarray, "s p 3"]],
    transforms: Float[np.ndarray, "s 4 4"],
    key: PRNGKeyArray,
    *,
    config: PairConfig,
    batch: int,
    only: Sequence[int] | None = None,
) -> Iterator[tuple[Pair, int]]:
    """As `pair_batches`, for given sources and references with the poses `transforms`."""
    source, target = clouds
    for start in _starts(len(source), batch, only):
        numbers = np.arange(start, start + batch) % len(source)
        matrices = transforms[numbers].astype(source.dtype)
        chosen = (jnp.asarray(numbers), source[numbers], target[numbers], matrices)
        with same_streams():
            pairs = _given_batch_jit(key, *chosen, config=config)
        yield pairs, min(batch, len(source) - start)


def true_transforms(batches: Iterator[tuple[Pair, int]]) -> RigidTransform:
    """The true transforms of the pairs (numpy, stacked)."""
    parts = [jax.tree.map(lambda x, c=n: np.array(x)[:c], pair.transform) for pair, n in batches]
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
