"""Dual neighbourhood fusion matching: from features to the reference copy (Eq. 3-6).

Rows are source points i, columns reference points j. `valid` marks the columns that are not
padding; a padded column has matching score exactly 0. Padded rows contain finite values without
meaning.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg._xla import at_row_min, row_min, unfused, written_out
from jaxreg.geometry.numerics import safe_sqrt

_FAR = 1e30
KEPT = ("squared feature distance", "dual")
"""Names of the maps that a gradient stores; it recomputes the others (see `model.iterate`)."""


def squared_feature_distance(
    source: Float[Array, "n c"], reference: Float[Array, "m c"]
) -> Float[Array, "n m"]:
    """``D[i, j]^2 = |source[i] - reference[j]|^2`` of features; rounding may leave it below zero."""
    # |a|^2 - 2 a.b + |b|^2 cancels; about the centre the terms are as small as possible.
    center = jax.lax.stop_gradient(jnp.mean(reference, axis=0))[None, :]
    a, b = source - center, reference - center
    product = unfused(jnp.matmul(a, b.T, precision=Precision.HIGHEST))
    return jnp.sum(a * a, axis=1)[:, None] - 2 * product + jnp.sum(b * b, axis=1)[None, :]


def feature_distance(
    source: Float[Array, "n c"], reference: Float[Array, "m c"]
) -> Float[Array, "n m"]:
    """``D[i, j] = |source[i] - reference[j]|`` of features (Eq. 3)."""
    return safe_sqrt(squared_feature_distance(source, reference))


def matching_scores(
    distance: Float[Array, "n m"], valid: Bool[Array, "m"] | None = None
) -> Float[Array, "n m"]:
    """``M[i, j] = softmax_j(-D[i, j])`` over valid columns (Eq. 3); rows sum to 1."""
    if valid is not None:
        distance = jnp.where(valid[None, :], distance, _FAR)
    nearest = jax.lax.stop_gradient(row_min(distance))[:, None]
    weight = jnp.exp(nearest - distance)
    return weight / jnp.sum(weight, axis=1, keepdims=True)


class Incidence(NamedTuple):
    """A neighbour index ``idx`` (n, k), and its reverse.

    Entries ``start[j] : start[j] + count[j]`` of `member` name the points that have j as a
    neighbour, so the transpose of a gather is a gather too. On a CPU XLA runs the scatter-add that
    it would otherwise be serially, ten times slower.
    """

    idx: Int[Array, "n k"]
    member: Int[Array, "nk"]
    start: Int[Array, "n"]
    count: Int[Array, "n"]


def incidence(idx: Int[Array, "n k"]) -> Incidence:
    """Both directions of a graph over one cloud; computed once per cloud."""
    n, k = idx.shape
    neighbor = idx.ravel()
    member = jnp.repeat(jnp.arange(n, dtype=idx.dtype), k)[jnp.argsort(neighbor, stable=True)]
    count = jnp.zeros(n, idx.dtype).at[neighbor].add(1)
    return Incidence(idx, member, jnp.cumsum(count, dtype=idx.dtype) - count, count)


def neighborhood_sum(
    scores: Float[Array, "n m"],
    source_idx: Int[Array, "n k"] | Incidence,
    reference_idx: Int[Array, "m k"] | Incidence,
) -> Float[Array, "n m"]:
    """``S[i, j] = sum of scores[i', j'] over i' in N(i), j' in N(j)`` (Eq. 4), ``S = A_P M A_Q^T``.

    Nothing of size n x m x k is formed. With one neighbour per point, the 1-NN, this is
    ``scores[nearest_p][:, nearest_q]``.
    """
    source, reference = (
        idx if isinstance(idx, Incidence) else incidence(idx) for idx in (source_idx, reference_idx)
    )
    # The sum is linear, and its transpose is written out below. Of the ways to tell JAX so, only
    # custom_linear_solve works under vmap, in forward and in reverse mode; the identity stands in for
    # a system that nobody solves.
    return jax.lax.custom_linear_solve(
        lambda x: x,
        scores,
        solve=lambda _, x: _gather_both(x, source, reference),
        transpose_solve=lambda _, x: _two_passes(collect_rows, x, source, reference),
    )


def _row_peak(x: Float[Array, "n m"]) -> Float[Array, "n"]:
    """``max_j x[i, j]``; entries that share the maximum, up to rounding, share the derivative."""
    highest = at_row_min(-x)
    count = jnp.sum(highest, axis=1, dtype=x.dtype)
    return jnp.sum(jnp.where(highest, x, 0), axis=1) / count


def _two_passes(one_pass, x: Float[Array, "n m"], source: Incidence, reference: Incidence):
    return written_out(one_pass(one_pass(x, source).T, reference).T)


def _gather_both(x: Float[Array, "n m"], source: Incidence, reference: Incidence):
    if source.idx.shape[1] == reference.idx.shape[1] == 1:
        rows = x.at[source.idx[:, 0]].get(mode="promise_in_bounds")
        return rows.at[:, reference.idx[:, 0]].get(mode="promise_in_bounds")
    return _two_passes(gather_rows, x, source, reference)


def gather_rows(x: Float[Array, "n m"], graph: Incidence) -> Float[Array, "n m"]:
    """``A x``: sum of the rows of the neighbours."""

    # A loop, because XLA does not fuse across it: written out, whatever makes `x` would be computed
    # again in each of the gathers, at strided addresses.
    def add(r, total):
        return total + x.at[graph.idx[:, r]].get(mode="promise_in_bounds")

    return jax.lax.fori_loop(0, graph.idx.shape[1], add, jnp.zeros_like(x))


def collect_rows(x: Float[Array, "n m"], graph: Incidence) -> Float[Array, "n m"]:
    """``A^T x``: sum of the rows of those that have this point as a neighbour."""

    def add(r, total):
        member = graph.member[jnp.minimum(graph.start + r, graph.member.shape[0] - 1)]
        rows = x.at[member].get(mode="promise_in_bounds")
        return total + jnp.where((r < graph.count)[:, None], rows, 0)

    return jax.lax.fori_loop(0, jnp.max(graph.count), add, jnp.zeros_like(x))


def final_distance(
    distance: Float[Array, "n m"], dual: Float[Array, "n m"], *, alpha: float
) -> Float[Array, "n m"]:
    """``D' = exp(alpha - G) * (D + D-hat)`` for the summed `distance` and the map G (Eq. 5)."""
    return jnp.exp(alpha - dual) * distance


