"""Many pairs: in turn on a CPU, at once elsewhere."""

from collections.abc import Callable
from typing import Any

import jax
from jax.custom_batching import sequential_vmap


def map_pairs(function: Callable[..., Any]) -> Callable[..., Any]:
    """``jax.vmap(function)``, or on a CPU a loop over the batch.

    One pair fits into the cache; a whole batch would go through main memory once per operation.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function)
    return lambda *batch: jax.lax.map(lambda pair: function(*pair), batch)


def one_at_a_time(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """``function(inputs, constants)`` that is batched, with its gradient, by a loop.

    For a part of a program whose other parts need the whole batch at once, as BatchNorm does; see
    `map_pairs`. The gradient recomputes the function and stores only its arguments. Reverse mode
    only, and `constants` has no derivative. Off the CPU it is `function` itself.
    """
    if jax.default_backend() != "cpu":
        return function

    # On its own, sequential_vmap supports forward mode only.
    call = jax.custom_vjp(sequential_vmap(function))

    @sequential_vmap
    def pull_back(inputs, constants, cotangent):
        return jax.vjp(lambda x: function(x, constants), inputs)[1](cotangent)[0]

    def forward(inputs, constants):
        return call(inputs, constants), (inputs, constants)

    def backward(arguments, cotangent):
        return pull_back(*arguments, cotangent), None

    call.defvjp(forward, backward)
    return call
