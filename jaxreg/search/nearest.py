"""Nearest points fast enough for thousands of poses: a packed minimum, and a grid of answers."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg._xla import written_out
from jaxreg.geometry.neighbors import squared_distances

CELLS = 24
"""Cells of a grid along each axis: a cell of a usual shape is about a tenth of its radius."""
_FAR = 1e4
"""Coordinate at which padding is placed, in units of the clouds."""


class NearestGrid(NamedTuple):
    """The nearest point of a cloud to the centre of every cell of a box around it."""

    index: Int[Array, "cells"]
    corner: Float[Array, "3"]
    cell: Float[Array, "3"]


def nearest_packed(
    queries: Float[Array, "q 3"], points: Float[Array, "m 3"], mask: Bool[Array, "m"]
) -> Int[Array, "q"]:
    """Index of the nearest valid point of every query, exact except for near-equal distances.

    The index replaces the last ``log2(m)`` bits of the squared distance, which then orders as
    before: one vectorised minimum instead of an argmin, ten times faster on a CPU. With 1024 points
    in float32, squared distances that differ by less than 1/8000 count as equal.
    """
    points, queries = jax.lax.stop_gradient((jnp.where(mask[:, None], points, _FAR), queries))
    # Otherwise XLA moves the queries again for every point.
    queries = written_out(queries)
    return _row_of_minimum(squared_distances(points, queries))


def _row_of_minimum(squared: Float[Array, "m q"]) -> Int[Array, "q"]:
    """For every column: minima over columns are twice as fast as over rows."""
    m = squared.shape[0]
    integer = jnp.int32 if squared.dtype == jnp.float32 else jnp.int64
    low = (1 << max(m - 1, 1).bit_length()) - 1
    # Not zero: a denormal would be flushed to zero and lose its index.
    tiny = jnp.asarray(1e-12, squared.dtype)
    bits = jax.lax.bitcast_convert_type(squared + tiny, integer) & ~integer(low)
    packed = bits | jnp.arange(m, dtype=integer)[:, None]
    best = jnp.min(jax.lax.bitcast_convert_type(packed, squared.dtype), axis=0)
    found = jax.lax.bitcast_convert_type(best, integer) & integer(low)
    return jnp.minimum(found, m - 1).astype(jnp.int32)


def nearest_grid(
    points: Float[Array, "m 3"], mask: Bool[Array, "m"], *, cells: int = CELLS, margin: float
) -> NearestGrid:
    """`cells` cells along each axis of the bounding box, widened by `margin` on every side."""
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0) - margin
    high = jnp.max(jnp.where(mask[:, None], points, -jnp.inf), axis=0) + margin
    low, high = (jnp.where(jnp.any(mask), side, 0) for side in (low, high))
    cell = jnp.maximum((high - low) / cells, 1e-6)
    steps = jnp.arange(cells, dtype=points.dtype) + 0.5
    points = jax.lax.stop_gradient(jnp.where(mask[:, None], points, _FAR))
    # On a lattice, the squared distances are sums of three tables.
    x, y, z = ((points[:, k, None] - (low[k] + cell[k] * steps)[None, :]) ** 2 for k in range(3))
    across = (y[:, :, None] + z[:, None, :]).reshape(len(points), -1)
    index = jax.lax.map(lambda along: _row_of_minimum(along[:, None] + across), x.T)
    return NearestGrid(index.reshape(-1), low, cell)


def lookup(grid: NearestGrid, queries: Float[Array, "*q 3"]) -> Int[Array, "*q"]:
    """The nearest point, approximately: the one nearest to the centre of the query's cell.

    A query outside the box takes the nearest cell of the box.
    """
    cells = round(grid.index.shape[0] ** (1 / 3))
    axes = tuple(range(queries.ndim - 1))
    corner, size = (jnp.expand_dims(side, axes) for side in (grid.corner, grid.cell))
    cell = jnp.clip(((queries - corner) / size).astype(jnp.int32), 0, cells - 1)
    return grid.index[(cell[..., 0] * cells + cell[..., 1]) * cells + cell[..., 2]]
