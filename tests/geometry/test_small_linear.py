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
