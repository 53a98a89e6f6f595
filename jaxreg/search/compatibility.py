"""Which candidates fit together: second-order spatial compatibility (SC2-PCR), with normals.

A rigid motion keeps the distance between two points, the angle between their normals, and the angle
between a normal and the line that joins them. Two right candidates agree in all of these, and share
more third candidates than two wrong ones do: ``C (C C)`` counts them (Chen et al., CVPR 2022).
"""

import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg.geometry.numerics import safe_norm, safe_sqrt

DISTANCE_TOLERANCE = 0.08
"""Change of a distance, in units of the search, from which two candidates are not compatible."""
COSINE_TOLERANCE = 0.3
"""The same for the cosines of normals and lines."""


def compatibility(
    source: Float[Array, "c 3"],
    reference: Float[Array, "c 3"],
    source_normals: Float[Array, "c 3"],
    reference_normals: Float[Array, "c 3"],
    mask: Bool[Array, "c"],
    *,
    up: Float[Array, "3"] | None = None,
    tolerance: float = DISTANCE_TOLERANCE,
    cosine_tolerance: float = COSINE_TOLERANCE,
) -> Float[Array, "c c"]:
    """Soft agreement of every two candidates, in [0, 1]; 0 on the diagonal and for padding.

    The product of ``max(0, 1 - (e / tolerance)^2)`` over the change e of the distance, of
    ``|n_i . n_k|``, of ``|n_i . u_ik|`` and of ``|n_k . u_ik|`` (u from i to k; normals have no sign).
    If both clouds are level (`up`, a unit vector), also of the difference in height, and of the slope
    ``|n . up|`` of each of the two candidates.
    """
    invariants = _invariants(source, source_normals, tolerance)
    others = _invariants(reference, reference_normals, tolerance)
    agrees = _agreement(invariants[0] - others[0], tolerance)
    for one, other in zip(invariants[1:], others[1:], strict=True):
        agrees = agrees * _agreement(one - other, cosine_tolerance)
    if up is not None:
        rise, other_rise = _rises(source, up), _rises(reference, up)
        slope, other_slope = (
            jnp.abs(jnp.matmul(normals, up, precision=Precision.HIGHEST))
            for normals in (source_normals, reference_normals)
        )
        level = _agreement(slope - other_slope, cosine_tolerance)
        agrees = agrees * _agreement(rise - other_rise, tolerance) * level[:, None] * level[None, :]
    different = ~jnp.eye(source.shape[0], dtype=bool)
    return jnp.where(different & mask[:, None] & mask[None, :], agrees, 0)


def second_order(first: Float[Array, "c c"], rows: int) -> Float[Array, "rows c"]:
    """The first `rows` of ``C (C C)``, whose outer product is elementwise.

    Agreement, times how many third candidates both agree with.
    """
    return first[:rows] * jnp.matmul(first[:rows], first, precision=Precision.HIGHEST)


def spectral_weights(first: Float[Array, "*s c c"], *, steps: int = 10) -> Float[Array, "*s c"]:
    """The leading eigenvector of a non-negative matrix by power iteration, of length 1.

    If nothing agrees, all weights are equal.
    """
    weights = jnp.ones(first.shape[:-1], first.dtype)
    for _ in range(steps):
        product = jnp.matmul(first, weights[..., None], precision=Precision.HIGHEST)
        weights = product[..., 0] + 1e-6
        weights = weights / safe_norm(weights)[..., None]
    return weights


def _invariants(points: Array, normals: Array, tolerance: float) -> tuple[Array, ...]:
    """For every two points: their distance, and the cosines of n_i with n_k, n_i with u, n_k with u.

    All sums are written out and no matrix is transposed, so XLA makes one loop of it, four times as
    fast as products of matrices with three columns.
    """
    line = [points[None, :, axis] - points[:, None, axis] for axis in range(3)]
    n_i, n_k = list(normals.T[:, :, None]), list(normals.T[:, None, :])
    dot = lambda a, b: jnp.abs(sum(x * y for x, y in zip(a, b, strict=True)))  # noqa: E731
    length = safe_sqrt(line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
    # The direction of a short line is noise, so its slope is drawn towards zero.
    shorter = 1 / (length + tolerance / 2)
    return length, dot(n_i, n_k), dot(n_i, line) * shorter, dot(n_k, line) * shorter


def _rises(points: Array, up: Array) -> Array:
    height = jnp.matmul(points, up, precision=Precision.HIGHEST)
    return height[None, :] - height[:, None]


def _agreement(change: Array, tolerance: float) -> Array:
    return jnp.maximum(0, 1 - (change * (1 / tolerance)) ** 2)
