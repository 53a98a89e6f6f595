"""The records that every room passes around, and the convention of a transform, said once.

A transform maps *source* to *reference*: ``y = R x + t`` for a column vector ``x``; a cloud
``(n, 3)`` is mapped by ``points @ R.T + t``. Angles are radians; a name that ends in ``_deg`` is in
degrees. Lengths have the unit of the input.
"""

from typing import Any, NamedTuple

from jaxtyping import Array, Bool, Float, Int


class RigidTransform(NamedTuple):
    """A rotation and a translation that map source to reference, ``y = R x + t``.

    JAX or numpy arrays. With leading axes there are many, one for every index of them.
    """

    rotation: Float[Any, "*b 3 3"]
    translation: Float[Any, "*b 3"]


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
    """What `register_pair` returns: the pose of the source in the frame of the reference.

    `transformation` is the 4x4 form of (`rotation`, `translation`). `correspondences[i]` is the
    reference copy of source point `i` (Eq. 6), a weighted mean of reference points, and
    `confidence[i]`, in [0, 1], its inlier confidence (Eq. 11). `valid` is False when a cloud had no
    point to work with; the transform is then the identity.
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
    ``exp(-d^2 / 2 w^2)`` of its distance d, with w the width at which the search takes two points
    for the same surface. `score` is the plausibility of the pose, higher is better; only scores of
    the same two clouds compare. `valid` is False when a cloud had no point to work with; the
    transform is then the identity.
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
    weight of that pair in the cost: 0 beyond the largest distance, outside the trim and for
    padding.

    `residual` is the weighted root mean square of the residuals that the method minimises, in the
    unit of the clouds (0 without any pair), and `inliers` the number of source points whose pair is
    within the largest distance and the trim. `information` is ``sum_i w_i J_i^T M_i J_i`` of these
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
