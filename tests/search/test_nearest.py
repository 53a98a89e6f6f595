import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.search.nearest import lookup, nearest_grid, nearest_packed


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("m", [1, 2, 700, 1024, 1025])
def test_packed_minimum_finds_a_nearest_point(dtype, m, seed):
    rng = np.random.default_rng(seed)
    queries, points = (rng.normal(size=(n, 3)).astype(dtype) for n in (300, m))
    found = np.asarray(nearest_packed(jnp.asarray(queries), jnp.asarray(points), jnp.ones(m, bool)))
    assert found.dtype == np.int32
    best = cKDTree(points).query(queries)[0]
    reached = np.linalg.norm(queries - points[found], axis=1)
    np.testing.assert_allclose(reached, best, rtol=3e-4, atol=1e-5)


def test_coincident_points_and_padding(seed):
    points = np.random.default_rng(seed).normal(size=(50, 3))
    mask = np.arange(50) < 30
    broken = np.where(mask[:, None], points, np.nan)
    found = nearest_packed(jnp.asarray(points[:30]), jnp.asarray(broken), jnp.asarray(mask))
    assert np.array_equal(found, np.arange(30))
    assert nearest_packed(jnp.zeros((4, 3)), jnp.zeros((5, 3)), jnp.zeros(5, bool)).max() < 5


def test_grid_answers_for_the_centre_of_the_cell(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (200, 3))
    grid = nearest_grid(jnp.asarray(points), jnp.ones(200, bool), cells=10, margin=0.1)
    queries = rng.uniform(-1.5, 1.5, (400, 3))
    low, high = points.min(0) - 0.1, points.max(0) + 0.1
    size = (high - low) / 10
    centres = low + size * (np.clip(np.floor((queries - low) / size), 0, 9) + 0.5)
    best = cKDTree(points).query(centres)[0]
    found = np.asarray(lookup(grid, jnp.asarray(queries)))
    np.testing.assert_allclose(np.linalg.norm(centres - points[found], axis=1), best, atol=1e-6)
