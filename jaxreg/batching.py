"""Many pairs: in turn on a CPU, at once elsewhere."""

from collections.abc import Callable
from typing import Any

import jax
from jax.custom_batching import custom_vmap


def map_pairs(function: Callable[..., Any]) -> Callable[..., Any]:
    """``jax.vmap(function)``, or on a CPU a loop over the batch.

    Arguments by position and by name all have the axis of the batch. One pair fits into the cache; a
    whole batch would go through main memory once per operation.
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(function)
    return lambda *batch, **named: jax.lax.map(
        lambda pair: function(*pair[0], **pair[1]), (batch, named)
    )


def one_at_a_time(function: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """``function(inputs, constants)`` that is batched by a loop.

    For a part of a program whose other parts need the whole batch at once, as BatchNorm does; see
    `map_pairs`. The derivatives of the batch, of any order, recompute the function and store only its
    arguments; within `jax.vmap` there are forward ones only. Off the CPU it is `function` itself.
    """
    if jax.default_backend() != "cpu":
        return function
    recomputed = jax.checkpoint(function, prevent_cse=False)
    call = custom_vmap(function)

    @call.def_vmap
    def loop(axis_size, batched, inputs, constants):
        leaves, tree = jax.tree.flatten((inputs, constants))
        mapped = jax.tree.leaves(batched)

        def one(own):
            rest = iter(own)
            pair = [next(rest) if has else leaf for leaf, has in zip(leaves, mapped, strict=True)]
            return recomputed(*jax.tree.unflatten(tree, pair))

        own = [leaf for leaf, has in zip(leaves, mapped, strict=True) if has]
        found = jax.lax.map(one, own)
        return found, jax.tree.map(lambda _: True, found)

    return call
