"""Nearest pairs against a k-d tree, and the neighbours of partners against a loop."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.refine.correspondences import with_neighbors
from tests.compiled import closest_pairs


def test_pairs_equal_the_tree(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(30, 3)), rng.normal(size=(40, 3))
    pairs = closest_pairs(jnp.asarray(x), jnp.asarray(y), None, None, both_directions=True)
    np.testing.assert_array_equal(pairs.source_index[:30], np.arange(30))
    np.testing.assert_array_equal(pairs.reference_index[:30], cKDTree(y).query(x)[1])
    np.testing.assert_array_equal(pairs.source_index[30:], cKDTree(x).query(y)[1])
    np.testing.assert_array_equal(pairs.reference_index[30:], np.arange(40))
    assert pairs.mask.all()


@pytest.mark.parametrize("both_directions", [False, True])
def test_neighbours_of_partners_equal_the_loop(seed, both_directions):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(6, 3)), rng.normal(size=(5, 3))
    near_x, near_y = (rng.integers(0, n, (n, 2), dtype=np.int32) for n in (6, 5))
    mask = jnp.asarray(np.arange(6) != 2)
    pairs = closest_pairs(
        jnp.asarray(x), jnp.asarray(y), mask, None, both_directions=both_directions
    )
    result = with_neighbors(pairs, jnp.asarray(near_x), jnp.asarray(near_y), forward=6)
    expected = []
    for number, (i, j, counts) in enumerate(zip(*map(np.asarray, pairs), strict=True)):
        more = [(i, other) for other in near_y[j]] if number < 6 else [(k, j) for k in near_x[i]]
        expected += [(*pair, counts) for pair in [(i, j), *more]]
    assert sorted(zip(*map(np.ndarray.tolist, map(np.asarray, result)), strict=True)) == sorted(
        expected
    )


def test_padding_is_in_no_pair(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(6, 3)), rng.normal(size=(5, 3))
    x_mask, y_mask = np.arange(6) < 4, np.arange(5) < 3
    x[~x_mask], y[~y_mask] = 0, 0
    pairs = closest_pairs(
        jnp.asarray(x), jnp.asarray(y), jnp.asarray(x_mask), jnp.asarray(y_mask),
        both_directions=True,
    )  # fmt: skip
    np.testing.assert_array_equal(pairs.mask, np.concatenate([x_mask, y_mask]))
    assert x_mask[pairs.source_index[pairs.mask]].all()
    assert y_mask[pairs.reference_index[pairs.mask]].all()
