"""Queries of k-d trees on the host, on all cores.

scipy starts threads for every query. In a process whose other threads are busy a start takes as long as
a thousand points, so that a registration, which asks some fifty times for a few thousand points each,
gained nothing by them (docs/notes/0055). Here the threads stay.
"""

import functools
import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

_LEAST = 512
"""Points that are worth a thread: about 0.3 ms."""


def nearest(
    tree: cKDTree, points: Float[np.ndarray, "*q 3"], *, within: float = math.inf
) -> tuple[Float[np.ndarray, "*q"], Int[np.ndarray, "*q"]]:
    """Distance to, and index of, the nearest point of the tree.

    Of points that lie farther than `within` only that is said: the distance is infinite and the index
    the number of points in the tree. Most of the time of a query goes into points that lie far off.
    """
    distance, index = neighbors(tree, points, 1, within=within)
    return distance[..., 0], index[..., 0]


def neighbors(
    tree: cKDTree, points: Float[np.ndarray, "*q 3"], k: int, *, within: float = math.inf
) -> tuple[Float[np.ndarray, "*q k"], Int[np.ndarray, "*q k"]]:
    """Distances to, and indices of, the k nearest points, the nearest first, told as `nearest` does."""
    flat = points.reshape(-1, points.shape[-1])
    # As a list: of one rank there would be no column.
    query = functools.partial(tree.query, k=list(range(1, k + 1)), distance_upper_bound=within)
    count = max(1, min(_cores(), len(flat) // _LEAST))
    first, *others = np.array_split(flat, count)
    # Of this process: a fork has none of the threads.
    waiting = [_threads(os.getpid()).submit(query, part) for part in others]
    parts = [query(first), *(one.result() for one in waiting)]
    distance, index = (np.concatenate(side) for side in zip(*parts, strict=True))
    shape = (*points.shape[:-1], k)
    return distance.reshape(shape), index.reshape(shape)


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def _threads(process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(1, _cores() - 1), thread_name_prefix=f"jaxreg-trees-{process}")
