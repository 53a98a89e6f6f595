"""Candidate correspondences: the best matches of every point, in both directions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class Candidates(NamedTuple):
    """``source[source_index[c]]`` may be ``reference[reference_index[c]]``; False: not a candidate."""

    source_index: Int[Array, "c"]
    reference_index: Int[Array, "c"]
    mask: Bool[Array, "c"]


MATCHES = 3
"""How many of the most similar points become candidates of a point, in both directions."""
_MUTUAL_BONUS = 0.05
"""Added to the margin of two points that are each other's best match (cosines are in [-1, 1])."""


def select_candidates(
    similarity: Float[Array, "n m"],
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    *,
    keep: int,
    matches: int = MATCHES,
) -> Candidates:
    """The `keep` clearest of the best `matches` of every row and of every column.

    A match is clear by its margin: how far its similarity lies above the best one that is *not*
    among the `matches` of its row (column), plus a bonus if it is mutually the best. A match in
    both lists counts once. With fewer than `keep`, the rest is masked out.

    Raises:
      ValueError: not ``1 <= matches < min(n, m)``.
    """
    n, m = similarity.shape
    if not 1 <= matches < min(n, m):
        raise ValueError(
            f"matches = {matches} per point need clouds of more points, got {n} and {m}: "
            "choose 1 <= matches < min(n, m)."
        )
    keep = min(keep, (n + m) * matches)
    valid = jnp.ones((n, m), bool)
    if source_mask is not None:
        valid = valid & source_mask[:, None]
    if reference_mask is not None:
        valid = valid & reference_mask[None, :]
    similarity = jnp.where(valid, similarity, -jnp.inf)
    by_row, column = _best(similarity, matches)
    by_column, row = _best(similarity.T, matches)
    rows, columns = (jnp.repeat(jnp.arange(x, dtype=row.dtype), matches) for x in (n, m))
    source = jnp.concatenate([rows, row.reshape(-1)])
    reference = jnp.concatenate([column.reshape(-1), columns])
    value = similarity[source, reference]
    # If nothing else is valid, the margin is that over the least possible cosine.
    margins = [
        (best[:, :-1] - jnp.maximum(best[:, -1:], -1)).reshape(-1) for best in (by_row, by_column)
    ]
    mutual = (value >= by_row[source, 0]) & (value >= by_column[reference, 0])
    clarity = jnp.concatenate(margins) + jnp.where(mutual, _MUTUAL_BONUS, 0)
    listed = (jnp.arange(value.shape[0]) >= n * matches) & (value >= by_row[source, matches - 1])
    clarity = jnp.where(listed | jnp.isneginf(value), -jnp.inf, clarity)
    clarity, chosen = jax.lax.top_k(clarity, keep)
    return Candidates(
        source[chosen].astype(jnp.int32),
        reference[chosen].astype(jnp.int32),
        jnp.isfinite(clarity),
    )


def _best(similarity: Array, matches: int) -> tuple[Array, Array]:
    """Values of the best ``matches + 1`` of every row, and the columns of the best `matches`."""
    _, index = jax.lax.top_k(similarity, matches + 1)
    # The barrier keeps XLA from turning the selection into a full sort when it is sliced. Around the
    # pair that `top_k` returns it would abort the process under `jax.pmap` and `jax.shard_map`
    # (jaxlib 0.10.2), so the values are read again.
    index = jax.lax.optimization_barrier(index)
    return jnp.take_along_axis(similarity, index, axis=1), index[:, :matches]
