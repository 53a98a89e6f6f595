"""The frame that every solver works in: both clouds centred, lengths near 1.

Solving at the original offset would lose the digits that the offset takes, and a damping or a step
limit means something only if rotation and translation are of one size. `enter` is for arrays on a
device; on the host `Frame` is made of the centres and radii of two clouds (`measure`), in float64.
The unit is the same in both: the root mean square of the two radii.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import arguments, rigid
from jaxreg.geometry.neighbors import without_padding
from jaxreg.geometry.numerics import safe_sqrt
from jaxreg.types import RigidTransform

_FARTHEST = 1e150
"""Radii, on the host: clouds that lie farther apart share nothing, and this can still be squared."""


class Frame(NamedTuple):
    """The way back to the two original clouds: ``x = centre + length x'``. JAX or numpy arrays."""

    source_centre: Float[Any, "3"]
    reference_centre: Float[Any, "3"]
    length: Any


def enter(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    source_mask: Bool[Array, "n"] | None,
    reference_mask: Bool[Array, "m"] | None,
) -> tuple[Frame, Float[Array, "n 3"], Float[Array, "m 3"]]:
    """Both clouds around their own centroids in units of their common root mean square radius.

    Padded rows become zero. The unit is ``sqrt((s^2 + r^2) / 2)`` of the two radii, the same when
    the clouds are swapped; it is 1 if every point coincides with the centroid.

    Raises:
      ValueError: a cloud is not ``(n, 3)`` or has no row, a mask is not ``(n,)`` of bools, or their
        dtypes are not one of float32 and float64.
    """
    source, reference = arguments.clouds(source, reference)
    source_mask = arguments.mask("source_mask", source_mask, source.shape[0])
    reference_mask = arguments.mask("reference_mask", reference_mask, reference.shape[0])
    source, source_centre = _centred(source, source_mask)
    reference, reference_centre = _centred(reference, reference_mask)
    variance = _mean_square(source, source_mask) + _mean_square(reference, reference_mask)
    length = safe_sqrt(variance / 2)
    length = jnp.where(length > 0, length, 1)
    return Frame(source_centre, reference_centre, length), source / length, reference / length


def transform_in(frame: Frame, transform: RigidTransform | None) -> RigidTransform:
    """A transform of the original clouds (None: the identity), for the clouds in the frame."""
    if transform is None:
        transform = rigid.identity(frame.source_centre.dtype)
    if not isinstance(frame.source_centre, np.ndarray):  # float64 stays what it is on the host
        dtype = frame.source_centre.dtype
        transform = RigidTransform(*(jnp.asarray(part, dtype) for part in transform))
    shift = transform.translation + _rotated(transform, frame) - frame.reference_centre
    if isinstance(shift, np.ndarray):
        with np.errstate(over="ignore"):
            within = np.clip(shift / frame.length, -_FARTHEST, _FARTHEST)
        return RigidTransform(transform.rotation, within)
    return RigidTransform(transform.rotation, shift / frame.length)


def transform_out(frame: Frame, transform: RigidTransform) -> RigidTransform:
    """The inverse of `transform_in`."""
    shift = transform.translation * frame.length + frame.reference_centre
    return RigidTransform(transform.rotation, shift - _rotated(transform, frame))


def measure(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Centroid and root mean square radius of a cloud on the host, in float64.

    The radius is 0 where the spread is no more than the rounding of the offset.
    """
    # Relative to one of the points, so a common offset costs no digits.
    centre = points[0] + (points - points[0]).mean(axis=0)
    columns = (points - centre).T
    largest = max(float(np.abs(column).max()) for column in columns)
    if largest <= 16 * np.finfo(np.float64).eps * np.abs(centre).max():
        return centre, 0.0
    mean_square = sum(float(np.mean((column / largest) ** 2)) for column in columns)
    return centre, largest * mean_square**0.5


def _rotated(transform: RigidTransform, frame: Frame):
    """``R c`` of the source's centre: the same sum in numpy and in JAX, in full precision."""
    return (transform.rotation * frame.source_centre[None, :]).sum(axis=-1)


def _centred(points: Array, mask: Array | None) -> tuple[Array, Array]:
    points = without_padding(points, mask)
    centre = jnp.sum(points, axis=0) / _count(points, mask)
    return without_padding(points - centre[None, :], mask), centre


def _mean_square(points: Array, mask: Array | None) -> Array:
    return jnp.sum(points * points) / _count(points, mask)


def _count(points: Array, mask: Array | None) -> Array:
    count = points.shape[0] if mask is None else jnp.sum(mask)
    return jnp.maximum(jnp.asarray(count, points.dtype), 1)
