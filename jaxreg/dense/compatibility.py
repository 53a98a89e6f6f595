"""Which candidates fit together: second-order spatial compatibility (SC2-PCR), with normals.

A rigid motion keeps the distance of two points, the angle of their normals and the angle between a
normal and the line that joins them. Two right candidates agree in all of these, and share more
third candidates than two wrong ones do: ``C (C C)`` counts them (Chen et al., CVPR 2022).
"""

import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg.neighbors import squared_distances
from jaxreg.numerics import safe_norm, safe_sqrt


def compatibility(
    source: Float[Array, "c 3"],
    reference: Float[Array, "c 3"],
    source_normals: Float[Array, "c 3"],
    reference_normals: Float[Array, "c 3"],
    mask: Bool[Array, "c"],
    *,
    tolerance: float,
    normal_tolerance: float,
) -> Float[Array, "c c"]:
    """Soft agreement of every two candidates, in [0, 1]; 0 on the diagonal and for padding.

    The product of ``max(0, 1 - (e / tolerance)^2)`` over the change e of the distance, of
    ``|n_i . n_k|``, of ``|n_i . u_ik|`` and of ``|n_k . u_ik|`` (u from i to k; normals have no sign).
    """
    length, facing, slope = _invariants(source, source_normals, tolerance)
    other_length, other_facing, other_slope = _invariants(reference, reference_normals, tolerance)
    slope_agrees = _agreement(slope - other_slope, normal_tolerance)
    agrees = (
        _agreement(length - other_length, tolerance)
        * _agreement(facing - other_facing, normal_tolerance)
        * slope_agrees
        * slope_agrees.T
    )
    different = ~jnp.eye(source.shape[0], dtype=bool)
    return jnp.where(different & mask[:, None] & mask[None, :], agrees, 0)


def second_order(first: Float[Array, "c c"]) -> Float[Array, "c c"]:
    """``C (C C)``, elementwise outside: agreement, times how many third candidates both agree with."""
    return first * jnp.matmul(first, first, precision=Precision.HIGHEST)


def spectral_weights(first: Float[Array, "*s c c"], *, steps: int = 10) -> Float[Array, "*s c"]:
    """The leading eigenvector of a non-negative matrix by power iteration, of length 1.

    Where nothing agrees, all weights are equal.
    """
    weights = jnp.ones(first.shape[:-1], first.dtype)
    for _ in range(steps):
        weights = jnp.matmul(first, weights[..., None])[..., 0] + 1e-6
        weights = weights / safe_norm(weights)[..., None]
    return weights


def _invariants(points: Array, normals: Array, tolerance: float) -> tuple[Array, Array, Array]:
    length = safe_sqrt(squared_distances(points, points))
    facing = jnp.abs(jnp.matmul(normals, normals.T, precision=Precision.HIGHEST))
    along = jnp.matmul(normals, points.T, precision=Precision.HIGHEST)
    height = jnp.abs(along - jnp.sum(normals * points, axis=1, keepdims=True))
    # The direction of a short line is noise, so its slope is drawn towards zero.
    return length, facing, height / (length + tolerance / 2)


def _agreement(change: Array, tolerance: float) -> Array:
    return jnp.maximum(0, 1 - (change / tolerance) ** 2)
