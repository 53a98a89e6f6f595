"""Neighbours against a k-d tree, and the laws that ties, padding and offsets must keep."""

import jax
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.geometry import neighbors
from tests import oracles

knn = jax.jit(neighbors.knn, static_argnums=1)
nearest_neighbor = jax.jit(neighbors.nearest_neighbor)
nearest_in = jax.jit(neighbors.nearest_in)
squared_distances = jax.jit(neighbors.squared_distances)
without_padding = jax.jit(neighbors.without_padding)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def distances(points, idx):
    return np.linalg.norm(points[:, None] - points[np.asarray(idx)], axis=-1)


def grid(side):
    axis = np.arange(float(side))
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)


def clouds(rng):
    points = rng.normal(size=(40, 3))
    return {
        "generic": points,
        "duplicates": np.repeat(points[:8], 5, axis=0),
        "grid": grid(3),
        "collinear": np.outer(rng.normal(size=20), [1.0, 2.0, 3.0]),
        "one place": np.ones((9, 3)),
    }


@pytest.mark.parametrize("name", ["generic", "duplicates", "grid", "collinear", "one place"])
@pytest.mark.parametrize("k", [1, 4])
def test_knn_gives_the_k_nearest_other_points(rng, name, k):
    points = clouds(rng)[name]
    idx = np.asarray(knn(points, k))
    assert idx.shape == (len(points), k)
    assert idx.dtype == np.int32
    expected = oracles.neighbor_distances(points, k)[: len(points)].reshape(len(points), k)
    np.testing.assert_allclose(distances(points, idx), expected, atol=1e-12)
    for i, row in enumerate(idx):
        assert i not in row, "a point is not its own neighbour"
        assert len(set(row)) == k, "no neighbour twice"


@pytest.mark.parametrize("name", ["generic", "duplicates", "grid"])
def test_permuting_the_points_permutes_the_graph(rng, name):
    points = clouds(rng)[name]
    order = rng.permutation(len(points))
    idx, permuted = np.asarray(knn(points, 5)), np.asarray(knn(points[order], 5))
    # Coincident points are interchangeable, so the law is about coordinates.
    np.testing.assert_array_equal(points[idx][order], points[order][permuted])


@pytest.mark.parametrize("kind", ["generic", "lattice"])
@pytest.mark.parametrize("padding", [0.0, 1e6, np.nan, np.inf])
def test_padding_is_nobody_s_neighbour(rng, padding, kind):
    points = rng.normal(size=(20, 3))
    if kind == "lattice":  # Equal distances: their order may not depend on the padding either.
        points = np.stack(np.unravel_index(rng.permutation(27)[:20], (3, 3, 3)), axis=1) - 1.0
    mask = rng.permutation(np.arange(20) < 14)
    padded = np.where(mask[:, None], points, padding)
    idx = np.asarray(knn(padded, 4, mask))
    # The r-th valid row of the padded cloud is row r of the one without padding.
    expected = np.flatnonzero(mask)[np.asarray(knn(points[mask], 4))]
    np.testing.assert_array_equal(idx[mask], expected)
    assert ((idx >= 0) & (idx < 20)).all()
    np.testing.assert_array_equal(nearest_neighbor(padded, mask), idx[:, 0])


def test_a_short_list_is_filled_with_the_point_itself(rng):
    points, mask = rng.normal(size=(6, 3)), np.arange(6) < 3
    idx = np.asarray(knn(points, 4, mask))
    for i in range(3):
        assert set(idx[i, :2]) == {0, 1, 2} - {i}
        np.testing.assert_array_equal(idx[i, 2:], i)


def test_nearest_neighbor_is_another_point_even_where_they_coincide(rng):
    points = np.repeat(rng.normal(size=(5, 3)), 2, axis=0)
    nearest = np.asarray(nearest_neighbor(points))
    np.testing.assert_array_equal(nearest, np.arange(10) ^ 1)


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e5])
def test_neighbours_far_from_the_origin(rng, offset):
    # What float32 coordinates say is taken exactly; the product form fails at 1e3 already.
    points = (rng.uniform(-1, 1, (60, 3)) + offset).astype(np.float32)
    exact = points.astype(np.float64)
    expected = oracles.neighbor_distances(exact, 5)
    np.testing.assert_allclose(distances(exact, knn(points, 5)), expected, rtol=1e-6, atol=1e-12)


