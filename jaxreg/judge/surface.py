"""A cloud as the judge of poses sees it, with what is computed once from the cloud alone."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry.neighbors import without_padding
from jaxreg.geometry.normals import edge_normals, neighborhood_covariances
from jaxreg.geometry.numerics import safe_norm, safe_sqrt

NEIGHBORS = 16
"""Neighbours of the neighbourhood whose roughness counts."""
_ALIKE = 0.95
"""Normals with at least this |cosine| face one way."""
_RAREST = 0.02
"""Smallest share of a direction, so that a single wild normal does not weigh for all."""
_ROWS = 256
"""Rows of the table of all pairs of normals that are held in memory at once."""


class Examined(NamedTuple):
    """Points of a surface with unit normals of any sign; rows with `mask` False are padding.

    `variation` is the surface variation (Pauly, Gross and Kobbelt, 2002) of the neighbourhood, 0 on
    a plane and at most 1/3; `rarity` is one over the share of the cloud that faces the same way;
    `interior` is 1 within the surface and 0 where it ends;
    `spacing` is the median distance from a point to its fourth neighbour.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    variation: Float[Array, "n"]
    rarity: Float[Array, "n"]
    interior: Float[Array, "n"]
    mask: Bool[Array, "n"]
    spacing: Float[Array, ""]


def examine(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    neighbors: Int[Array, "n k"],
    mask: Bool[Array, "n"] | None = None,
) -> Examined:
    """`Examined` of a cloud; `neighbors`, usually NEIGHBORS, are rows of it, the nearest first."""
    mask = jnp.ones(len(points), bool) if mask is None else mask
    points, normals = without_padding(points, mask), without_padding(normals, mask)
    covariance = neighborhood_covariances(points, neighbors, mask)
    # The normal is the direction of the smallest eigenvalue, so that none is computed again.
    least = jnp.einsum("ni,nij,nj->n", normals, covariance, normals, precision=Precision.HIGHEST)
    total = jnp.trace(covariance, axis1=1, axis2=2)
    variation = jnp.maximum(least, 0) / jnp.where(total > 0, total, 1)
    rarity = 1 / jnp.maximum(_share_alike(normals, mask), _RAREST)
    interior = 1 - safe_norm(edge_normals(points, neighbors, normals, mask))
    spacing = _fourth_spacing(points, neighbors, mask)
    return Examined(points, normals, variation, rarity, interior, mask, spacing)


def every(cloud: Examined, step: int) -> Examined:
    """Every `step`-th point, with the spacing of all."""
    thinned = {name: getattr(cloud, name)[::step] for name in Examined._fields[:-1]}
    return Examined(**thinned, spacing=cloud.spacing)


def _fourth_spacing(
    points: Float[Array, "n 3"], neighbors: Int[Array, "n k"], mask: Bool[Array, "n"]
) -> Float[Array, ""]:
    """Median over the points of the distance to the fourth of `neighbors`, the nearest first.

    On a surface covered by squares of edge a, one point each, this is about a.
    """
    fourth = neighbors[:, min(3, neighbors.shape[1] - 1)]
    squared = jnp.sum((points - points[fourth]) ** 2, axis=1)
    median = jnp.nanmedian(jnp.where(mask, squared, jnp.nan))
    return safe_sqrt(jnp.where(jnp.any(mask), median, 0))


def _share_alike(normals: Float[Array, "n 3"], mask: Bool[Array, "n"]) -> Float[Array, "n"]:
    count = jnp.maximum(jnp.sum(mask, dtype=normals.dtype), 1)

    def row(normal: Float[Array, "3"]) -> Float[Array, ""]:
        cosine = jnp.abs(jnp.matmul(normals, normal, precision=Precision.HIGHEST))
        return jnp.sum(mask & (cosine > _ALIKE), dtype=normals.dtype) / count

    return jax.lax.map(row, normals, batch_size=_ROWS)
