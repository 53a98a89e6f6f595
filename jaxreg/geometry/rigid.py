"""Rigid transforms: apply, compose, invert, and the way from and to 4x4 matrices."""

import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Float

from jaxreg.types import RigidTransform


def identity(dtype=None) -> RigidTransform:
    """The transform that moves nothing."""
    return RigidTransform(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype))


def apply(transform: RigidTransform, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """``R x + t`` for every point ``x``; the unit is that of `points`."""
    rotated = jnp.matmul(points, transform.rotation.T, precision=Precision.HIGHEST)
    return rotated + jnp.broadcast_to(transform.translation, rotated.shape)


def compose(second: RigidTransform, first: RigidTransform) -> RigidTransform:
    """The transform that applies `first`, then `second`: ``(R2 R1, R2 t1 + t2)``."""
    rotation = jnp.matmul(second.rotation, first.rotation, precision=Precision.HIGHEST)
    return RigidTransform(rotation, apply(second, first.translation))


def inverse(transform: RigidTransform) -> RigidTransform:
    """The transform from reference back to source: ``(R^T, -R^T t)``."""
    rotation = transform.rotation.T
    translation = jnp.matmul(rotation, transform.translation, precision=Precision.HIGHEST)
    return RigidTransform(rotation, -translation)


def to_matrix(transform: RigidTransform) -> Float[Array, "4 4"]:
    """The homogeneous matrix ``[[R, t], [0, 1]]``."""
    top = jnp.concatenate([transform.rotation, transform.translation[:, None]], axis=1)
    return jnp.concatenate([top, jnp.eye(4, dtype=top.dtype)[3:]], axis=0)


def from_matrix(matrix: Float[Array, "4 4"]) -> RigidTransform:
    """The transform of a homogeneous matrix ``[[R, t], [0, 1]]``; the last row is not read."""
    return RigidTransform(matrix[:3, :3], matrix[:3, 3])


def rotation_angle_deg(
    rotation: Float[np.ndarray, "n 3 3"], other: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n"]:
    """Angle between rotations in degrees, ``2 asin(|R1 - R2|_F / (2 sqrt 2))``.

    Exact to the last digits near 0, where ``arccos((trace - 1) / 2)`` loses half of them.
    """
    chord = np.linalg.norm(rotation - other, axis=(-2, -1))
    return np.degrees(2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1)))


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a matrix, orthogonal to float64 (numpy, on the host)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, np.float64))
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
