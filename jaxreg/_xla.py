"""Identities that make XLA:CPU compile something faster; correct, and harmless, everywhere.

Each was measured on jaxlib 0.10 (benchmarks/speed/speed.py shows the stages); check again on a new one.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped


def row_min(x: Shaped[Array, "n m"]) -> Shaped[Array, "n"]:
    """``min_j x[i, j]``, for integers too; five times as fast on a CPU as `jnp.min` along rows.

    XLA:CPU takes the minimum of a row one number at a time, but that of two blocks with vector
    instructions. So rows are folded four times first; in an odd row the halves overlap.
    """
    for _ in range(4):
        half = (x.shape[1] + 1) // 2
        x = jnp.minimum(x[:, :half], x[:, x.shape[1] - half :])
    return jnp.min(x, axis=1)


def at_row_min(x: Float[Array, "n m"]) -> Bool[Array, "n m"]:
    """Where the entries of a row equal its minimum, up to rounding; at least one in every row.

    Without the allowance there might be none: XLA computes `x` anew for the comparison, in another
    kernel, and the last bit may differ.
    """
    x = jax.lax.stop_gradient(x)
    smallest = row_min(x)[:, None]
    return x <= smallest + 8 * jnp.finfo(x.dtype).eps * jnp.abs(smallest)


def written_out(x: Shaped[Array, "n *rest"]) -> Shaped[Array, "n *rest"]:
    """`x`, written to memory before anything reads it.

    XLA merges a transposition with what comes before or after it, and then goes through memory at
    strides, number by number; alone it is ten times as fast. `optimization_barrier` is gone when that
    happens, but nothing crosses the border of a loop, so the rows are copied in one. Has no derivative.
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


"""How this library compiles and runs on a CPU: compiler options, the cache on disk, memory pages."""


# XLA:CPU fuses softmax -> products -> exp -> softmax into one kernel that runs several times slower
# than its parts (measured on jaxlib 0.10; benchmarks/ compares both on the machine at hand).
_CPU_OPTIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}


def jit(function: Callable, **options) -> Callable:
    """`jax.jit` with the compiler options that the default backend wants; `options` are jit's.

    They are chosen when the result is first used: until then no backend is started, so that a
    program may import this library and configure JAX afterwards. JAX takes compiler options for whole
    programs only: the result is called as it is or under `jax.vmap`, and not within another `jax.jit`
    or under `jax.grad`; give those the function, and this what they return.
    """

    @functools.cache
    def jitted() -> Callable:
        chosen = _chosen_options() | options.get("compiler_options", {})
        return jax.jit(function, **options | {"compiler_options": chosen})

    @functools.wraps(function)
    def call(*arguments, **keywords):
        return jitted()(*arguments, **keywords)

    for name in ("lower", "trace", "eval_shape", "clear_cache", "_cache_size"):
        setattr(call, name, _method(jitted, name))
    return call


def _method(jitted: Callable[[], Callable], name: str) -> Callable:
    return lambda *arguments, **keywords: getattr(jitted(), name)(*arguments, **keywords)


def _chosen_options() -> dict[str, str]:
    if jax.default_backend() == "cpu" and _known(tuple(_CPU_OPTIONS.items())):
        return _CPU_OPTIONS
    return {}


@functools.cache
def _known(options: tuple[tuple[str, str], ...]) -> bool:
    """Whether XLA takes `options`, tried once on an empty program.

    XLA drops experimental options without notice, and would then compile nothing at all. Costs some
    9 ms of a start: most of what it takes, the first program would take instead.
    """
    try:
        with jax.log_compiles(False):  # One who counts programs looks for those of his own.
            jax.jit(lambda: None, compiler_options=dict(options)).lower().compile()
    except (jax.errors.JaxRuntimeError, ValueError):
        return False
    return True
