"""The frame that every refinement solves in: both clouds centred, lengths near 1.

Solving at the original offset would lose the digits that the offset takes, and a damping or a step
limit only means something when rotation and translation are of one size.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import rigid
from jaxreg.geometry.neighbors import without_padding
from jaxreg.geometry.numerics import safe_sqrt
from jaxreg.types import RigidTransform


class Frame(NamedTuple):
    """Where the two clouds were taken from: ``x = centre + length x'``."""

    source_centre: Float[Array, "3"]
    reference_centre: Float[Array, "3"]
    length: Float[Array, ""]


def enter(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    source_mask: Bool[Array, "n"] | None,
    reference_mask: Bool[Array, "m"] | None,
) -> tuple[Frame, Float[Array, "n 3"], Float[Array, "m 3"]]:
    """Both clouds around their own centroids in units of their common root mean square radius.

    Padded rows become zero. The unit is ``sqrt((s^2 + r^2) / 2)`` of the two radii, so that it does
    not change when the clouds are swapped; it is 1 when every point coincides with the centroid.

    Raises:
      ValueError: a cloud is not ``(n, 3)`` or has no row.
    """
    check_clouds(source, reference)
    source, source_centre = _centred(source, source_mask)
    reference, reference_centre = _centred(reference, reference_mask)
    variance = _mean_square(source, source_mask) + _mean_square(reference, reference_mask)
    length = safe_sqrt(variance / 2)
    length = jnp.where(length > 0, length, 1)
    return Frame(source_centre, reference_centre, length), source / length, reference / length


def transform_in(frame: Frame, transform: RigidTransform | None) -> RigidTransform:
    """A transform of the original clouds (None: the identity) as one of the clouds in the frame."""
    dtype = frame.length.dtype
    if transform is None:
        transform = rigid.identity(dtype)
    rotation = jnp.asarray(transform.rotation, dtype)
    rotated = jnp.matmul(rotation, frame.source_centre, precision=Precision.HIGHEST)
    shift = jnp.asarray(transform.translation, dtype) + rotated - frame.reference_centre
    return RigidTransform(rotation, shift / frame.length)


def transform_out(frame: Frame, transform: RigidTransform) -> RigidTransform:
    """The inverse of `transform_in`."""
    rotated = jnp.matmul(transform.rotation, frame.source_centre, precision=Precision.HIGHEST)
    shift = transform.translation * frame.length + frame.reference_centre
    return RigidTransform(transform.rotation, shift - rotated)


def check_clouds(source: Array, reference: Array) -> None:
    """Raises ValueError unless both clouds are ``(n, 3)`` with at least one row."""
    for name, points in (("source", source), ("reference", reference)):
        if points.ndim != 2 or points.shape[1] != 3 or points.shape[0] == 0:
            raise ValueError(
                f"{name} must have shape (n, 3) with n >= 1, got {points.shape}: give one cloud, "
                "and use jax.vmap for a batch."
            )


def _centred(points: Array, mask: Array | None) -> tuple[Array, Array]:
    points = without_padding(points, mask)
    centre = jnp.sum(points, axis=0) / _count(points, mask)
    return without_padding(points - centre[None, :], mask), centre


def _mean_square(points: Array, mask: Array | None) -> Array:
    return jnp.sum(points * points) / _count(points, mask)


def _count(points: Array, mask: Array | None) -> Array:
    count = points.shape[0] if mask is None else jnp.sum(mask)
    return jnp.maximum(jnp.asarray(count, points.dtype), 1)


def common_frame(source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"]) -> Frame:
    """Centres and one common unit: the larger of the two clouds' root mean square radii.

    The unit is 1 where all points of both clouds coincide.
    """
    centres = [_mean(points) for points in (source, reference)]
    radii = [_radius(p - c) for p, c in zip((source, reference), centres, strict=True)]
    length = max(radii)
    # Below this the spread is the rounding of the offset, and no shape.
    noise = 16 * np.finfo(np.float64).eps * max(np.abs(source).max(), np.abs(reference).max())
    return Frame(*centres, length if length > noise else 1.0)


def pose_in(frame: Frame, pose: RigidTransform) -> RigidTransform:
    """A pose of the original clouds as one of the scaled clouds."""
    shift = pose.rotation @ frame.source_centre + pose.translation - frame.reference_centre
    return RigidTransform(pose.rotation, shift / frame.length)


def pose_out(frame: Frame, pose: RigidTransform) -> RigidTransform:
    """The inverse of `pose_in`."""
    shift = pose.translation * frame.length + frame.reference_centre
    return RigidTransform(pose.rotation, shift - pose.rotation @ frame.source_centre)


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a matrix, orthogonal to float64."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, np.float64))
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt


def _mean(points: np.ndarray) -> np.ndarray:
    """Mean of the rows, by way of one of them, so that a common offset costs no digits."""
    return points[0] + (points - points[0]).mean(axis=0)


def _radius(centred: np.ndarray) -> float:
    largest = np.abs(centred).max()
    if largest == 0:
        return 0.0
    return float(largest * np.sqrt(np.mean(np.sum((centred / largest) ** 2, axis=1))))
