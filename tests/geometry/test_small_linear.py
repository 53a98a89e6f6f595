"""Small factors and inverses against LAPACK, and that no batch of ours waits for it."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxreg.geometry import small_linear
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.refine.gicp import gicp
from jaxreg.refine.point_to_point import icp

singular_vectors = jax.jit(jax.vmap(small_linear.singular_vectors))
inverse_definite = jax.jit(small_linear.inverse_definite)


def matrices(seed, n):
    """Generic, graded, without full rank, orthogonal, zero; of any size."""
    rng = np.random.default_rng(seed)
    generic, other = rng.normal(size=(2, 50, n, n))
    kinds = [
        generic,
        generic * 10.0 ** -np.arange(n),
        generic[:, :, : n // 2] @ other[:, : n // 2],
        np.linalg.qr(generic)[0],
        np.zeros((1, n, n)),
    ]
    return np.concatenate([scale * np.concatenate(kinds) for scale in (1.0, 1e-12, 1e12)])


@pytest.mark.parametrize("n", [4, 6])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_singular_vectors_are_those_of_lapack(seed, n, dtype):
    matrix = matrices(seed, n).astype(dtype)
    found = singular_vectors(matrix)
    assert found.right.dtype == matrix.dtype
    scaled, right = (np.asarray(x, np.float64) for x in found)
    size = np.maximum(np.abs(matrix).max(axis=(1, 2)).astype(float), 1e-30)[:, None, None]
    rounding = 50 * np.finfo(dtype).eps
    np.testing.assert_allclose(scaled / size, matrix / size @ right, atol=rounding)
    unit = np.broadcast_to(np.eye(n), right.shape)
    np.testing.assert_allclose(right.transpose(0, 2, 1) @ right, unit, atol=rounding)
    gram = scaled.transpose(0, 2, 1) @ scaled / size**2
    np.testing.assert_allclose(gram * (1 - np.eye(n)), 0, atol=rounding)
    values = np.sort(np.linalg.norm(scaled, axis=1), axis=1)[:, ::-1]
    expected = np.linalg.svd(matrix.astype(float), compute_uv=False)
    np.testing.assert_allclose(values / size[..., 0], expected / size[..., 0], atol=rounding)


def definite(seed):
    rows = np.random.default_rng(seed).normal(size=(20, 6))
    return rows.T @ rows


@pytest.mark.parametrize("rank", [0, 3, 6])
def test_pseudo_inverse_is_that_of_lapack_and_so_is_its_derivative(seed, rank):
    """Along a path of constant rank the derivative is that of central differences."""
    rng = np.random.default_rng(seed)
    rows, direction = rng.normal(size=(2, rank, 6))

    def matrix(step):
        moved = rows + step * direction
        return jnp.matmul(moved.T, moved)

    def exact(step):
        return np.linalg.pinv(matrix(step), rcond=1e-9, hermitian=True)

    found, tangent = jax.jvp(
        jax.jit(lambda step: small_linear.pseudo_inverse(matrix(step))), (0.0,), (1.0,)
    )
    scale = np.abs(exact(0.0)).max()
    np.testing.assert_allclose(found, exact(0.0), atol=1e-10 * scale)
    difference = (exact(1e-6) - exact(-1e-6)) / 2e-6
    np.testing.assert_allclose(tangent, difference, atol=1e-5 * np.abs(difference).max())


def test_pseudo_inverse_of_an_ill_conditioned_matrix_has_the_derivative_of_the_inverse(seed):
    """Where the condition is 1e9, ``I - A P`` is rounding that P, twice, would make as large."""
    rng = np.random.default_rng(seed)
    basis, change = np.linalg.qr(rng.normal(size=(6, 6)))[0], rng.normal(size=(6, 6))
    matrix, change = basis * 10.0 ** (-1.8 * np.arange(6)) @ basis.T, change + change.T
    found, tangent = jax.jit(lambda x, y: jax.jvp(small_linear.pseudo_inverse, (x,), (y,)))(
        matrix, change
    )
    inverse = np.linalg.inv(matrix)
    expected = -inverse @ change @ inverse
    np.testing.assert_allclose(found, inverse, atol=1e-6 * np.abs(inverse).max())
    np.testing.assert_allclose(tangent, expected, atol=1e-5 * np.abs(expected).max())
    definite_one = jnp.asarray(definite(seed))
    check_grads(
        jax.jit(small_linear.pseudo_inverse),
        (definite_one,),
        order=2,
        modes=("fwd", "rev"),
        rtol=1e-5,
    )


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_inverse_is_that_of_lapack(seed, dtype):
    matrix = definite(seed)
    found = np.asarray(inverse_definite(matrix.astype(dtype)), np.float64)
    error = found @ matrix - np.eye(6)
    assert np.abs(error).max() < 10 * np.linalg.cond(matrix) * np.finfo(dtype).eps


def test_derivatives_of_the_inverse_equal_finite_differences(seed):
    check_grads(
        inverse_definite, (jnp.asarray(definite(seed)),), order=2, modes=("fwd", "rev"), rtol=1e-5
    )


def pose_of(solve):
    return lambda *clouds: solve(*clouds).rotation[0, 1]


@pytest.mark.parametrize("solve", [weighted_procrustes, icp, gicp], ids=lambda f: f.__name__)
def test_no_derivative_of_a_batch_calls_lapack(solve):
    """The values of all public functions: tests/transforms/test_values.py."""
    cloud = jnp.zeros((2, 20, 3))
    arguments = (cloud, cloud, cloud[..., 0]) if solve is weighted_procrustes else (cloud, cloud)
    lowered = jax.jit(jax.vmap(jax.grad(pose_of(solve)))).lower(*arguments)
    assert "lapack" not in lowered.as_text()


TWO_THREADS = """
import threading
import jax, numpy as np
from jaxreg import weighted_procrustes

source, reference = np.random.default_rng(0).normal(size=(2, 2048, 8, 3)).astype(np.float32)
weights = np.ones((2048, 8), np.float32)
run = jax.jit(jax.vmap(weighted_procrustes))
jax.block_until_ready(run(source, reference, weights))

def work():
    for _ in range(10):
        jax.block_until_ready(run(source, reference, weights))

threads = [threading.Thread(target=work) for _ in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""


def test_two_threads_with_large_batches_come_to_an_end():
    subprocess.run([sys.executable, "-c", TWO_THREADS], check=True, timeout=120)
