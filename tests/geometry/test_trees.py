"""Queries on many threads, against all distances and against scipy's own."""

import multiprocessing
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import threadpoolctl
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from jaxreg.geometry import trees

MANY = 4 * trees._LEAST + 3
"""Enough points for threads, in parts that are not alike."""


@pytest.mark.parametrize("count", [1, 5, MANY])
def test_neighbors_are_those_of_all_distances(seed, count):
    rng = np.random.default_rng(seed)
    points, queries = rng.normal(size=(50, 3)), rng.normal(size=(count, 3))
    distance, index = trees.neighbors(trees.Tree(points), queries, 4)
    every = cdist(queries, points)
    np.testing.assert_array_equal(index, np.argsort(every, axis=1)[:, :4])
    np.testing.assert_allclose(distance, np.sort(every, axis=1)[:, :4])


def test_any_leading_axes_and_no_bit_depends_on_threads(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    points, queries = rng.normal(size=(300, 3)), rng.normal(size=(3, MANY, 3))
    tree = trees.Tree(points)
    distance, index = trees.nearest(tree, queries, within=0.5)
    assert np.isinf(distance).any()
    assert (index[np.isinf(distance)] == 300).all()
    expected = cKDTree(points).query(queries, distance_upper_bound=0.5)
    np.testing.assert_allclose(distance, expected[0], rtol=1e-14)
    np.testing.assert_array_equal(index, expected[1])
    for cores in (1, 7):
        monkeypatch.setattr(trees, "_cores", lambda cores=cores: cores)
        for found, before in zip(
            trees.nearest(tree, queries, within=0.5), (distance, index), strict=True
        ):
            np.testing.assert_array_equal(found, before)


def test_no_point_and_more_neighbors_than_points(seed):
    tree = trees.Tree(np.random.default_rng(seed).normal(size=(3, 3)))
    assert trees.neighbors(tree, np.zeros((0, 3)), 2)[1].shape == (0, 2)
    distance, index = trees.neighbors(tree, np.zeros((1, 3)), 5)
    assert np.isinf(distance[0, 3:]).all()
    assert (index[0, 3:] == 3).all()


def test_many_threads_may_ask_at_once(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(300, 3))
    tree = trees.Tree(points)
    queries = rng.normal(size=(12, MANY, 3))
    with ThreadPoolExecutor(6) as pool:
        found = list(pool.map(lambda points: trees.nearest(tree, points)[1], queries))
    np.testing.assert_array_equal(found, cKDTree(points).query(queries)[1])


def test_a_tree_can_be_pickled(seed):
    points = np.random.default_rng(seed).normal(size=(200, 3))
    tree = pickle.loads(pickle.dumps(trees.Tree(points)))
    np.testing.assert_array_equal(trees.nearest(tree, points)[1], np.arange(200))


def test_the_caller_keeps_its_number_of_openmp_threads(seed):
    """Other libraries may share the runtime, and are not slowed down by a query of ours."""
    points = np.random.default_rng(seed).normal(size=(MANY, 3))
    before = [x["num_threads"] for x in threadpoolctl.threadpool_info()]
    trees.nearest(trees.Tree(points), points)
    assert [x["num_threads"] for x in threadpoolctl.threadpool_info()] == before


@pytest.mark.skipif(
    "fork" not in multiprocessing.get_all_start_methods(), reason="no fork on this system"
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::RuntimeWarning")
def test_a_fork_has_threads_of_its_own(seed):
    points = np.random.default_rng(seed).normal(size=(MANY, 3))
    tree = trees.Tree(points)
    trees.nearest(tree, points)  # the threads of this process
    child = multiprocessing.get_context("fork").Process(target=trees.nearest, args=(tree, points))
    child.start()
    child.join(60)
    ended, code = not child.is_alive(), child.exitcode
    child.kill()
    assert ended
    assert code == 0
