"""Rigid transforms: apply, compose, invert, and convert from and to 4x4 matrices and jaxlie.

A transform may have leading axes, ``rotation (*b, 3, 3)`` and ``translation (*b, 3)``: one
transform per index.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import arguments
from jaxreg.types import RigidTransform


def identity(dtype=None) -> RigidTransform:
    """The identity transform."""
    return RigidTransform(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype))


def identity_unless(valid: Bool[Array, ""], transform: RigidTransform) -> RigidTransform:
    """The transform, or the identity where it is not valid."""
    still = identity(transform.rotation.dtype)
    return jax.tree.map(lambda x, y: jnp.where(valid, x, y), transform, still)


def apply(transform: RigidTransform, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """``R x + t`` for every point ``x``; the unit is that of `points`.

    One transform moves points of any shape ``(..., 3)``. Many, with leading axes ``b``, move points
    ``(*b, ..., 3)``, each its own.

    Raises:
      ValueError: the transform has wrong shapes, or those of the points do not begin with its
        leading axes.
    """
    batch = arguments.leading_axes("transform", transform)
    arguments.check_numbers("points", points)
    if points.ndim < 1 or points.shape[-1] != 3:
        raise ValueError(f"points must have shape (..., 3), got {points.shape}.")
    if points.shape[:-1][: len(batch)] != batch:
        raise ValueError(
            f"transforms with the leading axes {batch} cannot move points {points.shape}: give "
            f"points {(*batch, '...', 3)}, or jax.vmap over one of the two."
        )
    rows = points.reshape(*batch, math.prod(points.shape[len(batch) : -1]), 3)
    rotated = jnp.matmul(rows, transform.rotation.mT, precision=Precision.HIGHEST)
    shift = jnp.broadcast_to(transform.translation[..., None, :], rotated.shape)
    return (rotated + shift).reshape(points.shape)


def compose(second: RigidTransform, first: RigidTransform) -> RigidTransform:
    """The transform that applies `first`, then `second`: ``(R2 R1, R2 t1 + t2)``.

    Leading axes broadcast.

    Raises:
      ValueError: one of them has wrong shapes, or their leading axes do not broadcast.
    """
    batches = arguments.leading_axes("second", second), arguments.leading_axes("first", first)
    try:
        batch = jnp.broadcast_shapes(*batches)
    except ValueError:
        raise ValueError(
            f"transforms with the leading axes {batches[0]} and {batches[1]} do not match: give "
            "both the same leading axes, or none to one of them."
        ) from None
    second, first = (
        RigidTransform(
            jnp.broadcast_to(transform.rotation, (*batch, 3, 3)),
            jnp.broadcast_to(transform.translation, (*batch, 3)),
        )
        for transform in (second, first)
    )
    rotation = jnp.matmul(second.rotation, first.rotation, precision=Precision.HIGHEST)
    return RigidTransform(rotation, apply(second, first.translation))


def inverse(transform: RigidTransform) -> RigidTransform:
    """The transform from reference back to source: ``(R^T, -R^T t)``.

    Raises:
      ValueError: the transform has wrong shapes.
    """
    arguments.leading_axes("transform", transform)
    rotation = transform.rotation.mT
    column = transform.translation[..., None]
    translation = jnp.matmul(rotation, column, precision=Precision.HIGHEST)[..., 0]
    return RigidTransform(rotation, -translation)


def to_matrix(transform: RigidTransform) -> Float[Array, "*b 4 4"]:
    """The homogeneous matrix ``[[R, t], [0, 1]]``.

    Raises:
      ValueError: the transform has wrong shapes.
    """
    batch = arguments.leading_axes("transform", transform)
    top = jnp.concatenate([transform.rotation, transform.translation[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.eye(4, dtype=top.dtype)[3:], (*batch, 1, 4))
    return jnp.concatenate([top, last], axis=-2)


def from_matrix(matrix: Float[Array, "*b 4 4"]) -> RigidTransform:
    """The transform of a homogeneous matrix ``[[R, t], [0, 1]]``; the last row is ignored.

    Raises:
      ValueError: it is not ``(..., 4, 4)``.
    """
    arguments.check_numbers("matrix", matrix)
    if matrix.shape[-2:] != (4, 4):
        raise ValueError(f"a homogeneous matrix has shape (..., 4, 4), not {matrix.shape}.")
    return RigidTransform(matrix[..., :3, :3], matrix[..., :3, 3])


def to_jaxlie(transform: RigidTransform) -> Any:
    """The same pose as a `jaxlie.SE3`, whose rotation is a unit quaternion.

    Raises:
      ImportError: jaxlie is not installed.
      ValueError: the transform has wrong shapes.
    """
    try:
        import jaxlie  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError("to_jaxlie needs jaxlie: pip install jaxlie.") from None
    arguments.leading_axes("transform", transform)
    rotation = jaxlie.SO3.from_matrix(jnp.asarray(transform.rotation))
    return jaxlie.SE3.from_rotation_and_translation(rotation, jnp.asarray(transform.translation))


def from_jaxlie(pose: Any) -> RigidTransform:
    """The transform of a `jaxlie.SE3`."""
    return RigidTransform(pose.rotation().as_matrix(), pose.translation())


def rotation_angle_deg(
    rotation: Float[np.ndarray, "*#n 3 3"], other: Float[np.ndarray, "*#n 3 3"]
) -> Float[np.ndarray, "*n"]:
    """Angle between rotations in degrees, ``2 asin(|R1 - R2|_F / (2 sqrt 2))``.

    Exact to the last digits near 0, where ``arccos((trace - 1) / 2)`` loses half of them.
    """
    chord = np.linalg.norm(rotation - other, axis=(-2, -1))
    # numpy makes a number of an array without axes.
    return np.asarray(np.degrees(2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1))))


def nearest_rotation(matrix: Float[np.ndarray, "*k 3 3"]) -> Float[np.ndarray, "*k 3 3"]:
    """The rotation nearest to a matrix, orthogonal to float64 (numpy, on the host)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, np.float64))
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt
