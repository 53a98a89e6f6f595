"""Symmetric 3x3 matrices, many at a time: eigenvectors and inverses, elementwise.

A cloud has one such matrix per point. LAPACK takes them one by one, and on clouds of more than
about 1500 points its calls have hung, waiting for XLA's thread pool (jaxlib 0.10.2, two cores).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from jaxreg._xla import varying_like

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

    They are those of the symmetric part ``(A + A^T) / 2``. Signs of the vectors are arbitrary.

    Differentiable: ``dl_k = v_k^T dA v_k`` and ``dv_k = sum_j v_j (v_j^T dA v_k) / (l_k - l_j)``
    over the eigenvalues ``l_j`` that differ from ``l_k`` by more than rounding.
    """
    matrix = (matrix + matrix.mT) / 2
    largest = jnp.max(jnp.abs(matrix), axis=(-2, -1))
    scale = jnp.where(largest > 0, largest, 1)
    # A leading axis, for the components of a column.
    entry = lambda p, q: (matrix[..., p, q] / scale)[None]  # noqa: E731
    diagonal, off = (tuple(entry(k, (k + d) % 3) for k in range(3)) for d in (0, 1))
    unit = jnp.eye(3, dtype=matrix.dtype)
    wide = range(1, 1 + scale.ndim)
    columns = tuple(varying_like(jnp.expand_dims(e, wide), scale[None]) for e in unit)
    state = jax.lax.fori_loop(0, 3 * _SWEEPS, _rotate, (diagonal, off, columns))
    pairs = list(zip(state[0], state[2], strict=True))
    for lower, upper in ((0, 1), (1, 2), (0, 1)):
        pairs[lower], pairs[upper] = _ascending(pairs[lower], pairs[upper])
    values, vectors = (jnp.stack(x, axis=-1) for x in zip(*pairs, strict=True))
    return Eigen(values[0] * scale[..., None], jnp.moveaxis(vectors, 0, -2))


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


@jax.custom_jvp
def pseudo_inverse(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3 3"]:
    """``P`` with ``P A`` the projector onto the eigenvectors that count (Moore and Penrose).

    A is the symmetric part of `matrix`.
    Those count whose eigenvalues are larger than rounding: 16 last digits of the largest, in size.
    Differentiable to every order where their number does not change (Golub and Pereyra, 1973):
    ``dP = -P dA P + P P dA (I - A P) + (I - P A) dA P P``.
    """
    values, vectors = eigh(matrix)
    size = jnp.abs(values)
    rounding = 16 * jnp.finfo(size.dtype).eps * jnp.max(size, axis=-1, keepdims=True)
    counts = size > rounding
    inverted = jnp.where(counts, 1 / jnp.where(counts, values, 1), 0)
    return _product(vectors * inverted[..., None, :], vectors.mT)


@pseudo_inverse.defjvp
def _pseudo_inverse_jvp(primals, tangents):
    matrix, change = ((x[0] + x[0].mT) / 2 for x in (primals, tangents))
    found = pseudo_inverse(matrix)
    rest = jnp.eye(3, dtype=matrix.dtype) - _product(matrix, found)
    outward = _product(_product(_product(found, found), change), rest)
    through = _product(_product(found, change), found)
    return found, outward + outward.mT - through


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=Precision.HIGHEST)


def _rotate(_, state: tuple) -> tuple:
    """The rotation that makes the first off-diagonal entry zero; then the axes are cycled.

    `off` are the entries (0, 1), (1, 2) and (2, 0). Three rotations are a sweep, and bring every
    axis back to its place. (One rotation per step is a third as much program to trace and compile.)
    """
    (a, b, c), (ab, bc, ca), (u, v, w) = state
    # The smaller root of t^2 + t (b - a) / ab - 1, without a division by `ab`.
    root = jnp.abs(b - a) + jnp.sqrt((b - a) ** 2 + 4 * ab**2)
    sign = jnp.where(b < a, -1, 1)
    tangent = jnp.where(root > 0, 2 * sign * ab / jnp.where(root > 0, root, 1), 0)
    cosine = jax.lax.rsqrt(1 + tangent**2)
    sine = tangent * cosine
    turned = lambda x, y: (cosine * x - sine * y, sine * x + cosine * y)  # noqa: E731
    (ca, bc), (u, v) = turned(ca, bc), turned(u, v)
    return (b + tangent * ab, c, a - tangent * ab), (bc, ca, jnp.zeros_like(ab)), (v, w, u)


def _ascending(one: tuple, other: tuple) -> tuple[tuple, tuple]:
    swap = one[0] > other[0]
    pick = lambda a, b: jax.tree.map(lambda x, y: jnp.where(swap, y, x), a, b)  # noqa: E731
    return pick(one, other), pick(other, one)
