"""The one check, at trace time, of the arrays that pure functions are given.

What is wrong is a ValueError that names the argument and the remedy; without it XLA would clamp rows
that do not exist, invert the bits of an integer mask, or fail deep inside. Numbers follow one rule:
float32 or float64, one of them in all arrays of a call, and the result has it too. Half precision
and integers are refused: what they lose is for the caller to decide, before the call.
"""

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from jaxreg.types import RigidTransform


def cloud(name: str, points: Any) -> Array:
    """`points` as a JAX array.

    Raises:
      ValueError: it is not ``(n, 3)`` with at least one row, or not of float32 or float64.
    """
    points = numbers(name, points)
    if points.ndim != 2 or points.shape[1] != 3 or points.shape[0] == 0:
        raise ValueError(
            f"{name} must have shape (n, 3) with n >= 1, got {points.shape}: give one cloud, and use "
            "jax.vmap for a batch."
        )
    return points


def clouds(source: Any, reference: Any) -> tuple[Array, Array]:
    """Both clouds of a pair; raises what `cloud` raises, and a ValueError if their dtypes differ."""
    source, reference = cloud("source", source), cloud("reference", reference)
    one_dtype(source=source, reference=reference)
    return source, reference


def mask(name: str, given: Any, count: int) -> Array | None:
    """A mask of `count` rows, or None.

    Raises:
      ValueError: it is not bool of shape ``(count,)``; of integers, ``~mask`` would invert the bits.
    """
    if given is None:
        return None
    given = _array(name, given)
    if given.dtype != bool or given.shape != (count,):
        raise ValueError(
            f"{name} must be bool of shape {(count,)}, got {given.dtype} of {given.shape}: give True "
            "for every row that is a point, False for padding."
        )
    return jnp.asarray(given)


def rows(name: str, given: Any, shape: tuple[int, ...], like: Array) -> Array:
    """What goes with a cloud, such as a normal for every point: of `shape`, in the dtype of `like`.

    Raises:
      ValueError: it has another shape, or another dtype.
    """
    given = numbers(name, given)
    if given.shape != shape:
        raise ValueError(
            f"{name} must have shape {shape}, got {given.shape}: give one row for every point."
        )
    if given.dtype != like.dtype:
        raise ValueError(
            f"{name} has dtype {given.dtype}, but the points {like.dtype}: give both in one, as in "
            f"jnp.asarray({name}, points.dtype)."
        )
    return given


def indices(name: str, given: Any, count: int) -> Array:
    """The neighbours of `count` points.

    Raises:
      ValueError: it is not ``(count, k)`` of integers.
    """
    given = jnp.asarray(_array(name, given))
    if given.ndim != 2 or given.shape[0] != count or not jnp.issubdtype(given.dtype, jnp.integer):
        raise ValueError(
            f"{name} must be integers of shape ({count}, k), a row for every point, got "
            f"{given.dtype} of {given.shape}: take them from jaxreg.knn."
        )
    return given


def transform(name: str, given: Any) -> RigidTransform:
    """One transform: a `RigidTransform`, or a result that has its parts.

    Raises:
      ValueError: it is neither, or its parts are not (3, 3) and (3,), of float32 or float64.
    """
    if batch := leading_axes(name, given):
        raise ValueError(
            f"{name} must be one transform with a rotation (3, 3) and a translation (3,), but has the "
            f"leading axes {batch}: use jax.vmap for a batch."
        )
    return RigidTransform(given.rotation, given.translation)


def leading_axes(name: str, given: Any) -> tuple[int, ...]:
    """The axes before (3, 3) and (3,) of one or many transforms, which must be the same.

    Raises:
      ValueError: it is not a transform, or its parts have other shapes, or other dtypes than float32
        and float64.
    """
    if not (hasattr(given, "rotation") and hasattr(given, "translation")):
        raise ValueError(
            f"{name} must be a RigidTransform, got {type(given).__name__}: make one with "
            "jaxreg.from_matrix(matrix), or jaxreg.RigidTransform(rotation, translation)."
        )
    check_numbers(f"{name}.rotation", given.rotation)
    check_numbers(f"{name}.translation", given.translation)
    rotation, translation = given.rotation.shape, given.translation.shape
    if rotation[-2:] != (3, 3) or translation != (*rotation[:-2], 3):
        raise ValueError(
            f"{name} must be a transform with a rotation (..., 3, 3) and a translation (..., 3), not "
            f"{rotation} and {translation}."
        )
    return rotation[:-2]


