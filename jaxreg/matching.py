"""Dual neighbourhood fusion matching: from features to the reference copy (Eq. 3-6).

Rows are source points i, columns reference points j. `valid` marks the columns that are no padding;
a padded column has matching score exactly 0. Rows of padding hold finite values without meaning.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg.numerics import safe_sqrt

_FAR = 1e30


def feature_distance(
    source: Float[Array, "n c"], reference: Float[Array, "m c"]
) -> Float[Array, "n m"]:
    """``D[i, j] = |source[i] - reference[j]|`` of features (Eq. 3)."""
    # |a|^2 - 2 a.b + |b|^2 cancels; about the centre the terms are as small as they can be.
    center = jax.lax.stop_gradient(jnp.mean(reference, axis=0))
    a, b = source - center, reference - center
    product = jnp.matmul(a, b.T, precision=Precision.HIGHEST)
    square = jnp.sum(a * a, axis=1)[:, None] - 2 * product + jnp.sum(b * b, axis=1)[None, :]
    return safe_sqrt(square)


def matching_scores(
    distance: Float[Array, "n m"], valid: Bool[Array, "m"] | None = None
) -> Float[Array, "n m"]:
    """``M[i, j] = softmax_j(-D[i, j])`` over valid columns (Eq. 3); rows sum to 1."""
    if valid is not None:
        distance = jnp.where(valid[None, :], distance, _FAR)
    return jax.nn.softmax(-distance, axis=1)


@jax.custom_vjp
def neighborhood_sum(
    scores: Float[Array, "n m"], source_idx: Int[Array, "n k"], reference_idx: Int[Array, "m k"]
) -> Float[Array, "n m"]:
    """``S[i, j] = sum of scores[i', j'] over i' in N(i), j' in N(j)`` (Eq. 4), ``S = A_P M A_Q^T``.

    Two passes of K row gathers; nothing of size n x m x k is formed.
    """
    return _sum_rows(_sum_rows(scores, source_idx).T, reference_idx).T


def _sum_rows(scores: Float[Array, "n m"], idx: Int[Array, "p k"]) -> Float[Array, "p m"]:
    return sum(scores[idx[:, r]] for r in range(idx.shape[1]))


def _adjacency(idx: Int[Array, "n k"], columns: int, dtype) -> Float[Array, "n m"]:
    column = jnp.arange(columns)
    return sum((idx[:, r, None] == column[None, :]).astype(dtype) for r in range(idx.shape[1]))


def _neighborhood_sum_fwd(scores, source_idx, reference_idx):
    return neighborhood_sum(scores, source_idx, reference_idx), (source_idx, reference_idx)


def _neighborhood_sum_bwd(residuals, cotangent):
    # The transpose of a gather is a scatter-add, which XLA runs serially on a CPU and is ten times
    # slower than these two products with 0/1 matrices: A_P^T g A_Q.
    source_idx, reference_idx = residuals
    n, m = cotangent.shape
    a_p = _adjacency(source_idx, n, cotangent.dtype)
    a_q = _adjacency(reference_idx, m, cotangent.dtype)
    return jnp.matmul(jnp.matmul(a_p.T, cotangent), a_q), None, None


neighborhood_sum.defvjp(_neighborhood_sum_fwd, _neighborhood_sum_bwd)


def final_distance(
    distance: Float[Array, "n m"], dual: Float[Array, "n m"], *, alpha: float
) -> Float[Array, "n m"]:
    """``D' = exp(alpha - G) * (D + D-hat)`` for the summed `distance` and the map G (Eq. 5)."""
    return jnp.exp(alpha - dual) * distance


class Matches(NamedTuple):
    """What the matching stage hands on.

    `copy` is the reference copy (Eq. 6). `dual_peak` and `final_peak` hold, per source point, the
    largest entry of the maps G and F, which is all that the spatial consistency loss reads.
    """

    copy: Float[Array, "n 3"]
    dual_peak: Float[Array, "n"]
    final_peak: Float[Array, "n"]


class Maps(NamedTuple):
    """The matching maps: `scores` M, `dual` G and `final` F, each (n, m)."""

    scores: Float[Array, "n m"]
    dual: Float[Array, "n m"]
    final: Float[Array, "n m"]


def matching_maps(
    distance: Float[Array, "n m"],
    nearest_distance: Float[Array, "n m"] | None,
    source_idx: Int[Array, "n k"],
    reference_idx: Int[Array, "m k"],
    *,
    alpha: float,
    nearest_idx: tuple[Int[Array, "n k"], Int[Array, "m k"]] | None = None,
    valid: Bool[Array, "m"] | None = None,
) -> Maps:
    """The maps M, G, F (Eq. 3-5) from D and D-hat; None for D-hat is the single neighbourhood.

    `nearest_idx` holds the graphs of the 1-NN clouds where they differ from those of the input.
    """
    scores, total, k = matching_scores(distance, valid), distance, source_idx.shape[1]
    if nearest_distance is None:
        dual = neighborhood_sum(scores, source_idx, reference_idx) / k
    else:
        total, nearest = distance + nearest_distance, matching_scores(nearest_distance, valid)
        if nearest_idx is None:  # The sum is linear: one graph, one sum.
            dual = neighborhood_sum(scores + nearest, source_idx, reference_idx) / k
        else:
            dual = neighborhood_sum(scores, source_idx, reference_idx) / k
            dual = dual + neighborhood_sum(nearest, *nearest_idx) / k
    return Maps(scores, dual, matching_scores(final_distance(total, dual, alpha=alpha), valid))


def match(maps: Maps, reference: Float[Array, "m 3"]) -> Matches:
    """The reference copy ``q~_i = sum_j F[i, j] q_j`` (Eq. 6) and the peaks of the maps."""
    copy = jnp.matmul(maps.final, reference, precision=Precision.HIGHEST)
    return Matches(copy, jnp.max(maps.dual, axis=1), jnp.max(maps.final, axis=1))
