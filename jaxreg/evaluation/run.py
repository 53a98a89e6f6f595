"""Evaluation on many pairs: made batch by batch, registered by any method, in constant memory.

A method is a function of a batch of pairs (a `Pair` with a leading axis on every array) to the
stacked transforms from source to reference; it must not read `Pair.transform`.
"""

import time
from collections.abc import Callable, Iterator

import jax
import numpy as np

from jaxreg.types import Pair, RigidTransform


def evaluate_method(
    method: Callable[..., RigidTransform],
    batches: Iterator[tuple[Pair, int]],
    progress: Callable[[int], None] = lambda done: None,
    *,
    initial: RigidTransform | None = None,
) -> tuple[RigidTransform, RigidTransform, float]:
    """Predicted and true transforms (numpy, stacked), and the seconds that `method` takes per pair.

    With `initial`, transforms of all pairs, the method (a `refinement`) also gets those of the batch.
    The first batch is registered twice; the first time is not counted, because it compiles.
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
        # Copies: a numpy view would keep its array alive on the device.
        results.append(
            jax.tree.map(lambda x, c=count: np.array(x)[:c], (predicted, pair.transform))
        )
        progress(count)
    predicted, truth = jax.tree.map(lambda *parts: np.concatenate(parts), *results)
    return predicted, truth, seconds / done
