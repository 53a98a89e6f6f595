"""Which source point is paired with which reference point, and how much a pair counts."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry.neighbors import nearest_in


class Pairs(NamedTuple):
    """Pair `i` joins ``source[source_index[i]]`` to ``reference[reference_index[i]]``.

    Pairs with `mask` False are arbitrary and do not count.
    """

    source_index: Int[Any, "p"]
    reference_index: Int[Any, "p"]
    mask: Bool[Any, "p"]


def closest_pairs(
    moved: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    source_mask: Bool[Array, "n"] | None,
    reference_mask: Bool[Array, "m"] | None,
    *,
    both_directions: bool,
) -> Pairs:
    """Every moved source point with its nearest reference point.

    With `both_directions`, also every reference point with its nearest source point.
    """
    source_mask = _mask_of(moved, source_mask)
    reference_mask = _mask_of(reference, reference_mask)
    rows = jnp.arange(moved.shape[0], dtype=jnp.int32)
    forward = Pairs(
        rows, nearest_in(moved, reference, reference_mask), source_mask & jnp.any(reference_mask)
    )
    if not both_directions:
        return forward
    columns = jnp.arange(reference.shape[0], dtype=jnp.int32)
    return Pairs(
        jnp.concatenate([rows, nearest_in(reference, moved, source_mask)]),
        jnp.concatenate([forward.reference_index, columns]),
        jnp.concatenate([forward.mask, reference_mask & jnp.any(source_mask)]),
    )


def with_neighbors(
    pairs: Pairs,
    source_neighbors: Int[Array, "n k"],
    reference_neighbors: Int[Array, "m k"],
    *,
    forward: int,
) -> Pairs:
    """`pairs`, plus the pairs of the same points with the neighbours of their partners.

    Several planes locate a noisy surface better than one does. The first `forward` pairs are those
    of the source's points, the others of the reference's.
    """
    source, reference = pairs.source_index, pairs.reference_index
    k = source_neighbors.shape[1]
    near_reference = reference_neighbors[reference[:forward]]
    near_source = source_neighbors[source[forward:]]
    again = lambda index: jnp.repeat(index[:, None], k, axis=1)  # noqa: E731
    more_source = jnp.concatenate([again(source[:forward]), near_source])
    more_reference = jnp.concatenate([near_reference, again(reference[forward:])])
    return Pairs(
        jnp.concatenate([source, more_source.ravel()]),
        jnp.concatenate([reference, more_reference.ravel()]),
        jnp.concatenate([pairs.mask, again(pairs.mask).ravel()]),
    )


def _mask_of(points: Array, mask: Array | None) -> Array:
    return jnp.ones(points.shape[0], bool) if mask is None else mask
