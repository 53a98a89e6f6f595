"""Multi-scale moment descriptors: how the points, and their normals, lie around every point.

Everything is a Gaussian-weighted mean over the whole cloud, so one product of the weights (n, n)
with a table (n, 21) gives every point's statistics: no neighbour lists, no histograms.
"""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import eigen3x3
from jaxreg.geometry.numerics import safe_norm, safe_sqrt

NORMAL_RADIUS = 0.15
"""Radius of the neighbourhood of a normal, in units of the search."""
OPENNESS_RADIUS = 0.3
"""Radius at which openness is measured, in units of the search."""
INVARIANTS = 16
"""Features of a point at each radius."""
_SMALLEST_NORM = 1e-9


def gaussian_normals(
    points: Float[Array, "n 3"],
    squared: Float[Array, "n n"],
    mask: Bool[Array, "n"],
    *,
    radius: float = NORMAL_RADIUS,
) -> Float[Array, "n 3"]:
    """Unit normals of arbitrary sign, zero for padding.

    The direction of the smallest variance of the points around each, weighted by
    ``exp(-|p_j - p|^2 / (2 (radius/2)^2))``; `squared` are the squared distances within the cloud.
    Constants of every derivative, as the moments are.
    """
    points, squared = jax.lax.stop_gradient((points, squared))
    table = jnp.concatenate([points, _outer(points)], axis=1)
    means = _means(squared, table, mask, radius)
    spread = means[:, 3:].reshape(-1, 3, 3) - means[:, :3, None] * means[:, None, :3]
    return jnp.where(mask[:, None], eigen3x3.eigh(spread).vectors[:, :, 0], 0)


def moments(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    squared: Float[Array, "n n"],
    mask: Bool[Array, "n"],
    *,
    radii: tuple[float, ...],
) -> Float[Array, "n d"]:
    """Sixteen invariants of every point at each of `radii` (unit of the cloud).

    With weights ``exp(-|p_j - p|^2 / (2 (r/2)^2))`` let ``o`` be the offset from the point p to the
    weighted centroid, C the covariance of the points, ``N = E[n_j n_j^T]`` that of the normals, and
    ``v_k`` the eigenvectors of C. The invariants are the square roots of the eigenvalues of C over
    r, ``|o . v_k| / r``, the roots of the eigenvalues of N and of ``v_k^T N v_k``, and their
    relation to the point's own normal n: ``|o . n| / r``, ``|o - n (o . n)| / r``,
    ``sqrt(n^T C n) / r``, ``sqrt(n^T N n)`` (normals have no sign, so each enters squared).

    The points should lie around the origin, since C is a difference of means of squares. A constant
    of every derivative: which points match is a discrete choice.
    """
    points, normals, squared = jax.lax.stop_gradient((points, normals, squared))
    table = jnp.concatenate([points, _outer(points), _outer(normals)], axis=1)
    # One scale after the other: a third faster than all at once, whose weights (n, n) leave the cache.
    blocks = jax.lax.map(
        lambda radius: _at_scale(points, normals, squared, table, mask, radius),
        jnp.asarray(radii, points.dtype),
    )
    return jnp.concatenate(list(blocks), axis=1)


def standardized(
    source: Float[Array, "n d"],
    reference: Float[Array, "m d"],
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
) -> tuple[Float[Array, "n d"], Float[Array, "m d"]]:
    """Features in units of their deviation over both clouds, then of length 1 (0 for padding)."""
    masks = [
        jnp.ones(features.shape[0], bool) if mask is None else mask
        for features, mask in ((source, source_mask), (reference, reference_mask))
    ]
    both, valid = jnp.concatenate([source, reference]), jnp.concatenate(masks)[:, None]
    both = jnp.where(valid, both, 0)
    count = jnp.maximum(jnp.sum(valid), 1).astype(both.dtype)
    mean = jnp.sum(both, axis=0) / count
    centred = jnp.where(valid, both - mean[None, :], 0)
    deviation = safe_sqrt(jnp.sum(centred**2, axis=0) / count)
    centred = centred / jnp.where(deviation > _SMALLEST_NORM, deviation, 1)[None, :]
    unit = centred / jnp.maximum(safe_norm(centred), _SMALLEST_NORM)[:, None]
    return unit[: source.shape[0]], unit[source.shape[0] :]


def openness(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    squared: Float[Array, "n n"],
    mask: Bool[Array, "n"],
    *,
    radius: float = OPENNESS_RADIUS,
) -> Float[Array, "n"]:
    """How one-sided the surface around a point is: 0 inside it, about 0.4 on a straight edge.

    The length, over `radius`, of the tangential part of the offset to the weighted centroid. The
    boundary of a scan is open; so is the end of a thin part.
    """
    mean = _means(squared, points, mask, radius)
    offset = mean - points
    along = jnp.sum(offset * normals, axis=1, keepdims=True)
    return safe_norm(offset - along * normals) / radius


def mean_spacing(squared: Float[Array, "n n"], mask: Bool[Array, "n"]) -> Float[Array, ""]:
    """Mean distance from a point to the nearest other one; 0 with fewer than two points."""
    other = mask[None, :] & ~jnp.eye(len(mask), dtype=bool)
    nearest = jnp.min(jnp.where(other, squared, jnp.inf), axis=1)
    count = jnp.sum(mask)
    total = jnp.sum(jnp.where(mask & (count > 1), safe_sqrt(nearest), 0))
    return total / jnp.maximum(count, 1).astype(total.dtype)


def _at_scale(
    points: Array, normals: Array, squared: Array, table: Array, valid: Array, radius: Array
) -> Array:
    means = _means(squared, table, valid, radius)
    offset = means[:, :3] - points
    spread = means[:, 3:12].reshape(-1, 3, 3) - means[:, :3, None] * means[:, None, :3]
    facing = means[:, 12:21].reshape(-1, 3, 3)
    values, vectors = eigen3x3.eigh(spread)
    along = jnp.sum(offset * normals, axis=1)
    own = [
        jnp.abs(along) / radius,
        safe_norm(offset - along[:, None] * normals) / radius,
        safe_sqrt(_quadratic(normals, spread)) / radius,
        safe_sqrt(_quadratic(normals, facing)),
    ]
    columns = jnp.swapaxes(vectors, 1, 2)
    return jnp.concatenate(
        [
            safe_sqrt(values) / radius,
            jnp.abs(jnp.sum(columns * offset[:, None], axis=-1)) / radius,
            safe_sqrt(eigen3x3.eigh(facing).values),
            safe_sqrt(_quadratic(columns, facing[:, None])),
            jnp.stack(own, axis=1),
        ],
        axis=1,
    )


def _means(squared: Array, table: Array, valid: Array, radius: Array | float) -> Array:
    """Gaussian-weighted mean of the rows of `table` around every point."""
    weights = jnp.where(valid[None, :], jnp.exp(-squared / (2 * (radius / 2) ** 2)), 0)
    total = jnp.maximum(jnp.sum(weights, axis=1, keepdims=True), _SMALLEST_NORM)
    return jnp.matmul(weights, table, precision=Precision.HIGHEST) / total


def _outer(vectors: Array) -> Array:
    return (vectors[:, :, None] * vectors[:, None, :]).reshape(-1, 9)


def _quadratic(vectors: Array, matrices: Array) -> Array:
    """``v^T A v`` over leading axes."""
    turned = jnp.matmul(matrices, vectors[..., None], precision=Precision.HIGHEST)[..., 0]
    return jnp.sum(vectors * turned, axis=-1)
