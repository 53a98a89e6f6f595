"""What a registration of two scans returns."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxreg.geometry import frame, trees
from jaxreg.judge.evidence import Evidence
from jaxreg.refine.uncertainty import WeakDirection
from jaxreg.scans.prepare import Prepared
from jaxreg.types import RigidTransform

LISTED = 0.01
"""Smallest probability at which a pose is listed among the alternatives."""


class Alternative(NamedTuple):
    """Another pose of the source, and the probability that it is the right one."""

    transform: RigidTransform
    probability: float


class FewEvidence(NamedTuple):
    """What few points show for a pose.

    `matched` pairs of points agree; `of` is the number of points of the smaller cloud, `residual` the
    largest distance of a pair (unit of the input). Unrelated points would give so many poses this
    good: `log10_chance` is the common logarithm of their number.
    """

    matched: int
    of: int
    residual: float
    log10_chance: float


@dataclasses.dataclass(frozen=True, eq=False)
class ScanRegistration:
    """What `register` returns: the source's pose in the reference's frame, and how far to trust it.

    float64, in the unit of the input, one row per row of the source. `transformation` is the 4x4
    form of (`rotation`, `translation`). `correspondences[i]` is the reference point nearest to
    source point `i` after alignment (NaN for a dropped point), and `confidence[i]`, in [0, 1], how
    near: ``(1 - (d / max_correspondence_distance)^2)^2``. That distance, within which two points
    count as the same surface, follows from their spacing. `fitness` is the share of the source's
    points within it, `inlier_rmse` the root mean square distance of those, `overlap` the share of
    both clouds within it of the other, at equal density.

    `success` is False if the pose should not be trusted, and `reason` says why in one sentence;
    `probability` is the calibrated chance that the pose is right, and `evidence` is what it is
    computed from. `alternatives` are the other poses that may be right, the likeliest first; their
    probabilities and `probability` add up to at most 1.

    `covariance` is that of a small rotation vector (rad) and translation about the centroid of the
    reference's distinct points; NaN if nothing was refined or no surfaces were near each other.
    `weak_directions` are the motions that barely change the fit. `converged` says whether the last
    step of the refinement was below its tolerance (None: not refined); if not, it is no success.
    `dropped` counts the rows of both clouds that were left out, because they are not finite or
    strays; `notes` are sentences on what was odd about the clouds.

    `scale` is 1 unless it was asked for; then ``y = scale R x + t``, `transformation` holds
    ``scale R``, and `scale_sigma` is the standard deviation of `scale`.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    transformation: Float[np.ndarray, "4 4"]
    confidence: Float[np.ndarray, "n"]
    correspondences: Float[np.ndarray, "n 3"]
    success: bool
    probability: float
    reason: str
    overlap: float
    fitness: float
    inlier_rmse: float
    max_correspondence_distance: float
    covariance: Float[np.ndarray, "6 6"]
    weak_directions: tuple[WeakDirection, ...]
    alternatives: tuple[Alternative, ...]
    evidence: Evidence | FewEvidence
    converged: bool | None
    dropped: int
    notes: tuple[str, ...]
    scale: float = 1.0
    scale_sigma: float = 0.0

    @property
    def transform(self) -> RigidTransform:
        """Rotation and translation, from source to reference."""
        return RigidTransform(self.rotation, self.translation)

    @property
    def reach(self) -> float:
        """`max_correspondence_distance` by its short name."""
        return self.max_correspondence_distance


class Verdict(NamedTuple):
    """Whether a pose is to be trusted, and why not; see the fields of `ScanRegistration`."""

    success: bool
    probability: float
    reason: str
    evidence: Evidence | FewEvidence


class Accuracy(NamedTuple):
    """How well a pose is determined; see the fields of `ScanRegistration`."""

    covariance: Float[np.ndarray, "6 6"]
    weak_directions: tuple[WeakDirection, ...]
    converged: bool | None
    scale_sigma: float = 0.0


