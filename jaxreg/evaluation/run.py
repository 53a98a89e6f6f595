"""Evaluation on many pairs: made batch by batch, registered by any method, in constant memory.

A method is a function of a batch of pairs (a `Pair` with a leading axis on every array) to the
stacked transforms from source to reference; it must not read `Pair.transform`.
"""

import time
from collections.abc import Callable, Iterable, Iterator

import jax
import numpy as np

from jaxreg.evaluation.parts import Registered
from jaxreg.types import Pair, RigidTransform


def evaluate_method(
    method: Callable[..., RigidTransform],
    batches: Iterable[tuple[Pair, int]],
    progress: Callable[[int], None] = lambda done: None,
    *,
    initial: RigidTransform | None = None,
) -> tuple[RigidTransform, RigidTransform, float]:
    """Predicted and true transforms (numpy, stacked), and the seconds that `method` takes per pair.

    With `initial`, transforms of all pairs, the method (a `refinement`) also gets those of the batch.
    The first batch is registered twice; the first time is not counted, because it compiles.
    """
    numbered = ((number, *batch) for number, batch in enumerate(batches))
    results = []
    for _, found in registered_batches(method, numbered, initial=initial):
        results.append(found)
        progress(len(found.truth.rotation))
    return together(results)


def registered_batches(
    method: Callable[..., RigidTransform],
    numbered: Iterable[tuple[int, Pair, int]],
    *,
    initial: RigidTransform | None = None,
) -> Iterator[tuple[int, Registered]]:
    """Every batch registered, with its number; as `evaluate_method` for some batches, one by one."""
    compiled = False
    for number, pair, count in numbered:
        inputs, size = (pair,), pair.source.mask.shape[0]
        if initial is not None:
            # The last batch is filled up with pairs that are not counted.
            rows = number * size + np.arange(size)
            inputs = pair, jax.tree.map(lambda x, r=rows: x.take(r, axis=0, mode="clip"), initial)
        if not compiled:
            jax.block_until_ready(method(*inputs))
            compiled = True
        begin = time.perf_counter()
        predicted = jax.block_until_ready(method(*inputs))
        seconds = (time.perf_counter() - begin) * count / size
        # Copies: a numpy view would keep its array alive on the device.
        predicted, truth = jax.tree.map(
            lambda x, c=count: np.array(x)[:c], (predicted, pair.transform)
        )
        yield number, Registered(predicted, truth, seconds)


def together(
    results: Iterable[Registered],
) -> tuple[RigidTransform, RigidTransform, float]:
    """The transforms of all batches one after the other, and the seconds per pair."""
    results = list(results)
    predicted, truth = (
        jax.tree.map(lambda *parts: np.concatenate(parts), *side)
        for side in ([x.predicted for x in results], [x.truth for x in results])
    )
    return predicted, truth, sum(found.seconds for found in results) / len(truth.rotation)
