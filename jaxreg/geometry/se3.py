"""The group SE(3): exponential, logarithm, adjoint, and the derivative of the logarithm.

A twist ``(omega, v)`` is a rotation vector (radians) and a translation, rotation first. Formulas:
Sola, Deray and Atchuthan, "A micro Lie theory", 2018; Barfoot, "State estimation for robotics",
2017, eq. 7.95. All take any leading axes, and numpy or JAX arrays: the host solves in numpy, where
nothing must be compiled, and a program in JAX.
"""

from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Float

from jaxreg.types import RigidTransform

_SMALL = 1e-2
"""Angles below it (radians) take a series: its next term is below 1e-13 of the first."""
_SQUARE = 0.1
"""So do squared angles below this one where the closed form loses digits sooner."""


def exp(twist: Float[Any, "*b 6"]) -> RigidTransform:
    """The transform ``exp(twist)``: ``(exp(omega), V(omega) v)``."""
    xp = module_of(twist)
    omega, v = twist[..., :3], twist[..., 3:]
    squared = xp.sum(omega * omega, axis=-1)[..., None]
    small = squared < _SMALL**2
    safe = xp.where(small, 1.0, squared)
    angle = xp.sqrt(safe)
    sine = xp.where(small, 1 - squared / 6 * (1 - squared / 20), xp.sin(angle) / angle)
    first = xp.where(small, 0.5 - squared / 24 * (1 - squared / 30), (1 - xp.cos(angle)) / safe)
    second = xp.where(
        small, 1 / 6 - squared / 120 * (1 - squared / 42), (angle - xp.sin(angle)) / (safe * angle)
    )
    once = xp.cross(omega, v)
    cross = skew(omega)
    turn = _eye(cross) + sine[..., None] * cross
    turn = turn + first[..., None] * product(cross, cross)
    return RigidTransform(turn, v + first * once + second * xp.cross(omega, once))


def log(transform: RigidTransform) -> Float[Any, "*b 6"]:
    """The twist of a transform, with a rotation of at most pi: the inverse of `exp`.

    Its derivative is finite everywhere, and right wherever the rotation is below pi.
    """
    xp = module_of(transform.rotation)
    omega, t = rotation_vector(transform.rotation), transform.translation
    squared = xp.sum(omega * omega, axis=-1)[..., None]
    small = squared < _SQUARE
    safe = xp.where(small, 1.0, squared)
    angle = xp.sqrt(safe)
    exact = 1 / safe - xp.cos(angle / 2) / (2 * angle * xp.sin(angle / 2))
    series = 1 / 12 + squared / 720 * (
        1 + squared / 42 * (1 + squared / 40 * (1 + squared / 39.6))
    )  # fmt: skip
    once = xp.cross(omega, t)
    v = t - once / 2 + xp.where(small, series, exact) * xp.cross(omega, once)
    return xp.concatenate([omega, v], axis=-1)


def rotation_vector(rotation: Float[Any, "*b 3 3"]) -> Float[Any, "*b 3"]:
    """Axis times angle (radians, at most pi) of a rotation, by way of its unit quaternion."""
    xp = module_of(rotation)
    quaternion = _quaternion(rotation)
    vector = quaternion[..., 1:]
    squared = xp.sum(vector * vector, axis=-1)[..., None]
    small = squared < _SMALL**2
    length = xp.sqrt(xp.where(small, 1.0, squared))
    # 2 asin(x) / x where x is small; w is then near 1.
    series = 2 + squared / 3 * (1 + 9 / 20 * squared)
    return vector * xp.where(small, series, 2 * xp.arctan2(length, quaternion[..., :1]) / length)


def adjoint(transform: RigidTransform) -> Float[Any, "*b 6 6"]:
    """``Ad``: ``T exp(xi) T^-1 = exp(Ad xi)``."""
    turn = transform.rotation
    return _lower_blocks(turn, product(skew(transform.translation), turn))


