"""Symmetric 3x3 matrices, many at a time: eigenvectors and the inverse, elementwise.

A cloud has one such matrix per point. LAPACK takes them one by one, and its calls have waited for
XLA's thread pool forever on clouds of more than some 1500 points (jaxlib 0.10.2, two cores).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

_SWEEPS = 5
"""Sweeps of Jacobi rotations. The convergence is quadratic: after four, a million matrices, some of
them nearly singular or with equal eigenvalues, are diagonal to the rounding of float64."""


class Eigen(NamedTuple):
    """Eigenvalues in ascending order, and their unit eigenvectors as columns."""

    values: Float[Array, "*n 3"]
    vectors: Float[Array, "*n 3 3"]


@jax.custom_jvp
def eigh(matrix: Float[Array, "*n 3 3"]) -> Eigen:
    """Eigenvalues and eigenvectors by cyclic Jacobi rotations (Golub and Van Loan, section 8.5).

    Of the symmetric part ``(A + A^T) / 2``. Signs of the vectors are arbitrary.

    Differentiable: ``dl_k = v_k^T dA v_k`` and ``dv_k = sum_j v_j (v_j^T dA v_k) / (l_k - l_j)``
    over the eigenvalues ``l_j`` that differ from ``l_k`` by more than rounding.
    """
    matrix = (matrix + matrix.mT) / 2
    largest = jnp.max(jnp.abs(matrix), axis=(-2, -1))
    scale = jnp.where(largest > 0, largest, 1)
    entries = {(p, q): matrix[..., p, q] / scale for p in range(3) for q in range(p, 3)}
    one, zero = jnp.ones_like(scale), jnp.zeros_like(scale)
    columns = [[one if k == axis else zero for axis in range(3)] for k in range(3)]
    entries, columns = jax.lax.fori_loop(
        0, _SWEEPS, lambda _, state: _sweep(*state), (entries, columns)
    )
    pairs = [(entries[k, k] * scale, columns[k]) for k in range(3)]
    for lower, upper in ((0, 1), (1, 2), (0, 1)):
        pairs[lower], pairs[upper] = _ascending(pairs[lower], pairs[upper])
    vectors = [jnp.stack(column, axis=-1) for _, column in pairs]
    return Eigen(jnp.stack([value for value, _ in pairs], axis=-1), jnp.stack(vectors, axis=-1))


@eigh.defjvp
def _eigh_jvp(primals, tangents):
    found = eigh(*primals)
    change = (tangents[0] + tangents[0].mT) / 2
    inner = _product(_product(found.vectors.mT, change), found.vectors)
    gap = found.values[..., None, :] - found.values[..., :, None]
    rounding = jnp.finfo(gap.dtype).eps * jnp.max(jnp.abs(found.values), axis=-1)
    equal = jnp.abs(gap) <= rounding[..., None, None]
    turning = jnp.where(equal, 0, inner / jnp.where(equal, 1, gap))
    values = jnp.diagonal(inner, axis1=-2, axis2=-1)
    return found, Eigen(values, _product(found.vectors, turning))


def inverse(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3 3"]:
    """Inverse by cofactors."""
    a, b, c = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    determinant = jnp.sum(a * cofactors[..., :, 0], axis=-1)
    return cofactors / determinant[..., None, None]


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=Precision.HIGHEST)


def _sweep(entries: dict, columns: list) -> tuple[dict, list]:
    """One rotation in each coordinate plane; each makes one entry off the diagonal zero."""
    entries, columns = dict(entries), list(columns)
    for p, q in ((0, 1), (0, 2), (1, 2)):
        off, difference = entries[p, q], entries[q, q] - entries[p, p]
        # The smaller root of t^2 + t difference / off - 1, without a division by `off`.
        root = jnp.abs(difference) + jnp.sqrt(difference**2 + 4 * off**2)
        sign = jnp.where(difference < 0, -1, 1)
        tangent = jnp.where(root > 0, 2 * sign * off / jnp.where(root > 0, root, 1), 0)
        cosine = jax.lax.rsqrt(1 + tangent**2)
        sine = tangent * cosine
        rotate = lambda x, y, c=cosine, s=sine: (c * x - s * y, s * x + c * y)  # noqa: E731
        entries[p, p] = entries[p, p] - tangent * off
        entries[q, q] = entries[q, q] + tangent * off
        entries[p, q] = jnp.zeros_like(off)
        third = 3 - p - q
        with_p, with_q = tuple(sorted((p, third))), tuple(sorted((q, third)))
        entries[with_p], entries[with_q] = rotate(entries[with_p], entries[with_q])
        turned = [rotate(x, y) for x, y in zip(columns[p], columns[q], strict=True)]
        columns[p], columns[q] = [x for x, _ in turned], [y for _, y in turned]
    return entries, columns


def _ascending(one: tuple, other: tuple) -> tuple[tuple, tuple]:
    swap = one[0] > other[0]
    pick = lambda a, b: jax.tree.map(lambda x, y: jnp.where(swap, y, x), a, b)  # noqa: E731
    return pick(one, other), pick(other, one)
