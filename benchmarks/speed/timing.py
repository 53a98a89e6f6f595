"""How everything is timed: compiled beforehand, alternating, minimum and median of several runs.

Two programs that are timed one after the other meet different machines (other work, heat, memory).
So the candidates take turns, run by run, and only ratios within one call of `alternate` count.
"""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision


class Timing(NamedTuple):
    """Seconds of the fastest and of the middle run, and how many there were."""

    minimum: float
    median: float
    runs: int


def alternate(
    tasks: Mapping[str, Callable[[int], object]], *, rounds: int, seconds: float = 20.0
) -> dict[str, Timing]:
    """Time `tasks` in turns; a task is called with the number of its run, 0 compiles and is not timed.

    A task that has used up its `seconds` is left out of later rounds, after two runs at least.
    """
    for task in tasks.values():
        jax.block_until_ready(task(0))
    taken = {name: [] for name in tasks}
    for number in range(1, rounds + 1):
        for name, task in tasks.items():
            if sum(taken[name]) > seconds and len(taken[name]) >= 2:
                continue
            begin = time.perf_counter()
            jax.block_until_ready(task(number))
            taken[name].append(time.perf_counter() - begin)
    return {
        name: Timing(min(runs), statistics.median(runs), len(runs)) for name, runs in taken.items()
    }


def matrix_product() -> tuple[Callable[[int], object], float]:
    """A float32 product of two matrices of 1536 rows and columns, and its operations: the roof."""
    product = jax.jit(lambda a: jnp.matmul(a, a, precision=Precision.HIGHEST))
    matrix = jnp.ones((1536, 1536), jnp.float32)
    return lambda _: product(matrix), 2 * 1536.0**3
