"""Square roots, norms and angles at the points where they usually break."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.geometry import numerics
from tests import oracles

safe_sqrt = jax.jit(numerics.safe_sqrt)
safe_norm = jax.jit(numerics.safe_norm, static_argnames="axis")
included_angle = jax.jit(numerics.included_angle)


def test_square_root_is_numpy_s_where_that_is_real():
    x = np.array([1e-300, 1e-12, 0.25, 1.0, 2.0, 1e12, np.inf])
    np.testing.assert_allclose(safe_sqrt(x), np.sqrt(x), rtol=1e-15)
    np.testing.assert_array_equal(safe_sqrt(np.array([-1.0, 0.0, -0.0])), 0.0)


def test_nan_stays_nan():
    # A network whose weights have become NaN must not look healthy.
    assert np.isnan(safe_sqrt(jnp.nan))
    assert np.isnan(safe_norm(jnp.array([1.0, jnp.nan, 0.0])))
    assert np.isnan(included_angle(jnp.array([1.0, jnp.nan, 0.0]), jnp.ones(3)))


def test_derivative_of_the_square_root():
    slope = jax.vmap(jax.grad(safe_sqrt))
    np.testing.assert_allclose(slope(np.array([0.25, 4.0])), [1.0, 0.25], rtol=1e-15)
    np.testing.assert_array_equal(slope(np.array([0.0, -1.0])), 0.0)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_norm_and_its_derivative_at_the_origin(dtype, seed):
    x = np.random.default_rng(seed).normal(size=(4, 3)).astype(dtype)
    x[2] = 0
    np.testing.assert_allclose(safe_norm(x), np.linalg.norm(x, axis=1), rtol=1e-6)
    np.testing.assert_allclose(safe_norm(x, axis=0), np.linalg.norm(x, axis=0), rtol=1e-6)
    gradient = jax.grad(lambda x: safe_norm(x).sum())(jnp.asarray(x))
    length = np.where(np.linalg.norm(x, axis=1) > 0, np.linalg.norm(x, axis=1), 1)
    np.testing.assert_allclose(gradient, x / length[:, None], rtol=1e-6)
    second = jax.hessian(safe_norm)(jnp.zeros(3, dtype))
    np.testing.assert_array_equal(second, 0)


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 1e-6), ("float64", 1e-14)])
def test_angle_equals_the_half_angle_formula(dtype, tolerance, seed):
    u, v = np.random.default_rng(seed).normal(size=(2, 50, 3)).astype(dtype)
    expected = [oracles.angle(a, b) for a, b in zip(u.astype(float), v.astype(float), strict=True)]
    np.testing.assert_allclose(included_angle(u, v), expected, atol=tolerance)
    np.testing.assert_allclose(included_angle(v, u), expected, atol=tolerance)


@pytest.mark.parametrize("degrees", [1e-9, 1e-6, 1e-3, 90.0, 179.999, 179.999999])
def test_small_and_flat_angles_keep_their_digits(degrees):
    angle = np.radians(degrees)
    u, v = np.array([1.0, 0, 0]), np.array([np.cos(angle), np.sin(angle), 0])
    np.testing.assert_allclose(included_angle(u, v), angle, rtol=1e-12, atol=1e-22)


def test_angles_of_special_vectors():
    u = np.array([0.3, -1.7, 2.9])
    zero = np.zeros(3)
    assert included_angle(u, u) == pytest.approx(0, abs=1e-15)
    assert included_angle(u, -u) == pytest.approx(np.pi, abs=1e-15)
    assert included_angle(np.array([0, 0, 2.0]), np.array([0, 0, -3.0])) == np.pi
    assert included_angle(u, zero) == included_angle(zero, u) == included_angle(zero, zero) == 0


@pytest.mark.parametrize("scale", [1e-150, 1e-12, 1e12, 1e150])
def test_angle_does_not_depend_on_lengths(scale, seed):
    u, v = np.random.default_rng(seed).normal(size=(2, 3))
    np.testing.assert_allclose(included_angle(scale * u, v), oracles.angle(u, v), rtol=1e-13)
    np.testing.assert_allclose(included_angle(u, scale * v), oracles.angle(u, v), rtol=1e-13)


def test_derivatives_of_the_angle_are_finite_where_it_has_none():
    u, zero = np.array([0.5, -1.0, 2.0]), np.zeros(3)
    pairs = [(u, u), (u, -u), (u, 2 * u), (u, -4 * u), (u, zero), (zero, u), (zero, zero)]
    a, b = (np.array(side) for side in zip(*pairs, strict=True))

    @jax.jit
    @jax.vmap
    def derivatives(a, b):
        both = (0, 1)
        return [d(numerics.included_angle, both)(a, b) for d in (jax.grad, jax.jacfwd, jax.hessian)]

    for derivative in jax.tree.leaves(derivatives(a, b)):
        assert np.isfinite(derivative).all()


def test_second_derivative_of_the_angle_equals_differences_of_the_first(seed):
    u, v, direction = np.random.default_rng(seed).normal(size=(3, 3))
    second = jax.jit(jax.hessian(included_angle))(u, v) @ direction
    gradient = jax.jit(jax.grad(included_angle))
    [difference] = oracles.directional_difference(lambda x: [gradient(x[0], v)], [u], [direction])
    np.testing.assert_allclose(second, difference, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("count", [1, 2, 5, 8, 20])
def test_leading_max_is_numpy_s_and_hands_its_derivative_to_the_largest(count, seed):
    x = np.random.default_rng(seed).normal(size=(count, 6))
    np.testing.assert_array_equal(jax.jit(numerics.leading_max)(x), x.max(axis=0))
    gradient = jax.grad(lambda x: numerics.leading_max(x).sum())(jnp.asarray(x))
    np.testing.assert_array_equal(gradient, (x == x.max(axis=0)).astype(float))
    x[0] = x[-1] = 9.0
    gradient = jax.grad(lambda x: numerics.leading_max(x).sum())(jnp.asarray(x))
    np.testing.assert_allclose(np.sum(gradient, axis=0), 1.0, rtol=1e-15)


def test_one_number_that_is_not_finite_is_found_in_a_tree():
    assert numerics.all_finite({"a": np.ones(3), "b": (np.zeros((2, 2)), None)})
    assert numerics.all_finite(())
    for odd in (np.nan, np.inf, -np.inf):
        assert not numerics.all_finite({"a": np.ones(3), "b": (np.array([[0, odd]]), None)})
