"""Eigenvectors and the inverse of symmetric 3x3 matrices against LAPACK, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from jaxreg.geometry import eigen3x3

eigh = jax.jit(eigen3x3.eigh)


def spectra():
    """Rows of eigenvalues: generic, a line, a plane, equal ones, nothing, negative, of any size."""
    rows = [[1.0, 2, 4], [0, 0, 1], [0, 1, 1], [1, 1, 1], [0, 0, 0], [-3, -1, 2], [1e-9, 1e-3, 1]]
    return np.concatenate([scale * np.array(rows) for scale in (1.0, 1e-12, 1e12)])


def matrices(seed, values):
    turn = Rotation.random(len(values), random_state=seed).as_matrix()
    matrix = (turn * values[:, None, :]) @ turn.transpose(0, 2, 1)
    return (matrix + matrix.transpose(0, 2, 1)) / 2


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_eigenvectors_and_values_are_those_of_lapack(seed, dtype):
    matrix = np.concatenate([matrices(seed + k, spectra()) for k in range(50)]).astype(dtype)
    values, vectors = (np.asarray(x, np.float64) for x in eigh(jnp.asarray(matrix)))
    size = np.maximum(np.abs(matrix).max(axis=(1, 2)), np.finfo(np.float32).tiny)[:, None]
    rounding = 20 * np.finfo(dtype).eps
    expected = np.linalg.eigvalsh(matrix.astype(np.float64))
    np.testing.assert_allclose(values / size, expected / size, atol=rounding)
    unit = np.broadcast_to(np.eye(3), vectors.shape)
    np.testing.assert_allclose(vectors.transpose(0, 2, 1) @ vectors, unit, atol=rounding)
    wrong = matrix @ vectors - vectors * values[:, None, :]
    np.testing.assert_allclose(wrong / size[..., None], 0, atol=rounding)


def test_diagonal_matrices_are_exact():
    found = eigh(jnp.diag(jnp.asarray([3.0, -1.0, 2.0])))
    np.testing.assert_array_equal(found.values, [-1, 2, 3])
    np.testing.assert_array_equal(np.abs(found.vectors), np.eye(3)[:, [1, 2, 0]])


def test_equal_entries_on_the_diagonal_are_turned_too():
    found = eigh(jnp.ones((3, 3)))
    np.testing.assert_allclose(found.values, [0, 0, 3], atol=1e-15)
    np.testing.assert_allclose(np.abs(found.vectors[:, 2]), np.sqrt(1 / 3))


def test_one_matrix_that_is_not_finite_spoils_no_other(seed):
    matrix = matrices(seed, spectra())
    matrix[1] = np.nan
    found = eigh(jnp.asarray(matrix))
    assert np.isnan(found.values[1]).all()
    assert np.isfinite(np.delete(found.vectors, 1, axis=0)).all()


def test_derivative_equals_finite_differences(seed):
    (matrix,) = matrices(seed, np.array([[0.1, 0.5, 1.0]]))

    def rebuilt(m):
        values, vectors = eigen3x3.eigh((m + m.mT) / 2)
        return (vectors * jnp.sin(values)[None, :]) @ vectors.mT, values

    modes = ("fwd", "rev")
    check_grads(jax.jit(rebuilt), (matrix,), order=1, modes=modes, eps=1e-5, rtol=1e-4)


def test_derivative_of_a_smooth_function_is_right_at_equal_eigenvalues():
    """The trace of A^2 is the sum of the squares of its eigenvalues, whether they differ or not."""
    for matrix in (jnp.eye(3), jnp.diag(jnp.array([1.0, 1.0, 2.0])), jnp.zeros((3, 3))):
        gradient = jax.jit(jax.grad(lambda m: jnp.sum(eigen3x3.eigh(m).values ** 2)))(matrix)
        np.testing.assert_allclose(gradient, 2 * matrix, atol=1e-12)
        assert np.isfinite(jax.jit(jax.jacobian(eigen3x3.eigh))(matrix).vectors).all()


def test_inverse_of_symmetric_matrices(seed):
    matrix = matrices(seed, np.random.default_rng(seed).uniform(0.1, 1, (5, 3)))
    np.testing.assert_allclose(eigen3x3.inverse(jnp.asarray(matrix)), np.linalg.inv(matrix))


def test_pseudo_inverse_is_that_of_numpy(seed):
    for rank, values in enumerate(np.tril(np.array([2.0, -1.0, 0.5])[None].repeat(4, 0), -1)):
        (matrix,) = matrices(seed + rank, values[None])
        found = jax.jit(eigen3x3.pseudo_inverse)(jnp.asarray(matrix))
        expected = np.linalg.pinv(matrix, rcond=1e-12, hermitian=True)
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("values", [(1.0, 2, 4), (1, 1, 1), (-1, 1, 1)])
def test_derivatives_of_the_pseudo_inverse_equal_finite_differences(seed, values):
    (matrix,) = matrices(seed, np.array([values], float))
    check_grads(
        jax.jit(eigen3x3.pseudo_inverse), (matrix,), order=2, modes=("fwd", "rev"), rtol=1e-4
    )


def test_derivative_of_the_pseudo_inverse_where_the_rank_stays(seed):
    """``A = B D B^T`` for any B has the rank of D; the differences are numpy's."""
    (basis,) = matrices(seed, np.array([[1.0, 2, 3]]))
    change = np.random.default_rng(seed).normal(size=(3, 3))
    of = lambda x: (basis + x * change) @ np.diag([1.0, 2, 0]) @ (basis + x * change).T  # noqa: E731
    turning = change @ np.diag([1.0, 2, 0]) @ basis.T
    point, direction = jnp.asarray(of(0.0)), jnp.asarray(turning + turning.T)
    found = jax.jvp(jax.jit(eigen3x3.pseudo_inverse), (point,), (direction,))[1]
    ahead, behind = (np.linalg.pinv(of(x), rcond=1e-9, hermitian=True) for x in (1e-6, -1e-6))
    np.testing.assert_allclose(found, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-6)
