"""Queries of k-d trees on the host, on all cores.

The trees are pykdtree's: its queries take about half of the time of scipy's, and the same time in every
process, which scipy's do not (docs/notes/0058). Its own threads (OpenMP) wait for work by spinning,
which slows down whatever else runs, and a fork inherits their locks. So they are told to be one, and
the points are shared out among threads of ours that stay.
"""

import functools
import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int
from pykdtree.kdtree import KDTree
from threadpoolctl import threadpool_limits

_LEAST = 512
"""Points that are worth a thread: about 0.2 ms."""


class Tree(KDTree):
    """A k-d tree that can be pickled, for clouds that go to other processes."""

    def __reduce__(self) -> tuple:
        """The points: building the tree again takes less time than a query of all of them."""
        return type(self), (np.reshape(self.data, (self.n, -1)),)


def nearest(
    tree: Tree, points: Float[np.ndarray, "*q 3"], *, within: float = math.inf
) -> tuple[Float[np.ndarray, "*q"], Int[np.ndarray, "*q"]]:
    """Distance to, and index of, the nearest point of the tree.

    Of points that lie farther than `within` only that is said: the distance is infinite and the index
    the number of points in the tree. Most of the time of a query goes into points that lie far off.
    """
    distance, index = neighbors(tree, points, 1, within=within)
    return distance[..., 0], index[..., 0]


def neighbors(
    tree: Tree, points: Float[np.ndarray, "*q 3"], k: int, *, within: float = math.inf
) -> tuple[Float[np.ndarray, "*q k"], Int[np.ndarray, "*q k"]]:
    """Distances to, and indices of, the k nearest points, the nearest first, told as `nearest` does."""
    flat, held = points.reshape(-1, points.shape[-1]), min(k, tree.n)
    count = max(1, min(_cores(), len(flat) // _LEAST))
    # Of this process: a fork has none of the threads. Not on the caller's own thread either, whose
    # number of OpenMP threads is the caller's business.
    waiting = [
        _threads(os.getpid()).submit(tree.query, part, held, distance_upper_bound=within)
        for part in np.array_split(flat, count)
    ]
    parts = [one.result() for one in waiting]
    distance, index = (np.concatenate(side) for side in zip(*parts, strict=True))
    missing = [(0, 0), (0, k - held)]
    distance = np.pad(distance.reshape(-1, held), missing, constant_values=np.inf)
    index = np.pad(index.reshape(-1, held).astype(np.intp), missing, constant_values=tree.n)
    shape = (*points.shape[:-1], k)
    return distance.reshape(shape), index.reshape(shape)


def _cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def _threads(process: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(
        _cores(),
        thread_name_prefix=f"jaxreg-trees-{process}",
        initializer=functools.partial(threadpool_limits, 1, user_api="openmp"),
    )
