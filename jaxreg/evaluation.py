"""Evaluation of a network on many pairs: vmapped batches in a stream of constant memory."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxreg.compilation import jit
from jaxreg.config import Config, ModelConfig, PairConfig
from jaxreg.data.pairs import make_pair
from jaxreg.model import Variables, iterate
from jaxreg.types import Pair, RigidTransform


def numbered_pair(
    key: PRNGKeyArray, number: Array, shape: Float[Array, "p 3"], config: PairConfig
) -> Pair:
    """Pair `number` of the stream that `key` stands for; it depends on nothing but these."""
    return make_pair(jax.random.fold_in(key, number), shape, config)


def _register_batch(variables, key, numbers, shapes, *, pairs: PairConfig, model: ModelConfig):
    batch = jax.vmap(lambda i, shape: numbered_pair(key, i, shape, pairs))(numbers, shapes)
    register = lambda pair: iterate(variables, pair.source, pair.reference, config=model)[0]  # noqa: E731
    return jax.vmap(register)(batch), batch.transform


_register_batch_jit = jit(_register_batch, static_argnames=("pairs", "model"))


def predict(
    variables: Variables,
    shapes: Float[np.ndarray, "s p 3"],
    key: PRNGKeyArray,
    *,
    pairs: PairConfig,
    model: ModelConfig,
    batch: int = 8,
) -> Iterator[tuple[RigidTransform, RigidTransform]]:
    """Predicted and true transforms (numpy, stacked) of one pair a shape, batch by batch.

    The last batch is filled up with repetitions, so that it compiles nothing new, and cut again.
    """
    for start in range(0, len(shapes), batch):
        numbers = np.arange(start, start + batch) % len(shapes)
        predicted, truth = _register_batch_jit(
            variables, key, jnp.asarray(numbers), shapes[numbers], pairs=pairs, model=model
        )
        count = min(batch, len(shapes) - start)
        yield jax.tree.map(lambda x, c=count: np.asarray(x)[:c], (predicted, truth))


def predict_all(
    variables: Variables,
    shapes: Float[np.ndarray, "s p 3"],
    key: PRNGKeyArray,
    *,
    config: Config,
    pairs: PairConfig,
    batch: int = 8,
) -> tuple[RigidTransform, RigidTransform]:
    """Predicted and true transforms of one pair a shape, stacked."""
    results = predict(variables, shapes, key, pairs=pairs, model=config.model, batch=batch)
    return jax.tree.map(lambda *parts: np.concatenate(parts), *results)
