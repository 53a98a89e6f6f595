"""Candidate correspondences between two sets of features."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

_MUTUAL = 10.0
"""Added to the margin of a mutual match: such matches come before all others."""


class Candidates(NamedTuple):
    """Candidate `i` joins ``source[source_index[i]]`` to ``reference[reference_index[i]]``.

    Best first; those with `mask` False fill the array up.
    """

    source_index: Int[Array, "c"]
    reference_index: Int[Array, "c"]
    mask: Bool[Array, "c"]


def match_histograms(
    source: Float[Array, "n f"],
    reference: Float[Array, "m f"],
    source_mask: Bool[Array, "n"],
    reference_mask: Bool[Array, "m"],
    *,
    kept: int,
) -> Candidates:
    """The `kept` best nearest-feature pairs of both directions, mutual ones first, then by margin.

    Likeness is Bhattacharyya's ``sum_k sqrt(f_k g_k)``; the margin is how much the best is more like
    than the third: the second is often its neighbour on the same surface.
    """
    n, m = source.shape[0], reference.shape[0]
    likeness = jnp.matmul(jnp.sqrt(source), jnp.sqrt(reference).T, precision=Precision.DEFAULT)
    both = source_mask[:, None] & reference_mask[None, :]
    likeness = jnp.where(both, likeness, -1)
    forward, j = _best_three(likeness)
    backward, i = _best_three(likeness.T)
    rows, columns = jnp.arange(n, dtype=i.dtype), jnp.arange(m, dtype=i.dtype)
    mutual, found_twice = i[j[:, 0], 0] == rows, j[i[:, 0], 0] == columns
    margin = jnp.concatenate([forward[:, 0] - forward[:, 2], backward[:, 0] - backward[:, 2]])
    found_both_ways = jnp.concatenate([mutual, jnp.zeros(m, bool)])
    margin = margin + jnp.where(found_both_ways, _MUTUAL, 0).astype(margin.dtype)
    valid = jnp.concatenate([source_mask, reference_mask & ~found_twice])
    valid = valid & jnp.any(source_mask) & jnp.any(reference_mask)
    score, best = jax.lax.top_k(jnp.where(valid, margin, -jnp.inf), min(kept, n + m))
    return Candidates(
        jnp.concatenate([rows, i[:, 0]])[best],
        jnp.concatenate([j[:, 0], columns])[best],
        score > -jnp.inf,
    )


def _best_three(likeness: Array) -> tuple[Array, Array]:
    # The barrier keeps slices from turning the selection into a sort of every row.
    return tuple(jax.lax.optimization_barrier(jax.lax.top_k(likeness, 3)))
