"""Weights of pairs against the published formulas, and the quantile against a sort."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.refine.robust import (
    Weighting,
    counting_pairs,
    kernel_weight,
    masked_quantile,
    pair_weights,
    widenings,
)

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
    np.testing.assert_array_equal(counting_pairs(squared, mask, trim), [1, 1, 1, 0, 0])
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