def scalar(name: str, given: Any, dtype: Any, *, positive: bool = True) -> Array | float:
    """One number of the caller's unit, which may be traced: a Python float, or an array of `dtype`.

    Raises:
      ValueError: it is not one number, or, as far as it is known, not positive.
    """
    array = np.ndim(given) != 0 or not jnp.issubdtype(jnp.result_type(given), np.number)
    if array or jnp.issubdtype(jnp.result_type(given), np.complexfloating):
        raise ValueError(f"{name} must be one real number, got shape {np.shape(given)}.")
    if positive and not isinstance(given, Tracer) and not given > 0:
        raise ValueError(f"{name} = {given}: give a positive number.")
    return given if type(given) in (int, float) else jnp.asarray(given, dtype)


def count(name: str, given: Any, least: int = 0) -> int:
    """A number that shapes or loops depend on.

    Raises:
      ValueError: it is not an integer of at least `least`, or it is traced.
    """
    try:
        found = operator.index(given)
    except TypeError:  # and so are JAX's errors of traced integers
        kind = "traced" if isinstance(given, Tracer) else repr(given)
        raise ValueError(
            f"{name} must be a Python integer, but is {kind}: make it static (static_argnames of "
            "jax.jit)."
        ) from None
    if found < least:
        raise ValueError(f"{name} = {found}: choose at least {least}.")
    return found


def numbers(name: str, given: Any) -> Array:
    """`given` as a JAX array; raises what `check_numbers` raises."""
    check_numbers(name, given)
    return jnp.asarray(given)


def check_numbers(name: str, given: Any) -> None:
    """Raise ValueError unless it is an array of float32 or float64 that JAX can hold."""
    given = _array(name, given)
    kept = jax.dtypes.canonicalize_dtype(given.dtype)
    if kept not in (np.float32, np.float64):
        raise ValueError(
            f"{name} has dtype {given.dtype}: give float32 or float64, as in "
            f"jnp.asarray({name}, jnp.float32)."
        )
    # Without x64 JAX turns float64 into float32, and what is larger into infinity.
    if isinstance(given, np.ndarray) and given.dtype.itemsize > kept.itemsize and given.size:
        largest = np.abs(given).max(initial=0, where=np.isfinite(given))
        if largest > np.finfo(kept).max:
            raise ValueError(
                f"{name} contains {largest:g}, which {kept} cannot hold: use a larger unit, or "
                "jax.config.update('jax_enable_x64', True)."
            )


def one_dtype(**arrays: Array) -> None:
    """Raise ValueError if these arrays have different dtypes."""
    (first, one), *others = arrays.items()
    for name, array in others:
        if array.dtype != one.dtype:
            raise ValueError(
                f"{first} has dtype {one.dtype} and {name} {array.dtype}: give both in one, as in "
                f"{name}.astype({first}.dtype)."
            )


def settings(name: str, given: Any, kind: type) -> None:
    """Raise ValueError unless `given` are settings of that kind, with no traced value among them."""
    if not isinstance(given, kind):
        raise ValueError(f"{name} must be a jaxreg.{kind.__name__}, got {type(given).__name__}.")
    for field, value in vars(given).items():
        if isinstance(value, Tracer):
            raise ValueError(
                f"{name}.{field} is traced: settings are static. Give a Python number, or make the "
                "function that is jitted take it by static_argnames."
            )


def usable(name: str, points: Array, given: Any) -> Array:
    """The mask of a cloud (None: every row), or False everywhere if a valid point is not finite.

    One NaN would reach every point. What is only known in a compiled program cannot be an error, so
    that such a cloud counts as empty. Raises what `mask` raises.
    """
    valid = mask(name, given, points.shape[0])
    valid = jnp.ones(points.shape[0], bool) if valid is None else valid
    finite = jnp.all(jnp.isfinite(points), axis=1)
    return valid & jnp.all(finite | ~valid)


def _array(name: str, given: Any) -> Any:
    if not (hasattr(given, "shape") and hasattr(given, "dtype")):
        raise ValueError(
            f"{name} must be an array, got {type(given).__name__}: give jnp.asarray({name})."
        )
    return given
