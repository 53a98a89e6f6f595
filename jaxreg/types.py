"""The records that every room passes around, and the convention of a transform, said once.

A transform maps *source* to *reference*: ``y = R x + t`` for a column vector ``x``; a cloud
``(n, 3)`` is mapped by ``points @ R.T + t``. Angles are radians; a name that ends in ``_deg`` is in
degrees. Lengths have the unit of the input.
"""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float


class RigidTransform(NamedTuple):
    """A rotation and a translation that map source to reference, ``y = R x + t``."""

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]


class PointCloud(NamedTuple):
    """A padded cloud: rows of `points` where `mask` is False are padding and may hold anything."""

    points: Float[Array, "n 3"]
    mask: Bool[Array, "n"]


class Pair(NamedTuple):
    """Two clouds to register and the transform from source to reference (known when synthesised)."""

    source: PointCloud
    reference: PointCloud
    transform: RigidTransform


class Registration(NamedTuple):
    """Where the source lies in the frame of the reference, and how far each point is trusted.

    `transformation` is the 4x4 form of (`rotation`, `translation`). `correspondences[i]` is the
    point of the reference frame estimated for source point `i` (the reference copy of Eq. 6) and
    `confidence[i]`, in [0, 1], its inlier confidence (Eq. 11). `valid` is False when a cloud had no
    point to work with; the transform is then the identity.
    """

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    transformation: Float[Array, "4 4"]
    confidence: Float[Array, "n"]
    correspondences: Float[Array, "n 3"]
    valid: Bool[Array, ""]