def test_nearest_in_another_cloud(rng):
    points, others = rng.normal(size=(15, 3)), rng.normal(size=(11, 3))
    expected = [np.argmin([np.sum((p - q) ** 2) for q in others]) for p in points]
    np.testing.assert_array_equal(nearest_in(points, others), expected)
    mask = np.arange(11) < 7
    expected = [np.argmin([np.sum((p - q) ** 2) for q in others[:7]]) for p in points]
    others[7:] = np.nan
    np.testing.assert_array_equal(nearest_in(points, others, mask), expected)


def test_large_clouds_are_searched_in_blocks_of_rows(rng):
    points, others = rng.normal(size=(2100, 3)), rng.normal(size=(40, 3))
    _, expected = cKDTree(others).query(points)
    np.testing.assert_array_equal(nearest_in(points, others), expected)
    cloud = jax.ShapeDtypeStruct((16_384, 3), np.float32)
    needed = nearest_in.lower(cloud, cloud).compile().memory_analysis().temp_size_in_bytes
    assert needed < 16_384**2 * 4 / 2


def test_few_points_are_searched_in_blocks_among_many_others(rng):
    points, others = rng.normal(size=(1100, 3)), rng.normal(size=(70_000, 3))
    _, expected = cKDTree(others).query(points)
    np.testing.assert_array_equal(nearest_in(points, others), expected)


def test_squared_distances_entry_by_entry(rng):
    points, others = rng.normal(size=(4, 3)), rng.normal(size=(6, 3))
    expected = [[np.sum((p - q) ** 2) for q in others] for p in points]
    np.testing.assert_allclose(squared_distances(points, others), expected, rtol=1e-14)


def test_padding_becomes_zero_and_takes_no_derivative(rng):
    points, mask = rng.normal(size=(5, 3)), np.array([True, False, True, True, False])
    points[~mask] = np.nan
    np.testing.assert_array_equal(without_padding(points, mask), np.where(mask[:, None], points, 0))
    gradient = jax.grad(lambda x: (without_padding(x, mask) ** 2).sum())(points)
    np.testing.assert_array_equal(gradient, np.where(mask[:, None], 2 * points, 0))
    np.testing.assert_array_equal(without_padding(points, None), points)


def test_compiled_search_does_not_sort_every_row():
    # lax.top_k becomes a full sort, 30 times slower, when XLA merges slices into it (SPEED).
    points = np.zeros((64, 3), np.float32)

    def sliced(points):
        idx = knn(points, 5)
        return idx[:, 1:], idx[:, 0]

    text = jax.jit(sliced).lower(points).compile().as_text()
    sorts = [line for line in text.splitlines() if " sort(" in line]
    assert not [line for line in sorts if "[64,64]" in line]


@pytest.mark.untyped
@pytest.mark.parametrize(
    ("shape", "k", "message"),
    [
        ((5, 3), 5, "k = 5 .* n = 5"),
        ((5, 3), 0, "k = 0 .* n = 5"),
        ((0, 3), 1, r"n >= 1, got \(0, 3\)"),
        ((1, 3), 1, "k = 1 .* n = 1"),
        ((5, 2), 1, r"\(n, 3\) with n >= 1, got \(5, 2\)"),
        ((2, 5, 3), 1, r"got \(2, 5, 3\).*jax.vmap"),
        ((3,), 1, r"got \(3,\)"),
    ],
)
def test_static_faults_are_named(shape, k, message):
    with pytest.raises(ValueError, match=message):
        knn(np.zeros(shape), k)
    if k == 1:
        with pytest.raises(ValueError, match=message):
            nearest_neighbor(np.zeros(shape))
