"""Nearest pairs against a k-d tree; weights against the published formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxreg.refine.correspondences import with_neighbors
from jaxreg.refine.robust import (
    Weighting,
    kernel_weight,
    masked_quantile,
    pair_weights,
    widenings,
)
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


ROBUST_COSTS = {
    "huber": lambda u: np.where(u <= 1, u**2 / 2, u - 0.5),
    "cauchy": lambda u: np.log1p(u**2) / 2,
    "geman_mcclure": lambda u: u**2 / (1 + u**2) / 2,
    "gaussian": lambda u: 1 - np.exp(-(u**2) / 2),
}


@pytest.mark.parametrize("kernel", ROBUST_COSTS)
def test_weight_is_the_derivative_of_the_cost_over_the_residual(kernel):
    u, h = np.array([0.3, 0.8, 1.7, 4.0]), 1e-6
    cost = ROBUST_COSTS[kernel]
    slope = (cost(u + h) - cost(u - h)) / (2 * h)
    np.testing.assert_allclose(kernel_weight(jnp.asarray(u**2), kernel), slope / u, rtol=1e-6)
    assert np.isfinite(jax.grad(lambda s: jnp.sum(kernel_weight(s, kernel)))(jnp.zeros(2))).all()


def test_unknown_kernel_is_named():
    with pytest.raises(ValueError, match="kernel 'tukey' does not exist"):
        kernel_weight(jnp.ones(3), "tukey")


def test_gates_and_widths():
    squared = jnp.array([0.01, 0.04, 0.09, 4.0, 0.0])
    mask = jnp.array([True, True, True, True, False])
    gate = Weighting("none", None, 0.25, 1.0)
    np.testing.assert_array_equal(pair_weights(squared, squared, mask, gate), [1, 1, 0, 0, 0])
    trim = Weighting("none", None, jnp.inf, 0.75)
    np.testing.assert_array_equal(pair_weights(squared, squared, mask, trim), [1, 1, 1, 0, 0])
    fixed = Weighting("cauchy", 0.1, jnp.inf, 1.0)
    np.testing.assert_allclose(
        pair_weights(squared, squared, mask, fixed, 2.0), [0.8, 0.5, 4 / 13, 1 / 101, 0]
    )
    adaptive = Weighting("cauchy", None, jnp.inf, 1.0)
    width = 1.4826 * 0.2
    np.testing.assert_allclose(
        pair_weights(squared, squared, mask, adaptive)[:4], 1 / (1 + squared[:4] / width**2)
    )


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("share", [0.05, 0.3, 0.5, 0.7, 1.0])
def test_quantile_counts_the_valid_values(share, dtype, seed):
    rng = np.random.default_rng(seed)
    # From tiny to infinite, some of them equal, as distances may be.
    values = rng.choice([0.0, 1e-30, np.inf, *rng.uniform(size=9)], 20).astype(dtype)
    mask = np.arange(20) % 2 == 0
    result = masked_quantile(jnp.asarray(values), jnp.asarray(mask), share)
    valid = np.sort(values[mask])
    assert result == next(v for v in valid if np.mean(valid <= v) >= share - 1e-9)


def test_quantile_of_a_share_below_one_value_is_the_smallest_valid_one():
    values, mask = jnp.asarray([9.0, 0.5, 0.25, jnp.nan]), jnp.asarray([False, True, True, False])
    assert masked_quantile(values, mask, 1e-4) == 0.25


def test_widths_fall_by_equal_factors_to_one():
    widths = widenings(4, 8.0, jnp.dtype("float64"))
    np.testing.assert_allclose(widths, [8, 4, 2, 1])


def test_a_single_iteration_has_the_final_width():
    np.testing.assert_array_equal(widenings(1, 8.0, jnp.dtype("float64")), [1])