def assembled(
    clouds: tuple[Prepared, Prepared],
    pose: RigidTransform,
    found: Verdict,
    accuracy: Accuracy,
    *,
    distance: float,
    overlap: float,
    alternatives: tuple[Alternative, ...],
    notes: tuple[str, ...] = (),
) -> ScanRegistration:
    """The record of a pose of the centred source in the centred reference, in the unit of the input.

    What is told of every point follows from the pose and from `distance`, within which two points
    count as the same.
    """
    source, reference = clouds
    moved = (source.points * source.radius) @ pose.rotation.T + pose.translation
    near, index = trees.nearest(reference.tree, moved / reference.radius)
    # Of a pose so far off that the squares of distances are no numbers, any point is as near.
    near, index = near * reference.radius, np.minimum(index, len(reference.points) - 1)
    inside = near <= distance
    out = out_of(clouds, pose)
    return ScanRegistration(
        rotation=out.rotation,
        translation=out.translation,
        transformation=matrix_of(out),
        confidence=source.per_input_row(
            np.maximum(0, 1 - (near / distance) ** 2) ** 2, missing=0.0
        ),
        correspondences=source.per_input_row(
            reference.points[index] * reference.radius + reference.centre, missing=np.nan
        ),
        overlap=overlap,
        fitness=float(np.mean(inside[source.row])),
        inlier_rmse=float(np.sqrt(np.mean(near[inside] ** 2))) if inside.any() else 0.0,
        max_correspondence_distance=distance,
        alternatives=alternatives,
        dropped=int(np.sum(~source.kept) + np.sum(~reference.kept)),
        notes=(*source.notes, *reference.notes, *notes),
        **found._asdict(),
        **accuracy._asdict(),
    )


def matrix_of(pose: RigidTransform) -> Float[np.ndarray, "*b 4 4"]:
    """The 4x4 form of a pose in numpy, or of many."""
    matrix = np.zeros((*pose.translation.shape[:-1], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = *pose, 1
    return matrix


def in_unit(pose: RigidTransform, factor: float) -> RigidTransform:
    """The pose of clouds whose coordinates are `factor` times as large."""
    return RigidTransform(pose.rotation, pose.translation * factor)


def out_of(clouds: tuple[Prepared, Prepared], pose: RigidTransform) -> RigidTransform:
    """A pose of the centred clouds as one of the clouds that were given."""
    return frame.transform_out(_centres(clouds), pose)


def centred(clouds: tuple[Prepared, Prepared], pose: RigidTransform) -> RigidTransform:
    """The inverse of `out_of`."""
    return frame.transform_in(_centres(clouds), pose)


def _centres(clouds: tuple[Prepared, Prepared]) -> frame.Frame:
    """The frame of the centred clouds, in the unit of the input."""
    return frame.Frame(clouds[0].centre, clouds[1].centre, 1.0)


def resized(cloud: Prepared, size: float) -> Prepared:
    """The cloud times `size`. Nothing is computed again: its levels are in units of its radius."""
    return dataclasses.replace(cloud, centre=size * cloud.centre, radius=size * cloud.radius)


def widened(
    found: ScanRegistration, clouds: tuple[Prepared, Prepared], origin: np.ndarray
) -> ScanRegistration:
    """A registration of parts of two clouds as one of the whole clouds.

    `origin` is the centre of the part of the reference, about which the covariance was.
    """
    change = np.eye(6)
    change[3:, :3] = np.cross(np.eye(3), clouds[1].centre - origin).T
    clouds = resized(clouds[0], found.scale), clouds[1]
    whole = assembled(
        clouds,
        centred(clouds, found.transform),
        Verdict(found.success, found.probability, found.reason, found.evidence),
        Accuracy(
            change @ found.covariance @ change.T,
            found.weak_directions,
            found.converged,
            found.scale_sigma,
        ),
        distance=found.max_correspondence_distance,
        overlap=found.overlap,
        alternatives=found.alternatives,
        notes=tuple(
            note for note in found.notes if note not in (*clouds[0].notes, *clouds[1].notes)
        ),
    )
    return dataclasses.replace(whole, transformation=found.transformation, scale=found.scale)
