"""The records that all packages share, and the convention for transforms.

A transform maps *source* to *reference*: ``y = R x + t`` for a column vector ``x``; a cloud
``(n, 3)`` is mapped by ``points @ R.T + t``. Angles are radians; a name that ends in ``_deg`` is in
degrees. Lengths have the unit of the input.
"""

from typing import Any, NamedTuple

from jax import export
from jaxtyping import Array, Bool, Float, Int


class RigidTransform(NamedTuple):
    """A rotation and a translation that map source to reference, ``y = R x + t``.

    JAX or numpy arrays. Leading axes, if any, index many transforms.
    """

    rotation: Float[Any, "*b 3 3"]
    translation: Float[Any, "*b 3"]


class PointCloud(NamedTuple):
    """A padded cloud: rows where `mask` is False are padding and may contain anything, even NaN."""

    points: Float[Array, "n 3"]
    mask: Bool[Array, "n"]


class Pair(NamedTuple):
    """Two clouds to register, and their transform (known if both were made from one shape)."""

    source: PointCloud
    reference: PointCloud
    transform: RigidTransform


class Registration(NamedTuple):
    """What `register_pair` returns: the pose of the source in the frame of the reference.

    `transformation` is the 4x4 form of (`rotation`, `translation`). `correspondences[i]` is the
    reference copy of source point `i` (Eq. 6), a weighted mean of reference points, and
    `confidence[i]`, in [0, 1], its inlier confidence (Eq. 11). `valid` is False if a cloud had no
    valid point, or if the result was not finite; the transform is then the identity.

    The other learned methods return it too (`jaxreg.peers`); each says what its confidence and its
    correspondences are.
    """

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    transformation: Float[Array, "4 4"]
    confidence: Float[Array, "n"]
    correspondences: Float[Array, "n 3"]
    valid: Bool[Array, ""]

    @property
    def transform(self) -> RigidTransform:
        """The pose alone."""
        return RigidTransform(self.rotation, self.translation)


class GlobalRegistration(NamedTuple):
    """What `register_global` returns: the pose that it found without a start.

    `transformation` is the 4x4 form of (`rotation`, `translation`). `correspondences[i]` is the
    reference point nearest to source point `i` under the pose, and `confidence[i]`, in [0, 1], is
    ``exp(-d^2 / 2 w^2)`` of its distance d, where w is the distance up to which the search treats
    two points as one surface. `score`: higher is better; compare scores of the same two clouds
    only. `valid` is False if a cloud had no valid point; the transform is then the identity.
    """

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    transformation: Float[Array, "4 4"]
    confidence: Float[Array, "n"]
    correspondences: Float[Array, "n 3"]
    score: Float[Array, ""]
    valid: Bool[Array, ""]

    @property
    def transform(self) -> RigidTransform:
        """The pose alone."""
        return RigidTransform(self.rotation, self.translation)


class Refinement(NamedTuple):
    """What `icp`, `point_to_plane` and `gicp` return: the refined pose, and how well it fits.

    `transformation` is the 4x4 form of (`rotation`, `translation`). `correspondences[i]` is the
    reference point nearest to source point `i` under the pose, and `confidence[i]`, in [0, 1], the
    weight of that pair in the cost: 0 beyond `max_correspondence_distance`, outside the trimmed
    share, and for padding.

    `residual` is the weighted root mean square of the residuals that the method minimises, in the
    unit of the clouds (0 without any pair), and `inliers` is the number of source points whose pair
    is within that distance and that share. `information` is ``sum_i w_i J_i^T M_i J_i`` of these
    pairs for a small motion ``(omega, v)``, ``y -> exp(omega)(y - centre) + centre + v``: rotation
    (radians) first, then translation, in the unit of the clouds; `centre` is the centroid of the
    reference. `converged` is True when the last step was below the tolerance.
    """

    rotation: Float[Array, "3 3"]
    translation: Float[Array, "3"]
    transformation: Float[Array, "4 4"]
    confidence: Float[Array, "n"]
    correspondences: Float[Array, "n 3"]
    residual: Float[Array, ""]
    inliers: Int[Array, ""]
    information: Float[Array, "6 6"]
    centre: Float[Array, "3"]
    converged: Bool[Array, ""]

    @property
    def transform(self) -> RigidTransform:
        """The pose alone."""
        return RigidTransform(self.rotation, self.translation)


# What returns a record can be saved as a program (`jax.export`).
for _record in (RigidTransform, PointCloud, Pair, Registration, GlobalRegistration, Refinement):
    export.register_namedtuple_serialization(_record, serialized_name=f"jaxreg.{_record.__name__}")
