"""Elementary functions that stay correct and differentiable at the points where they usually break.

Every function here has a finite derivative everywhere. Where the true one does not exist (a norm at
the origin, an angle of parallel vectors) it is zero, which is a valid subgradient of each of them.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import arguments


def safe_sqrt(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """``sqrt(max(x, 0))`` whose derivative at ``x <= 0`` is 0 instead of infinite; NaN stays NaN."""
    zero = x <= 0
    # The double `where`: the branch that is not taken must not see a zero either, because its
    # infinite derivative times the zero of the outer `where` would be NaN.
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, x)))


def safe_norm(x: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """Euclidean norm along `axis`, with derivative 0 at the origin."""
    return safe_sqrt(jnp.sum(x * x, axis=axis))


def all_finite(tree: Any) -> Bool[Array, ""]:
    """Whether no number in a tree of arrays is NaN or infinite."""
    found = jnp.ones((), bool)
    for leaf in jax.tree.leaves(tree):
        found &= jnp.all(jnp.isfinite(leaf))
    return found


def leading_max(x: Float[Array, "k *rest"]) -> Float[Array, "*rest"]:
    """Maximum over the first axis; equal entries share its derivative.

    The derivative of `jnp.max` divides by the number of entries that equal the maximum. If XLA
    computes those entries again, in another kernel, they may differ from it in the last bit: none
    is equal, and the derivative is NaN. Here two entries at a time are compared, and one always wins.
    """
    while x.shape[0] > 1:
        half = (x.shape[0] + 1) // 2  # The halves of an odd number of entries overlap.
        x = jnp.maximum(x[:half], x[x.shape[0] - half :])
    return x[0]


def _unit_scale(x: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """`x` scaled to a largest coordinate of magnitude 1: no square under- or overflows."""
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=-1, keepdims=True))
    return x / jnp.where(largest > 0, largest, 1)


def included_angle(u: Float[Array, "... 3"], v: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Angle between `u` and `v` in radians, ``atan2(|u x v|, u . v)`` (Eq. 8), in [0, pi].

    Accurate at 0 and at pi, where ``arccos`` loses half of its digits. A zero vector makes an angle
    of 0 with everything. Leading axes broadcast.

    Raises:
      ValueError: one of them is not ``(..., 3)`` of float32 or float64, or they do not broadcast.
    """
    u, v = arguments.numbers("u", u), arguments.numbers("v", v)
    arguments.one_dtype(u=u, v=v)
    try:
        shape = jnp.broadcast_shapes(u.shape, v.shape)
    except ValueError:
        shape = ()
    if not (u.shape[-1:] == v.shape[-1:] == shape[-1:] == (3,)):
        raise ValueError(f"u and v must be (..., 3) and broadcast, got {u.shape} and {v.shape}.")
    # An angle does not depend on lengths, so the scale may be a constant of the derivative.
    u, v = _unit_scale(u), _unit_scale(v)
    cross, dot = safe_norm(jnp.cross(u, v)), jnp.sum(u * v, axis=-1)
    degenerate = (cross == 0) & (dot == 0)
    return jnp.where(degenerate, 0, jnp.arctan2(cross, jnp.where(degenerate, 1, dot)))