class Matches(NamedTuple):
    """The result of the matching stage.

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
    source_graph: Incidence,
    reference_graph: Incidence,
    *,
    alpha: float,
    nearest_graphs: tuple[Incidence, Incidence] | None = None,
    valid: Bool[Array, "m"] | None = None,
) -> Maps:
    """The maps M, G, F (Eq. 3-5) from D and D-hat; None for D-hat is the single neighbourhood.

    `nearest_graphs` are those of the 1-NN clouds if they differ from those of the input.
    """
    graphs, k = (source_graph, reference_graph), source_graph.idx.shape[1]
    scores, total = matching_scores(distance, valid), distance
    if nearest_distance is None:
        dual = neighborhood_sum(scores, *graphs) / k
    else:
        total, nearest = distance + nearest_distance, matching_scores(nearest_distance, valid)
        if nearest_graphs is None:  # The sum is linear: one graph, one sum.
            dual = neighborhood_sum(scores + nearest, *graphs) / k
        else:
            dual = neighborhood_sum(scores, *graphs) / k
            dual = dual + neighborhood_sum(nearest, *nearest_graphs) / k
    if valid is not None:  # A padded column has valid neighbours, and could be the peak of a row.
        dual = jnp.where(valid[None, :], dual, 0)
    dual = checkpoint_name(dual, KEPT[1])
    return Maps(scores, dual, matching_scores(final_distance(total, dual, alpha=alpha), valid))


def match(
    dual: Float[Array, "n m"], final: Float[Array, "n m"], reference: Float[Array, "m 3"]
) -> Matches:
    """The reference copy ``q~_i = sum_j F[i, j] q_j`` (Eq. 6) and the peaks of G and F."""
    copy = jnp.matmul(final, reference, precision=Precision.HIGHEST)
    return Matches(copy, _row_peak(dual), _row_peak(final))
