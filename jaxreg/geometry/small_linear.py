"""Factors and inverses of small matrices in plain JAX: one matrix, or under `jax.vmap` any number.

XLA:CPU takes the matrices of a batch to LAPACK one after the other, in custom calls that wait for
its thread pool: two threads with a batch of two thousand wait for each other for ever (jaxlib 0.10.2,
two cores). No function that may be batched calls LAPACK; `eigen3x3` is for whole clouds of matrices.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

_SWEEPS = {32: 6, 64: 7}
"""Sweeps of Jacobi rotations for numbers of so many bits. After five and six the columns of a hundred
thousand random, graded and singular matrices of six rows were orthogonal to rounding."""


class SingularVectors(NamedTuple):
    """``A V``, whose columns are orthogonal and as long as the singular values, and the orthogonal V.

    Columns come in no order. Those of ``A V`` divided by their lengths are the left vectors.
    """

    scaled_left: Float[Array, "n n"]
    right: Float[Array, "n n"]


def singular_vectors(matrix: Float[Array, "n n"]) -> SingularVectors:
    """Singular value decomposition by one-sided Jacobi rotations (Hestenes, 1958), for even n.

    Of a positive semi-definite matrix V are the eigenvectors, and ``A V`` their multiples by the
    eigenvalues. Has no derivative in reverse mode: give what is made of it its own.
    """
    n = matrix.shape[0]
    largest = jnp.max(jnp.abs(matrix))
    scale = jnp.where(largest > 0, largest, 1)
    # Row k holds column k of A V and column k of V, which turn alike.
    rows = jnp.concatenate([(matrix / scale).T, jnp.eye(n, dtype=matrix.dtype)], axis=1)
    steps = (n - 1) * _SWEEPS[jnp.finfo(matrix.dtype).bits]
    rows = jax.lax.fori_loop(0, steps, _rotate_pairs, rows)
    return SingularVectors(rows[:, :n].T * scale, rows[:, n:].T)


def _rotate_pairs(_, rows: Float[Array, "n w"]) -> Float[Array, "n w"]:
    """Make row k and row n/2 + k orthogonal (of A V), for all k; then pair the rows anew.

    The first row keeps its place and the others move on by one, so that n - 1 steps are a sweep:
    every row meets every other, and all are back in their places.
    """
    n = rows.shape[0]
    one, other = rows[: n // 2], rows[n // 2 :]
    product = lambda a, b: jnp.sum(a[:, :n] * b[:, :n], axis=1)  # noqa: E731
    gap, inner = product(other, other) - product(one, one), product(one, other)
    # The smaller root of t^2 + t gap / inner - 1, without a division by `inner`.
    root = jnp.abs(gap) + jnp.sqrt(gap**2 + 4 * inner**2)
    sign = jnp.where(gap < 0, -1, 1)
    tangent = jnp.where(root > 0, 2 * sign * inner / jnp.where(root > 0, root, 1), 0)
    cosine = 1 / jnp.sqrt(1 + tangent**2)
    cosine, sine = cosine[:, None], (tangent * cosine)[:, None]
    one, other = cosine * one - sine * other, sine * one + cosine * other
    return jnp.concatenate([one[:1], other[:1], one[1:-1], other[1:], one[-1:]])


@jax.custom_jvp
def inverse_definite(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Of a symmetric positive definite matrix, by Gauss-Jordan elimination without pivots.

    Differentiable to every order: ``dP = -P dA P``.
    """
    n = matrix.shape[0]
    rows = jnp.concatenate([matrix, jnp.eye(n, dtype=matrix.dtype)], axis=1)
    for k in range(n):
        pivot = rows[k] / rows[k, k]
        rows = (rows - rows[:, k][:, None] * pivot[None, :]).at[k].set(pivot)
    return rows[:, n:]


@inverse_definite.defjvp
def _inverse_definite_jvp(primals, tangents):
    inverse = inverse_definite(*primals)
    return inverse, -_product(_product(inverse, tangents[0]), inverse)


def pseudo_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """``P`` with ``P A`` the projector onto the eigenvectors that count (Moore and Penrose), n even.

    A is the symmetric part of `matrix`, and positive semi-definite. Those count whose eigenvalues are
    larger than rounding: 16 last digits of the largest. Differentiable to every order where their
    number does not change: see `eigen3x3.pseudo_inverse`.
    """
    return _inverse_and_rest((matrix + matrix.T) / 2)[0]


@jax.custom_jvp
def _inverse_and_rest(
    matrix: Float[Array, "n n"],
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """P, and the projector N onto the eigenvectors that do not count.

    As ``I - A P`` N would have lost as many digits as A has in its condition, and the derivative of P,
    in which N meets P twice, all of them.
    """
    scaled, vectors = singular_vectors(matrix)
    values = jnp.sqrt(jnp.sum(scaled**2, axis=0))
    counts = values > 16 * jnp.finfo(values.dtype).eps * jnp.max(values)
    inverted = jnp.where(counts, 1 / jnp.where(counts, values, 1), 0)
    rest = jnp.where(counts, 0, 1).astype(values.dtype)
    return _product(vectors * inverted[None, :], vectors.T), _product(
        vectors * rest[None, :], vectors.T
    )


@_inverse_and_rest.defjvp
def _inverse_and_rest_jvp(primals, tangents):
    """``dP = -P dA P + P P dA N + N dA P P`` and ``dN = -N dA P - P dA N``."""
    (matrix,), (change,) = primals, tangents
    inverse, rest = found = _inverse_and_rest(matrix)
    moved = _product(_product(inverse, change), rest)
    outward = _product(inverse, moved)
    through = _product(_product(inverse, change), inverse)
    return found, (outward + outward.T - through, -moved - moved.T)


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=Precision.HIGHEST)
