"""The reformulations for XLA:CPU are identities, of any shape and dtype, in value and derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg._xla import at_row_min, gradient_written_out, row_min, unfused, written_out


@pytest.mark.parametrize("width", [1, 2, 3, 7, 16, 33, 50])
@pytest.mark.parametrize("dtype", ["float32", "float64", "int32"])
def test_minimum_of_rows_of_any_width(seed, width, dtype):
    x = np.random.default_rng(seed).normal(0, 100, (5, width)).astype(dtype)
    np.testing.assert_array_equal(jax.jit(row_min)(x), x.min(axis=1))


def test_minimum_sees_infinity_and_nan():
    x = np.array([[np.inf, 2, np.inf], [np.inf] * 3, [1, np.nan, 0]])
    np.testing.assert_array_equal(jax.jit(row_min)(x), [2, np.inf, np.nan])


def test_the_place_of_the_minimum_forgives_the_last_bit():
    x = np.array([[3, 1, 1 + 2e-16, 1.001], [np.inf] * 4, [0, 1e-300, 0, 5], [-2, 2, -2, -1.999]])
    expected = [[0, 1, 1, 0], [1, 1, 1, 1], [1, 0, 1, 0], [1, 0, 1, 0]]
    np.testing.assert_array_equal(jax.jit(at_row_min)(x), expected)


@pytest.mark.parametrize("shape", [(1, 4), (2, 1), (5, 3), (8, 2, 3)])
def test_writing_out_changes_nothing(seed, shape):
    x = np.random.default_rng(seed).normal(size=(2, *shape))
    np.testing.assert_array_equal(jax.jit(jax.vmap(written_out))(x), x)


def test_a_gradient_written_out_is_the_gradient(seed):
    rng = np.random.default_rng(seed)
    x, tangent, target = rng.normal(size=(3, 4, 5, 6))

    def value(x):
        return jnp.sum(jnp.sin(gradient_written_out(x)) * target)

    np.testing.assert_allclose(jax.jit(jax.grad(value))(x), np.cos(x) * target, atol=1e-15)
    derivative = jax.jit(lambda x, t: jax.jvp(value, (x,), (t,))[1])(x, tangent)
    np.testing.assert_allclose(derivative, np.sum(np.cos(x) * target * tangent), rtol=1e-12)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_is_unfused_is_the_same_to_the_last_bit(seed, dtype):
    bits = np.random.default_rng(seed).integers(-(2**62), 2**62, 500)
    x = np.concatenate([bits.view(dtype), np.array([0.0, -0.0, np.inf, -np.inf], dtype)])
    x = x[~np.isnan(x)]
    unsigned = f"u{x.dtype.itemsize}"
    np.testing.assert_array_equal(
        np.asarray(jax.jit(jax.vmap(unfused))(x)).view(unsigned), x.view(unsigned)
    )
    assert np.isnan(unfused(jnp.asarray(np.nan, dtype)))


def test_the_derivative_of_what_is_unfused_is_one(seed):
    x, tangent = np.random.default_rng(seed).normal(size=(2, 7))
    value, derivative = jax.jvp(unfused, (x,), (tangent,))
    np.testing.assert_array_equal(value, x)
    np.testing.assert_array_equal(derivative, tangent)
    np.testing.assert_array_equal(jax.vjp(unfused, x)[1](jnp.asarray(tangent))[0], tangent)
