"""The reformulations for XLA:CPU are identities, of any shape and dtype, in value and derivative."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg._xla import at_row_min, gradient_written_out, row_min, written_out
from jaxreg.batching import map_pairs, one_at_a_time


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


def smooth(inputs, constants):
    """A function of one pair, with inputs and results of several shapes and an integer constant."""
    x, y = inputs
    return {"map": jnp.sin(x) @ y.T, "sum": jnp.sum(x[constants] * y[constants] ** 2, axis=0)}


def batch_of_pairs(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, 4, 6, 3))
    return (jnp.asarray(x), jnp.asarray(y)), jnp.asarray(rng.integers(0, 6, (4, 5)))


def test_pairs_in_a_loop_give_what_vmap_gives(seed):
    inputs, constants = batch_of_pairs(seed)
    expected = jax.vmap(smooth)(inputs, constants)
    for form in (map_pairs(smooth), jax.vmap(one_at_a_time(smooth))):
        chex.assert_trees_all_close(jax.jit(form)(inputs, constants), expected, rtol=1e-12)
    one = jax.tree.map(lambda x: x[0], (inputs, constants))
    chex.assert_trees_all_close(one_at_a_time(smooth)(*one), smooth(*one), rtol=1e-12)


@pytest.mark.parametrize("shared", ["nothing", "reference", "constants"])
def test_so_does_their_gradient_where_vmap_shares_arguments_too(seed, shared):
    inputs, constants = batch_of_pairs(seed)
    axes = ((0, 0), 0)
    if shared == "reference":
        inputs, axes = (inputs[0], inputs[1][0]), ((0, None), 0)
    if shared == "constants":
        constants, axes = constants[0], ((0, 0), None)

    def gradient(function):
        def loss(inputs):
            result = jax.vmap(function, in_axes=axes)(inputs, constants)
            return sum(jnp.sum(jnp.cos(x)) for x in result.values())

        return jax.jit(jax.grad(loss))(inputs)

    chex.assert_trees_all_close(
        gradient(one_at_a_time(smooth)), gradient(smooth), rtol=1e-12, atol=1e-14
    )
