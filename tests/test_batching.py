"""A batch pair by pair gives what `jax.vmap` gives, in value and derivative."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.batching import map_pairs, one_at_a_time


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


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_arguments_by_name_are_of_the_batch_too(seed, backend, monkeypatch):
    inputs, constants = batch_of_pairs(seed)
    expected = jax.vmap(smooth)(inputs, constants)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    mapped = map_pairs(smooth)
    for found in (
        mapped(inputs, constants=constants),
        mapped(constants=constants, inputs=inputs),
        jax.jit(mapped)(inputs, constants=constants),
    ):
        chex.assert_trees_all_close(found, expected, rtol=1e-12)


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


def directions(seed, like):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), like)


def curvatures(loss, inputs, along):
    """The product of the second derivative with a direction, in both modes."""
    forward = jax.jvp(jax.grad(loss), (inputs,), (along,))[1]
    reverse = jax.grad(lambda x: jax.jvp(loss, (x,), (along,))[1])(inputs)
    dots = jax.grad(
        lambda x: sum(
            jnp.vdot(a, b)
            for a, b in zip(jax.tree.leaves(jax.grad(loss)(x)), jax.tree.leaves(along), strict=True)
        )
    )(inputs)
    return forward, reverse, dots


def test_so_does_their_second_derivative_in_every_mode(seed):
    inputs, constants = batch_of_pairs(seed)
    along = directions(seed + 1, inputs)

    def loss(function, inputs):
        result = jax.vmap(function)(inputs, constants)
        return sum(jnp.sum(jnp.cos(x)) for x in result.values())

    ours = jax.jit(lambda x: curvatures(lambda y: loss(one_at_a_time(smooth), y), x, along))
    expected = jax.jvp(jax.grad(lambda x: loss(smooth, x)), (inputs,), (along,))[1]
    for found in ours(inputs):
        chex.assert_trees_all_close(found, expected, rtol=1e-11, atol=1e-13)