def inverse_right_jacobian(twist: Float[Any, "*b 6"]) -> Float[Any, "*b 6 6"]:
    """``J``, with ``log(exp(twist) exp(delta)) = twist + J delta`` to first order.

    A polynomial in the adjoint of the Lie algebra, whose fifth power is one of its lower ones.
    """
    xp = module_of(twist)
    squared = xp.sum(twist[..., :3] * twist[..., :3], axis=-1)[..., None, None]
    small = squared < _SQUARE
    safe = xp.where(small, 1.0, squared)
    angle = xp.sqrt(safe)
    sine, cosine = xp.sin(angle), xp.cos(angle)
    # The denominators vanish at 0 and at 2 pi; a logarithm is at most pi.
    second = 2 / safe + (angle + 3 * sine) / (4 * angle * (cosine - 1))
    fourth = 1 / safe**2 + (angle + sine) / (4 * angle * safe * (cosine - 1))
    second = xp.where(small, 1 / 12 - squared**2 / 30240 * (1 + squared / 20), second)
    fourth = xp.where(
        small, -1 / 720 - squared / 15120 * (1 + squared * (3 / 80 + squared / 825)), fourth
    )
    algebra = _lower_blocks(skew(twist[..., :3]), skew(twist[..., 3:]))
    square = product(algebra, algebra)
    return _eye(algebra) + algebra / 2 + second * square + fourth * product(square, square)


def skew(vector: Float[Any, "*b 3"]) -> Float[Any, "*b 3 3"]:
    """``[v]_x``, the matrix of ``x -> v x x`` (cross product)."""
    xp = module_of(vector)
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = xp.zeros_like(x)
    rows = xp.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1)
    return rows.reshape(*vector.shape[:-1], 3, 3)


def product(a: Any, b: Any) -> Any:
    """``a @ b``, in full precision wherever it runs."""
    if module_of(a) is np:
        return a @ b
    return jnp.matmul(a, b, precision=Precision.HIGHEST)


def applied(matrix: Float[Any, "*b i j"], vector: Float[Any, "*b j"]) -> Float[Any, "*b i"]:
    """``matrix @ vector``, each with its own."""
    return product(matrix, vector[..., None])[..., 0]


def between(reference: RigidTransform, source: RigidTransform) -> RigidTransform:
    """``X_r^-1 X_s``."""
    back = reference.rotation.mT
    shift = applied(back, source.translation - reference.translation)
    return RigidTransform(product(back, source.rotation), shift)


def composed(second: RigidTransform, first: RigidTransform) -> RigidTransform:
    """The transform that applies `first`, then `second`."""
    shift = applied(second.rotation, first.translation) + second.translation
    return RigidTransform(product(second.rotation, first.rotation), shift)


def inverted(transform: RigidTransform) -> RigidTransform:
    """The transform back."""
    back = transform.rotation.mT
    return RigidTransform(back, -applied(back, transform.translation))


def module_of(array: Any) -> ModuleType:
    """The module whose functions take this array: numpy or jax.numpy."""
    return np if isinstance(array, np.ndarray | np.generic) else jnp


def _eye(like: Any) -> Any:
    """The unit matrix, with as many axes as `like`: JAX may be told not to add axes."""
    eye = module_of(like).eye(like.shape[-1], dtype=like.dtype)
    return eye.reshape((1,) * (like.ndim - 2) + eye.shape)


def _lower_blocks(diagonal: Any, lower: Any) -> Any:
    """``[[D, 0], [L, D]]``."""
    xp = module_of(diagonal)
    top = xp.concatenate([diagonal, xp.zeros_like(diagonal)], axis=-1)
    return xp.concatenate([top, xp.concatenate([lower, diagonal], axis=-1)], axis=-2)


def _quaternion(rotation: Float[Any, "*b 3 3"]) -> Float[Any, "*b 4"]:
    """The unit quaternion (w first, w >= 0), from the largest row of its outer product with itself."""
    xp = module_of(rotation)
    r = [[rotation[..., i, j] for j in range(3)] for i in range(3)]
    trace = r[0][0] + r[1][1] + r[2][2]
    x, y, z = (2 * r[i][i] - trace for i in range(3))
    a, b, c = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    d, e, f = r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]
    rows = xp.stack([1 + trace, a, b, c, a, 1 + x, d, e, b, d, 1 + y, f, c, e, f, 1 + z], axis=-1)
    rows = rows.reshape(*rotation.shape[:-2], 4, 4)
    largest = xp.argmax(xp.stack([trace, x, y, z], axis=-1), axis=-1)
    row = xp.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    row = row / xp.sqrt(xp.sum(row * row, axis=-1))[..., None]
    return xp.where(row[..., :1] < 0, -row, row)
