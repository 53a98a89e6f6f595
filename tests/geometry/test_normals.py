"""Normals and covariances against numpy loops, their derivative, and neighbourhoods without one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxreg.geometry.normals import smallest_eigenvector, surface_covariances
from tests.compiled import edge_normals, knn, neighborhood_covariances, normals


def surface(seed, n=60):
    uv = np.random.default_rng(seed).uniform(-1, 1, (n, 2))
    return np.column_stack([uv, 0.3 * np.sin(2 * uv[:, 0]) + 0.2 * uv[:, 1] ** 2])


def test_covariances_equal_the_loop(seed):
    points = surface(seed) + 1000
    neighbors = knn(jnp.asarray(points), 8)
    result = neighborhood_covariances(jnp.asarray(points), neighbors)
    for i, row in enumerate(np.asarray(neighbors)):
        patch = points[[i, *row]]
        np.testing.assert_allclose(result[i], np.cov(patch.T, bias=True), atol=1e-12)


@pytest.mark.parametrize("factor", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_normals_equal_the_loop(seed, dtype, factor):
    points = surface(seed)
    neighbors = knn(jnp.asarray(points), 8)
    result = np.asarray(normals(jnp.asarray(factor * points, dtype), neighbors))
    for i, row in enumerate(np.asarray(neighbors)):
        patch = points[[i, *row]]
        expected = np.linalg.svd(patch - patch.mean(0))[2][2]
        assert abs(expected @ result[i]) > 1 - (1e-4 if dtype == "float32" else 1e-10)


def test_surface_covariances_have_the_given_thickness(seed):
    normal = np.random.default_rng(seed).normal(size=3)
    normal /= np.linalg.norm(normal)
    (result,) = surface_covariances(jnp.asarray(normal)[None], 1e-3)
    np.testing.assert_allclose(result @ normal, 1e-3 * normal, atol=1e-15)
    np.testing.assert_allclose(np.linalg.eigvalsh(result), [1e-3, 1, 1])
    np.testing.assert_array_equal(surface_covariances(jnp.zeros((1, 3)), 1e-3)[0], np.eye(3))


def plate(side=13):
    """A square of side 1 in the plane z = 0, a regular grid without ties, and where its edges are."""
    steps = np.linspace(0, 1, side)
    x, y = (v.ravel() for v in np.meshgrid(steps, 1.01 * steps, indexing="ij"))
    inside = (x > 0.2) & (x < 0.8) & (y > 0.2) & (y < 0.8)
    middle = (abs(y - 0.505) < 0.1) & ((x == 0) | (x == 1))
    return np.column_stack([x, y, 0 * x]), inside, middle


def test_a_surface_ends_at_its_edge(seed):
    """Inside, the covariance is that of a plane; on an edge it is thin across the edge as well.

    The normal of the edge points into the surface.
    """
    points, inside, middle = plate()
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    cloud = jnp.asarray(points @ turn.T)
    neighbors = knn(cloud, 24)
    across = normals(cloud, neighbors)
    edges = edge_normals(cloud, neighbors, across)
    inward = (edges @ turn)[middle][:, 0]
    np.testing.assert_allclose(inward, np.where(points[middle][:, 0] == 0, 1, -1), atol=0.1)
    result = turn.T @ surface_covariances(across, 0.01, edges) @ turn
    expected = np.broadcast_to(np.diag([1, 1, 0.01]), result[inside].shape)
    np.testing.assert_allclose(result[inside], expected, atol=1e-4)
    expected = np.broadcast_to(np.diag([0.01, 1, 0.01]), result[middle].shape)
    np.testing.assert_allclose(result[middle], expected, atol=0.1)


def test_padding_changes_no_surface():
    points, _, _ = plate()
    padded = np.concatenate([points, np.full((3, 3), np.nan)])
    mask = np.arange(len(padded)) < len(points)
    neighbors = knn(jnp.asarray(padded), 8, jnp.asarray(mask))
    across = normals(jnp.asarray(padded), neighbors, jnp.asarray(mask))
    result = edge_normals(jnp.asarray(padded), neighbors, across, jnp.asarray(mask))
    points, neighbors = jnp.asarray(points), knn(jnp.asarray(points), 8)
    alone = edge_normals(points, neighbors, normals(points, neighbors))
    np.testing.assert_allclose(result[: len(points)], alone, atol=1e-12)
    assert np.linalg.norm(alone, axis=1).max() > 0.5
    assert np.isfinite(result).all()


def test_derivative_equals_finite_differences(seed):
    root = np.random.default_rng(seed).normal(size=(3, 3)) * [1.0, 0.6, 0.1]
    matrix = jnp.asarray(root.T @ root)
    # A sign may flip under any step of a finite difference; the outer product has none.
    check_grads(
        jax.jit(lambda m: jnp.outer(*[smallest_eigenvector(jnp.asarray(m))] * 2)),
        (matrix + matrix.T,), order=1, modes=("fwd", "rev"), eps=1e-5, rtol=1e-4,
    )  # fmt: skip


DEGENERATE = {
    "line": np.linspace(0, 1, 9)[:, None] * np.array([1.0, 2, 3]),
    "point": np.ones((9, 3)),
    "cross": np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))]),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_no_normal_and_finite_derivative_without_a_plane(name):
    points = jnp.asarray(DEGENERATE[name])
    neighbors = knn(points, len(points) - 1)
    assert not normals(points, neighbors).any()
    assert np.isfinite(jax.jit(jax.jacobian(lambda p: normals(p, neighbors)))(points)).all()


def test_exact_plane_has_its_normal_and_a_finite_derivative(seed):
    uv = np.random.default_rng(seed).uniform(-1, 1, (12, 2))
    points = jnp.asarray(np.column_stack([uv, np.zeros(12)]))
    neighbors = knn(points, 6)
    np.testing.assert_allclose(np.abs(normals(points, neighbors)[:, 2]), 1)
    assert np.isfinite(jax.jit(jax.jacobian(lambda p: normals(p, neighbors)))(points)).all()


def test_padding_changes_nothing(seed):
    points = jnp.asarray(surface(seed, 20))
    padded = jnp.concatenate([points, jnp.full((4, 3), jnp.nan)])
    mask = jnp.arange(24) < 20

    def outer(p, mask):
        n = normals(p, knn(p, 6, mask), mask)
        return jnp.sum(n[:20, :, None] * n[:20, None, :] * jnp.arange(9.0).reshape(1, 3, 3))

    differentiate = jax.jit(jax.value_and_grad(outer))
    value, gradient = differentiate(points, None)
    padded_value, padded_gradient = differentiate(padded, mask)
    np.testing.assert_allclose(padded_value, value, rtol=1e-12)
    np.testing.assert_allclose(padded_gradient[:20], gradient, atol=1e-9)
    assert not padded_gradient[20:].any()
    assert not normals(padded, knn(padded, 6, mask), mask)[20:].any()
