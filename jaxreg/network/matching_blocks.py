"""The matching stage of large clouds, in blocks of rows (Eq. 3-6 with one (n, m) array in memory).

`matching` keeps about ten arrays of that size at once, which is fastest while they are small. Here
the distances are recomputed instead of kept: at 16,384 x 16,384 points one array is 1 GB.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.network.matching import (
    Incidence,
    Matches,
    collect_rows,
    feature_distance,
    final_distance,
    gather_rows,
    incidence,
    match,
    matching_scores,
)

BLOCK = 512
"""Rows (or columns) in a block."""
LARGEST = 2**25
"""Blocks are used for maps of more entries than this; below, whole maps take half the time and at
most about 1 GB."""


class Branch(NamedTuple):
    """One of the two neighbourhoods that are matched: features and graphs of both clouds."""

    source: Float[Array, "n c"]
    reference: Float[Array, "m c"]
    source_graph: Incidence
    reference_graph: Incidence


def match_in_blocks(
    branches: tuple[Branch, ...],
    reference: Float[Array, "m 3"],
    *,
    alpha: float,
    valid: Bool[Array, "m"] | None = None,
) -> Matches:
    """What `matching_maps` and `match` give, `BLOCK` rows at a time.

    D is the distance of the features of the first branch, D-hat that of the second; with one branch
    this is the single neighbourhood.
    """
    n, k = branches[0].source_graph.idx.shape
    shared = all(branch.source_graph is branches[0].source_graph for branch in branches)
    branches = tuple(_padded(branch, -n % BLOCK) for branch in branches)
    # The sum is linear: branches on the same graphs need one sum.
    groups = [branches] if shared else [(branch,) for branch in branches]
    dual = functools.reduce(operator.add, (_neighborhood_sum(group, valid) for group in groups))

    def last(dual, *sources):
        pairs = zip(sources, branches, strict=True)
        distance = functools.reduce(
            operator.add, (feature_distance(x, b.reference) for x, b in pairs)
        )
        dual = dual / k if valid is None else jnp.where(valid[None, :], dual / k, 0)
        scores = matching_scores(final_distance(distance, dual, alpha=alpha), valid)
        return match(dual, scores, reference)

    matches = _by_rows(last, dual, *(branch.source for branch in branches))
    return jax.tree.map(lambda x: x[:n], matches)


def _neighborhood_sum(branches: tuple[Branch, ...], valid) -> Float[Array, "n m"]:
    """``A_P (M + M-hat) A_Q^T`` of branches on the same graphs."""

    def over_columns(*sources):
        pairs = zip(sources, branches, strict=True)
        scores = functools.reduce(
            operator.add,
            (matching_scores(feature_distance(x, b.reference), valid) for x, b in pairs),
        )
        return _row_sum(scores.T, branches[0].reference_graph).T

    summed = _by_rows(over_columns, *(branch.source for branch in branches))
    return _row_sum(summed, branches[0].source_graph)


def _row_sum(x: Float[Array, "n m"], graph: Incidence) -> Float[Array, "n m"]:
    """``A x``, the sum of the rows of the neighbours: one half of `neighborhood_sum`."""
    return jax.lax.custom_linear_solve(
        lambda x: x,
        x,
        solve=lambda _, x: _by_columns(lambda part: gather_rows(part, graph), x),
        transpose_solve=lambda _, x: _by_columns(lambda part: collect_rows(part, graph), x),
    )


def _by_columns(function: Callable, x: Float[Array, "n m"]) -> Float[Array, "n m"]:
    """`function` of some columns of `x` at a time, written back in their place."""
    size = min(BLOCK, x.shape[1])
    whole, rest = divmod(x.shape[1], size)

    def replace(x, start, width):
        part = function(jax.lax.dynamic_slice_in_dim(x, start, width, axis=1))
        return jax.lax.dynamic_update_slice_in_dim(x, part, start, axis=1)

    x = jax.lax.fori_loop(0, whole, lambda i, x: replace(x, i * size, size), x)
    return replace(x, whole * size, rest) if rest else x


def _by_rows(function: Callable, *arrays: Float[Array, "n _"]) -> Any:
    """``function(*arrays)``, `BLOCK` rows at a time, for a function that treats each row alone."""
    blocks = [x.reshape(-1, BLOCK, x.shape[-1]) for x in arrays]
    # What a block computes is computed again in the backward pass, or memory would not be saved.
    result = jax.lax.map(lambda rows: jax.checkpoint(function)(*rows), blocks)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), result)


def _padded(branch: Branch, count: int) -> Branch:
    """The branch with `count` more source points, which are neighbours of no point."""
    if count == 0:
        return branch
    widths = ((0, count), (0, 0))
    # They list the first point as their neighbour; nothing reads their sums.
    graph = incidence(jnp.pad(branch.source_graph.idx, widths))
    return branch._replace(source=jnp.pad(branch.source, widths), source_graph=graph)
