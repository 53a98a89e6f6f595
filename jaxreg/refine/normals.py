"""Normals and plane-like covariances of a cloud, by the principal components of neighbourhoods."""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg.neighbors import without_padding

_SMALLEST_GAP = 1e-3
"""Least difference of the two smaller eigenvalues, over the sum of all three, at which a
neighbourhood has a normal. Noise of float32 is far below, a plane far above."""


def neighborhood_covariances(
    points: Float[Array, "n 3"], neighbors: Int[Array, "n k"], mask: Bool[Array, "n"] | None = None
) -> Float[Array, "n 3 3"]:
    """Covariance of every point together with its neighbours, ``1/c sum (x - mean)(x - mean)^T``.

    `neighbors` are rows of `points`, as `jaxreg.knn` gives them; a point that fills its own list
    counts once. Padded rows give zero.
    """
    points = without_padding(points, mask)
    own = jnp.arange(points.shape[0], dtype=neighbors.dtype)[:, None]
    counts = jnp.concatenate([jnp.ones_like(own, bool), neighbors != own], axis=1)
    if mask is not None:
        counts = counts & mask[:, None]
    weight = counts.astype(points.dtype)[..., None]
    total = jnp.maximum(jnp.sum(weight, axis=1), 1)
    # Relative to the point itself: the mean of near points loses no digits to a far origin.
    edges = points[jnp.concatenate([own, neighbors], axis=1)] - points[:, None, :]
    centred = (edges - (jnp.sum(weight * edges, axis=1) / total)[:, None, :]) * weight
    product = jnp.matmul(centred.mT, centred, precision=Precision.HIGHEST)
    return product / total[..., None]


def normals(
    points: Float[Array, "n 3"], neighbors: Int[Array, "n k"], mask: Bool[Array, "n"] | None = None
) -> Float[Array, "n 3"]:
    """Unit normal of the plane through every point and its neighbours; its sign is arbitrary.

    The eigenvector of the smallest eigenvalue of the neighbourhood's covariance. Zero where the
    neighbourhood has no normal: a line, a point, an isotropic ball, padding.

    Differentiable, with the derivative of the eigenvector where there is a normal and 0 elsewhere:
    the gap of the eigenvalues that it divides by is bounded away from zero.
    """
    return jax.vmap(smallest_eigenvector)(neighborhood_covariances(points, neighbors, mask))


def plane_covariances(unit_normals: Float[Array, "n 3"], thickness: float) -> Float[Array, "n 3 3"]:
    """``I - (1 - thickness) n n^T``: variance 1 along the plane, `thickness` across it.

    The regularisation of generalised ICP (Segal, Haehnel and Thrun, 2009, section III.B). A zero
    normal gives the identity: nothing is known about the surface there.
    """
    outer = unit_normals[:, :, None] * unit_normals[:, None, :]
    return jnp.eye(3, dtype=outer.dtype)[None] - (1 - thickness) * outer


def smallest_eigenvector(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Unit eigenvector of the smallest eigenvalue, or zero where the two smaller ones are equal."""
    # The vector does not depend on the scale, so the scale may be a constant of the derivative.
    scale = jax.lax.stop_gradient(jnp.trace(matrix))
    return _smallest_eigenvector(matrix / jnp.where(scale > 0, scale, 1))


@jax.custom_jvp
def _smallest_eigenvector(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    values, vectors = jnp.linalg.eigh(matrix)
    return jnp.where(values[1] - values[0] > _SMALLEST_GAP, vectors[:, 0], 0)


@_smallest_eigenvector.defjvp
def _smallest_eigenvector_jvp(primals, tangents):
    """``dn = (l I - C)^+ dC n``: the pseudo-inverse leaves out only n itself.

    ``C - l I + n n^T`` has the eigenvalues of the gaps, and 1, so that it is inverted as it is.
    """
    (matrix,), (matrix_dot,) = primals, tangents
    normal = _smallest_eigenvector(matrix)
    found = jnp.any(normal != 0)
    value = normal @ matrix @ normal
    identity = jnp.eye(3, dtype=matrix.dtype)
    system = matrix - value * identity + jnp.outer(normal, normal)
    system = jnp.where(found, system, identity)
    turned = ((matrix_dot + matrix_dot.T) / 2) @ normal
    turned = turned - normal * jnp.dot(normal, turned)
    return normal, jnp.where(found, -inverse_symmetric(system) @ turned, 0)


def inverse_symmetric(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3 3"]:
    """Inverse of symmetric 3x3 matrices by cofactors, which needs no loop over LAPACK calls."""
    a, b, c = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    determinant = jnp.sum(a * cofactors[..., :, 0], axis=-1)
    return cofactors / determinant[..., None, None]
