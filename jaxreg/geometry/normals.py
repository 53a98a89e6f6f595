"""Normals and plane-like covariances of a cloud, from the principal components of neighbourhoods."""

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry import arguments, eigen3x3
from jaxreg.geometry.neighbors import without_padding
from jaxreg.geometry.numerics import safe_norm

_SMALLEST_GAP = 1e-3
"""Least difference of the two smaller eigenvalues, over the sum of all three, at which a
neighbourhood has a normal. Float32 noise is far below it, a plane far above."""
_OPEN, _OPEN_WIDTH = 0.4, 0.03
"""Mean offset of the neighbours along the surface, over their mean distance, at which an edge begins.
Half a disc has 0.64, a whole one of 16 random points 0.27 by chance."""


def neighborhood_covariances(
    points: Float[Array, "n 3"], neighbors: Int[Array, "n k"], mask: Bool[Array, "n"] | None = None
) -> Float[Array, "n 3 3"]:
    """Covariance of every point together with its neighbours, ``1/c sum (x - mean)(x - mean)^T``.

    `neighbors` are rows of `points`, as `jaxreg.knn` gives them; a point that fills its own list
    counts once, and a row that does not exist is left out. Padded rows give zero.

    Raises:
      ValueError: a shape or a dtype is wrong; the message names the argument.
    """
    offsets, weight = _offsets(points, neighbors, mask)
    total = jnp.maximum(jnp.sum(weight, axis=1), 1)
    centred = (offsets - (jnp.sum(weight * offsets, axis=1) / total)[:, None, :]) * weight
    product = jnp.matmul(centred.mT, centred, precision=Precision.HIGHEST)
    return product / total[..., None]


def _offsets(points, neighbors, mask) -> tuple[Array, Array]:
    """Offsets from every point to itself and its neighbours (n, k + 1, 3); 1 if one counts, else 0."""
    points = arguments.cloud("points", points)
    neighbors = arguments.indices("neighbors", neighbors, points.shape[0])
    mask = arguments.mask("mask", mask, points.shape[0])
    points = without_padding(points, mask)
    own = jnp.arange(points.shape[0], dtype=neighbors.dtype)[:, None]
    # As a k-d tree of scipy says that there is no such neighbour; clamped it would be the last point.
    neighbors = jnp.where((neighbors < 0) | (neighbors >= points.shape[0]), own, neighbors)
    counts = jnp.concatenate([jnp.ones_like(own, bool), neighbors != own], axis=1)
    if mask is not None:
        counts = counts & mask[:, None]
    # Relative to the point itself, so the mean of near points loses no digits to a far origin.
    offsets = points[jnp.concatenate([own, neighbors], axis=1)] - points[:, None, :]
    return offsets, counts.astype(points.dtype)[..., None]


def normals(
    points: Float[Array, "n 3"], neighbors: Int[Array, "n k"], mask: Bool[Array, "n"] | None = None
) -> Float[Array, "n 3"]:
    """Unit normal of the plane through every point and its neighbours; its sign is arbitrary.

    The eigenvector of the smallest eigenvalue of the neighbourhood's covariance. Zero if the
    neighbourhood has no normal: a line, a point, an isotropic ball, padding.

    Differentiable, with the derivative of the eigenvector where there is a normal and 0 elsewhere:
    the gap of the eigenvalues that it divides by is bounded away from zero.

    Raises:
      ValueError: a shape or a dtype is wrong; the message names the argument.
    """
    return smallest_eigenvector(neighborhood_covariances(points, neighbors, mask))


def edge_normals(
    points: Float[Array, "n 3"],
    neighbors: Int[Array, "n k"],
    unit_normals: Float[Array, "n 3"],
    mask: Bool[Array, "n"] | None = None,
) -> Float[Array, "n 3"]:
    """Inward direction in the surface, across its edge: length 1 on an edge, 0 away from all edges.

    On the edge of a plate all neighbours lie on one side; `unit_normals` are those of `normals`.

    Raises:
      ValueError: a shape or a dtype is wrong; the message names the argument.
    """
    offsets, weight = _offsets(points, neighbors, mask)
    unit_normals = arguments.rows("unit_normals", unit_normals, jnp.shape(points), offsets)
    offsets = offsets * weight
    across = jnp.sum(offsets * unit_normals[:, None, :], axis=-1, keepdims=True)
    along = offsets - across * unit_normals[:, None, :]
    inward = jnp.sum(along, axis=1)
    length, total = safe_norm(inward), jnp.sum(safe_norm(along), axis=1)
    openness = length / jnp.where(total > 0, total, 1)
    # The root of a share, because covariances take the square.
    share = jnp.exp(0.5 * jax.nn.log_sigmoid((openness - _OPEN) / _OPEN_WIDTH))
    return inward * (share / jnp.where(length > 0, length, 1))[:, None]


def surface_covariances(
    unit_normals: Float[Array, "n 3"],
    epsilon: float,
    edges: Float[Array, "n 3"] | None = None,
) -> Float[Array, "n 3 3"]:
    """``I - (1 - e) n n^T``: variance 1 along the plane, ``e = epsilon`` across it.

    The regularisation of generalised ICP (Segal, Haehnel and Thrun, 2009, section III.B). A zero
    normal gives the identity: nothing is known about the surface there.

    With `edges` (`edge_normals`) the surface also ends: ``- (1 - e) b b^T`` with ``b`` across its
    edge. On an edge the distance across it fixes the point, and nothing else shows how far one of
    two plates has slid along the other. Only an edge meets an edge: a point whose partner lies
    inside a surface is as free as before.

    Raises:
      ValueError: a shape or a dtype is wrong, or not ``0 < epsilon <= 1``: two surfaces without any
        thickness have no finite cost.
    """
    unit_normals = arguments.cloud("unit_normals", unit_normals)
    if edges is not None:
        edges = arguments.rows("edges", edges, unit_normals.shape, unit_normals)
    thickness = arguments.scalar("epsilon", epsilon, unit_normals.dtype)
    if not isinstance(epsilon, Tracer) and epsilon > 1:
        raise ValueError(f"epsilon = {epsilon}: choose 0 < epsilon <= 1.")
    outer = unit_normals[:, :, None] * unit_normals[:, None, :]
    if edges is not None:
        outer = outer + edges[:, :, None] * edges[:, None, :]
    return jnp.eye(3, dtype=outer.dtype)[None] - (1 - thickness) * outer


def smallest_eigenvector(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """Unit eigenvector of the smallest eigenvalue, or zero where the two smaller ones are equal."""
    values, vectors = eigen3x3.eigh(matrix)
    found = values[..., 1] - values[..., 0] > _SMALLEST_GAP * jnp.sum(values, axis=-1)
    return jnp.where(found[..., None], vectors[..., 0], 0)
