"""Derivatives in both modes, for every row of the table."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.compiled import AS_USERS
from tests.transforms.rows import Row
from tests.transforms.table import TABLE, WHOLE, is_float, rows


def floating(row: Row, inputs: tuple):
    """The function of its floating inputs and outputs alone, as lists of arrays, and its inputs."""
    leaves, tree = jax.tree.flatten(inputs)
    where = [i for i, leaf in enumerate(leaves) if is_float(leaf)]

    def function(values, leaves):
        leaves = list(leaves)
        for i, value in zip(where, values, strict=True):
            leaves[i] = value
        outputs = jax.tree.leaves(row.function(*jax.tree.unflatten(tree, leaves)))
        return [x for x in outputs if is_float(x)]

    return function, [leaves[i] for i in where], leaves


@functools.cache
def compiled(name: str) -> tuple[Callable, Callable]:
    """The value, and both derivatives along directions, of a row; one compilation for each shape."""
    row = TABLE[name]

    @functools.partial(jax.jit, static_argnums=0)
    def both_modes(shape, values, leaves, direction, cotangent):
        function, *_ = floating(row, jax.tree.unflatten(shape, leaves))

        def of_values(values):
            return function(values, leaves)

        outputs, tangent = jax.jvp(of_values, (values,), (direction,))
        _, pull = jax.vjp(of_values, values)
        return outputs, tangent, pull(cotangent)[0]

    return both_modes


def derivatives(name, row, inputs, rng):
    """A random direction, outputs, both derivatives, and a function of a step along the direction.

    The inner products of the forward and of the reverse derivative with a random cotangent, which
    must be equal, come last.
    """
    _, values, leaves = floating(row, inputs)
    direction = [rng.normal(size=np.shape(x)) for x in values]
    tree = jax.tree.structure(inputs)
    shapes = jax.eval_shape(floating(row, inputs)[0], values, leaves)
    cotangent = [rng.normal(size=x.shape) for x in shapes]

    def at(step):
        moved = [x + step * d for x, d in zip(values, direction, strict=True)]
        return compiled(name)(tree, moved, leaves, direction, cotangent)

    outputs, tangent, gradient = at(0.0)
    forward = sum(np.sum(c * t) for c, t in zip(cotangent, tangent, strict=True))
    reverse = sum(np.sum(d * g) for d, g in zip(direction, gradient, strict=True))
    return outputs, tangent, gradient, at, (forward, reverse)


DIFFERENTIABLE = sorted(name for name, row in TABLE.items() if row.generic)


HEAVY = {name for name in DIFFERENTIABLE if name.startswith("refine.")} | {
    "network.model.register_pair"
}
"""Compared with differences in the tests of their own rooms, too."""


@rows(DIFFERENTIABLE, slow=HEAVY | set(WHOLE))
def test_derivatives_at_generic_inputs(name, row, seed):
    rng = np.random.default_rng(seed)
    _, tangent, gradient, at, products = derivatives(name, row, row.generic, rng)
    for x in (*tangent, *gradient):
        assert np.isfinite(x).all()
    np.testing.assert_allclose(*products, rtol=1e-9, atol=1e-10)
    if not row.smooth:
        return
    step = 1e-6
    for t, a, b in zip(tangent, at(step)[0], at(-step)[0], strict=True):
        difference = (np.asarray(a) - np.asarray(b)) / (2 * step)
        scale = max(1.0, np.abs(difference).max(initial=0))
        np.testing.assert_allclose(t, difference, rtol=1e-6, atol=1e-7 * scale)


@pytest.mark.slow
@rows([name for name in DIFFERENTIABLE if TABLE[name].degenerate])
def test_derivatives_are_finite_and_modes_agree_at_degenerate_inputs(name, row, seed):
    rng = np.random.default_rng(seed)
    for number, inputs in enumerate(row.degenerate):
        outputs, tangent, gradient, _, (forward, reverse) = derivatives(name, row, inputs, rng)
        for x in (*outputs, *tangent, *gradient):
            assert np.isfinite(x).all(), f"degenerate input {number}"
        size = max(1.0, abs(forward))
        if row.kinks:
            assert max(abs(forward), abs(reverse)) < 1e6, f"degenerate input {number}"
        else:
            message = f"degenerate input {number}"
            np.testing.assert_allclose(reverse, forward, atol=1e-7 * size, err_msg=message)


@pytest.mark.slow
@rows(["network.losses.step_losses"])
def test_derivatives_hold_in_optimised_kernels_too(name, row, seed):
    """The other tests compile without LLVM's optimisation, which may round a repeated computation
    differently."""
    function, values, leaves = floating(row, row.generic)
    rng = np.random.default_rng(seed)
    direction = [rng.normal(size=np.shape(x)) for x in values]

    def both(values, direction):
        outputs, tangent = jax.jvp(lambda x: function(x, leaves), (values,), (direction,))
        _, pull = jax.vjp(lambda x: function(x, leaves), values)
        return outputs, tangent, pull([jnp.ones_like(x) for x in outputs])[0]

    outputs, tangent, gradient = jax.jit(both, compiler_options=AS_USERS)(values, direction)
    forward = sum(np.sum(t) for t in tangent)
    reverse = sum(np.sum(d * g) for d, g in zip(direction, gradient, strict=True))
    assert all(np.isfinite(x).all() for x in outputs)
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
