"""Identities that make XLA:CPU compile something faster; correct, and harmless, everywhere.

Each was measured on jaxlib 0.10 (benchmarks/speed/speed.py shows the stages); check them on a newer
one.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec
from jaxtyping import Array, Bool, Float, Shaped

from jaxreg import _traced

_Function = TypeVar("_Function", bound=Callable[..., Any])


def row_min(x: Shaped[Array, "n m"]) -> Shaped[Array, "n"]:
    """``min_j x[i, j]``, for integers too; five times as fast on a CPU as `jnp.min` along rows.

    XLA:CPU takes the minimum of a row one number at a time, but that of two blocks with vector
    instructions. So rows are first folded four times; in an odd row the halves overlap.
    """
    for _ in range(4):
        half = (x.shape[1] + 1) // 2
        x = jnp.minimum(x[:, :half], x[:, x.shape[1] - half :])
    return jnp.min(x, axis=1)


def at_row_min(x: Float[Array, "n m"]) -> Bool[Array, "n m"]:
    """Where the entries of a row equal its minimum, up to rounding; at least one in every row.

    Without the allowance there might be none: XLA computes `x` again for the comparison, in another
    kernel, and the last bit may differ.
    """
    x = jax.lax.stop_gradient(x)
    smallest = row_min(x)[:, None]
    return x <= smallest + 8 * jnp.finfo(x.dtype).eps * jnp.abs(smallest)


def written_out(x: Shaped[Array, "n *rest"]) -> Shaped[Array, "n *rest"]:
    """`x`, written to memory before anything reads it.

    XLA fuses a transpose with what comes before or after it, and then goes through memory at
    strides, number by number; alone it is ten times as fast. XLA removes `optimization_barrier`
    before that, but it does not fuse across loops, so the rows are copied in a loop. Has no derivative.
    """
    n = x.shape[0]
    half = (n + 1) // 2

    def copy(part, out):
        start = jnp.minimum(part * half, n - half)
        rows = jax.lax.dynamic_slice_in_dim(x, start, half)
        return jax.lax.dynamic_update_slice_in_dim(out, rows, start, axis=0)

    return jax.lax.fori_loop(0, 2, copy, jnp.zeros_like(x))


def gradient_written_out(x: Shaped[Array, "*n c"]) -> Shaped[Array, "*n c"]:
    """`x`, whose cotangent is written to memory before anything reads it (see `written_out`).

    The gradient of a layer's weights is a product with the transposed cotangent of its output.
    """

    def write(_, cotangent):
        return written_out(cotangent.reshape(-1, x.shape[-1])).reshape(x.shape)

    # Linear, with its transpose written out; see matching.neighborhood_sum.
    return jax.lax.custom_linear_solve(lambda x: x, x, solve=lambda _, x: x, transpose_solve=write)


def unfused(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """`x`, as the end of a kernel of XLA:CPU: for a large product that is followed by arithmetic.

    XLA:CPU hands products to the library YNN together with the arithmetic around them, which costs a
    fifth more than the product and the arithmetic in two kernels. YNN has no `reduce_precision`, and
    to the precision that `x` has it changes no bit; other backends drop it.
    """
    precision = jnp.finfo(x.dtype)
    return jax.lax.reduce_precision(x, precision.nexp, precision.nmant)


def varying_like(x: Shaped[Array, "..."], like: Shaped[Array, "..."]) -> Shaped[Array, "..."]:
    """`x`, broadcast against `like`, and as different on the devices of a mesh as `like` is.

    Under `jax.shard_map` a loop whose state begins with a constant, the same everywhere, must not end
    with a state that differs. The choice between `x` and `x` is nothing to compute.
    """
    return jnp.where(jax.lax.stop_gradient(like) == 0, x, x)


def from_host(function: _Function, *, told: tuple[Any, ...] = ()) -> _Function:
    """`function`, a jitted one, for arrays of the host: it is meant to take them from there.

    So `jax.transfer_guard("disallow")`, with which programs look for transfers that nobody meant, does
    not stop it. (To `jax.device_put` every argument takes longer than most of these functions.) Its
    program may be kept for the next process; `told` are the values that it closes over.
    """

    @functools.wraps(function)
    def call(*arguments, **static):
        with jax.transfer_guard_host_to_device("allow"):
            return _traced.call(function, told, arguments, static)

    return call  # pyright: ignore[reportReturnType]


def on_any_mesh(function: _Function) -> _Function:
    """`function` of one pair, in which XLA decides what lies where, whatever axes a mesh has.

    Where the axes of a mesh are explicit, as those of `jax.make_mesh` are, JAX asks of every operation
    how its operands lie, and has no answer for a choice between two poses of a batch. What belongs to
    a pair lies whole on the device of that pair, so there is nothing to say.
    """

    @functools.wraps(function)
    def call(*arguments, **named):
        if not jax.sharding.get_abstract_mesh().explicit_axes:
            return function(*arguments, **named)
        leaves, tree = jax.tree.flatten((arguments, named))
        arrays = {i: x for i, x in enumerate(leaves) if hasattr(x, "dtype")}

        def inside(arrays):
            whole = [arrays.get(i, leaf) for i, leaf in enumerate(leaves)]
            arguments, named = jax.tree.unflatten(tree, whole)
            return function(*arguments, **named)

        return jax.sharding.auto_axes(inside, out_sharding=PartitionSpec())(arrays)

    return call  # pyright: ignore[reportReturnType]
