"""Neighbours inside one cloud and between two, by exact differences of coordinates.

The product form ``|x|^2 - 2 x.y + |y|^2`` is not used for points: a thousand units away from the
origin it gives the wrong neighbour half of the time.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._xla import row_min
from jaxreg.geometry import arguments

_BLOCK = 2048
"""Points whose distances to all others are in memory at once; fewer where there are many others."""
_AT_ONCE = 2**26
"""Distances that are in memory at once: 256 MiB of float32."""
_ROUNDINGS = 4
"""By how much two distances may differ and still count as equal, in units of the last digit of the
largest coordinate."""


def squared_distances(
    points: Float[Array, "n 3"], others: Float[Array, "m 3"]
) -> Float[Array, "n m"]:
    """``d[i, j] = |points[i] - others[j]|^2``."""
    x, y, z = (points[:, None, axis] - others[None, :, axis] for axis in range(3))
    return x * x + y * y + z * z


def without_padding(
    points: Float[Array, "n 3"], mask: Bool[Array, "n"] | None
) -> Float[Array, "n 3"]:
    """`points` with every padded row set to zero, so a NaN there has no effect."""
    return points if mask is None else jnp.where(mask[:, None], points, 0)


def knn(
    points: Float[Array, "n 3"], k: int, mask: Bool[Array, "n"] | None = None
) -> Int[Array, "n k"]:
    """The `k` nearest other points of every point, nearest first (the graph N_o).

    If ``idx[i, r] = j`` then ``points[j]`` is the (r+1)-th nearest point of ``points[i]`` with
    ``j != i``. Coincident points are neighbours of each other at distance 0. Ties are broken by the
    coordinates (their bits), not by the row, so permuting the points permutes the graph. A point
    with fewer than `k` valid others fills its list up with itself.

    Raises:
      ValueError: `points` is not ``(n, 3)`` of float32 or float64, `mask` not ``(n,)`` of bools, or
        not ``1 <= k < n``.
    """
    points = arguments.cloud("points", points)
    n = points.shape[0]
    mask, k = arguments.mask("mask", mask, n), arguments.count("k", k)
    if not 1 <= k < n:
        raise ValueError(
            f"k = {k} neighbours in a cloud of n = {n} points: "
            "choose 1 <= k < n, or give more points."
        )
    points = jax.lax.stop_gradient(without_padding(points, mask))
    order = _scattered(points)
    candidates, row = points[order], jnp.arange(n, dtype=order.dtype)

    def of_rows(row):
        distance = squared_distances(points[row], candidates)
        excluded = order[None, :] == row[:, None]
        if mask is not None:
            excluded = excluded | ~mask[order][None, :]
        negative, column = jax.lax.top_k(jnp.where(excluded, -jnp.inf, -distance), k)
        return jnp.where(jnp.isneginf(negative), row[:, None], order[column])

    index = _in_blocks(of_rows, row, n)
    # The barrier keeps XLA from merging later slices into the selection, which would turn the
    # fast call into a full sort of every row.
    return jax.lax.optimization_barrier(index.astype(jnp.int32))


def nearest_neighbor(
    points: Float[Array, "n 3"], mask: Bool[Array, "n"] | None = None
) -> Int[Array, "n"]:
    """Index of the nearest other point: ``points[idx]`` is the 1-NN cloud (Eq. 1-2, i != m).

    Raises:
      ValueError: what `knn` raises; `points` needs two rows.
    """
    return knn(points, 1, mask)[:, 0]


def nearest_in(
    points: Float[Array, "n 3"],
    others: Float[Array, "m 3"],
    mask: Bool[Array, "m"] | None = None,
) -> Int[Array, "n"]:
    """For every point, the row of the nearest valid one of `others`.

    It is the first of those that are equally near, up to rounding.
    """
    points, others = jax.lax.stop_gradient((points, without_padding(others, mask)))
    return _in_blocks(lambda rows: _nearest_of(rows, others, mask), points, others.shape[0])


def _in_blocks(of_rows: Callable[[Array], Array], rows: Array, others: int) -> Array:
    """``of_rows(rows)``, of a block of rows after the other if there are many, or many others.

    All distances of a large cloud at once would fill the memory.
    """
    n, block = rows.shape[0], _BLOCK
    # A size that is a symbol, in a program to export, cannot be told to be large.
    if isinstance(others, int) and others > _AT_ONCE // _BLOCK:
        block = 1 << (max(_AT_ONCE // others, 1).bit_length() - 1)
    if n <= block:
        return of_rows(rows)
    padded = jnp.pad(rows, ((0, -n % block), *[(0, 0)] * (rows.ndim - 1)))
    found = jax.lax.map(of_rows, padded.reshape(-1, block, *rows.shape[1:]))
    return found.reshape(-1, *found.shape[2:])[:n]


def _nearest_of(
    points: Float[Array, "n 3"], others: Float[Array, "m 3"], mask: Bool[Array, "m"] | None
) -> Int[Array, "n"]:
    distance = squared_distances(points, others)
    if mask is not None:
        distance = jnp.where(mask[None, :], distance, jnp.inf)
    # XLA may compute coordinates and distances again for the comparison, with other last digits;
    # then, for points that differ in these only, no distance would equal the smallest.
    largest = jnp.max(jnp.abs(points), axis=1) + jnp.max(jnp.abs(others))
    rounding = _ROUNDINGS * jnp.finfo(points.dtype).eps * largest
    near = distance <= ((jnp.sqrt(row_min(distance)) + rounding) ** 2)[:, None]
    # The smallest value, then the first column that has it: two vectorised reductions. XLA runs
    # argmin, which carries both through one reduction, one element at a time.
    column = jnp.arange(others.shape[0], dtype=jnp.int32)[None, :]
    return row_min(jnp.where(near, column, others.shape[0] - 1))


def _scattered(points: Float[Array, "n 3"]) -> Int[Array, "n"]:
    """A pseudo-random order that depends on the points alone: not on their rows, nor on padding.

    On a CPU a selection keeps the best so far, and rarely replaces them if near points come in
    random order: selecting 16 of 768 takes two thirds of the time that it takes after sorting by x.
    """
    width = jnp.finfo(points.dtype).bits
    bits = jax.lax.bitcast_convert_type(points, jnp.dtype(f"uint{width}"))
    # Multiplicative hashing (Knuth, volume 3, section 6.4).
    odd = jnp.asarray(0x9E3779B97F4A7C15 % 2**width, bits.dtype)
    mixed = jnp.zeros_like(bits[:, 0])
    for axis in range(3):
        mixed = (mixed ^ bits[:, axis]) * odd
        mixed = mixed ^ (mixed >> (width // 2))  # The low bits of round numbers are all zero.
    return jnp.lexsort((*points.T, mixed))
