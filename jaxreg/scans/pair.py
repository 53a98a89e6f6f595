"""Register two scans: numpy in, numpy out, any sizes and any unit."""

import dataclasses
import functools
import time
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxreg import _xla
from jaxreg.geometry import clouds, frame
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.host import Refined, refine_on_host
from jaxreg.refine.kdtree import IndexedCloud, index_cloud
from jaxreg.refine.uncertainty import PoseUncertainty, about, weak_directions
from jaxreg.scans import prepare, verdict
from jaxreg.scans.config import RegisterConfig
from jaxreg.search.learned import load_features
from jaxreg.search.pipeline import search_poses
from jaxreg.types import RigidTransform

Rotation = Literal["limited", "full"]
Refinement = Literal["gicp", "icp", "point_to_plane"]

_DEFAULT = RegisterConfig()
_SMALLEST = 512
"""Smallest size of a padded cloud in the search."""
_PREFERENCE = 0.01
"""What half a turn costs in the choice of a pose: of those that agree equally (a symmetric shape)
the one that turns least is taken."""


class ScanRegistration(NamedTuple):
    """Where the source lies in the frame of the reference, and how far that can be trusted.

    float64, in the unit of the input, a row for every row of the source. `confidence[i]`, in
    [0, 1], says how well point `i` agrees with the reference after alignment; `correspondences[i]`
    is the reference point nearest to it there (NaN for a dropped point). `reach` is the distance
    within which two points count as the same surface, taken from their spacing. `fitness` is the
    share of the source within reach of the reference, `inlier_rmse` the root mean square distance
    of those points, `overlap` the share of both clouds within reach of the other, at equal density.

    `covariance` is that of a small rotation vector (rad) and translation about the centroid of the
    reference's distinct points; NaN where nothing was refined or no surfaces were within reach.
    `weak_directions` names the motions that the clouds hardly resist. `success` is False when the
    pose should not be trusted, `probability` is the calibrated chance that it is right. `evidence`
    is what that chance is computed from. `dropped` counts the non-finite rows of both clouds.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    transformation: Float[np.ndarray, "4 4"]
    confidence: Float[np.ndarray, "n"]
    correspondences: Float[np.ndarray, "n 3"]
    reach: float
    fitness: float
    inlier_rmse: float
    overlap: float
    covariance: Float[np.ndarray, "6 6"]
    weak_directions: tuple[str, ...]
    success: bool
    probability: float
    evidence: verdict.Evidence
    seconds: float
    dropped: int


def register(
    source: object,
    reference: object,
    *,
    initial: object = None,
    rotation: Rotation = "full",
    refine: Refinement | None = "gicp",
    nonfinite: Literal["raise", "drop"] = "raise",
    config: RegisterConfig = _DEFAULT,
) -> ScanRegistration:
    """The rigid transform ``y = R x + t`` that lays `source` on `reference`, with a verdict.

    Clouds are (n, 3) and (m, 3), anything numpy understands, in one unit; neither their sizes nor
    their order nor their origin play a role. `initial` (4x4 or a `RigidTransform`) starts from a
    known pose and skips the search, so that nothing is known of rival poses. `rotation` says how far
    the clouds may be turned: "full" by anything, "limited" by `config.limited_deg`, which settles
    symmetric shapes. `refine` None gives the pose of the search, or `initial`. The same input gives
    the same bits.

    Raises:
      ValueError: a cloud is not numeric (n, 3) with three finite points or more (the message names
        the row), `initial` is no rigid transform, or an option is unknown.
    """
    begin = time.perf_counter()
    _check_options(rotation, refine, config)
    start = None if initial is None else _check_initial(initial)
    moving = prepare.make_scan(source, "source", nonfinite=nonfinite)
    fixed = prepare.make_scan(reference, "reference", nonfinite=nonfinite)
    where = frame.common_frame(moving.points, fixed.points)
    x = (moving.points - where.source_centre) / where.length
    y = (fixed.points - where.reference_centre) / where.length
    a, b, spacing = prepare.at_one_density(x, y, config.search_points)
    if start is None:
        pose, rival = _searched(a, b, where, rotation, config)
    else:
        pose, rival = frame.pose_in(where, start), verdict.NOT_SEARCHED
    refined = _refined(x, y, pose, refine, spacing, config)
    clouds = (_indexed(points, config) for points in (a, b))
    reach = config.reach * spacing
    judged = verdict.evidence(refined.transform, *clouds, reach, rival=rival)
    return _result(x, y, moving, fixed, where, refined, judged, reach, begin)


def _indexed(points: np.ndarray, config: RegisterConfig) -> IndexedCloud:
    return index_cloud(_enough(points, config), k=config.refine_neighbors)


def _enough(points: np.ndarray, config: RegisterConfig) -> np.ndarray:
    """The points, all of them as often as normals need it."""
    return np.tile(points, (-(-(config.refine_neighbors + 1) // len(points)), 1))


_UNREFINED = PoseUncertainty(
    np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(()), np.zeros(()), np.zeros(3), np.ones(())
)
_LEAST = {
    "search_points": 16,
    "refine_points": 16,
    "refine_iterations": 1,
    "refine_anneal": 1,
    "refine_neighbors": 2,
}
"""The smallest sensible value of these settings; the others must be positive."""


def _check_options(rotation: str, refine: str | None, config: RegisterConfig) -> None:
    for name, value in dataclasses.asdict(config).items():
        if isinstance(value, bool):
            continue
        least = _LEAST.get(name, 0)
        if not (least <= value < np.inf and value > 0):
            bound = f"at least {least}" if least else "positive"
            raise ValueError(f"config.{name} must be {bound} and finite, got {value}.")
    if config.limited_deg > 180:
        raise ValueError(
            f"config.limited_deg must be at most 180, got {config.limited_deg}: choose "
            "rotation='full' for clouds that may be turned by anything."
        )
    if rotation not in ("limited", "full"):
        raise ValueError(f"rotation must be 'limited' or 'full', got {rotation!r}.")
    if refine not in ("gicp", "icp", "point_to_plane", None):
        raise ValueError(f"refine must be 'gicp', 'icp', 'point_to_plane' or None, got {refine!r}.")


def _check_initial(initial: object) -> RigidTransform:
    if isinstance(initial, RigidTransform):
        rotation, translation = (np.asarray(part, np.float64) for part in initial)
    else:
        try:
            matrix = np.asarray(initial, np.float64)
        except (TypeError, ValueError):
            raise ValueError(
                "initial is no array of numbers: give a 4x4 matrix [[R, t], [0, 1]]."
            ) from None
        if matrix.shape != (4, 4):
            raise ValueError(f"initial must be a 4x4 matrix [[R, t], [0, 1]], got {matrix.shape}.")
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
            raise ValueError(
                f"the last row of initial is {matrix[3].tolist()}: give a matrix [[R, t], [0, 1]] "
                "(this one may be transposed)."
            )
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise ValueError("initial holds NaN or infinity: give a finite transform.")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise ValueError(
            "initial is no rigid transform (its 3x3 part must be a rotation: orthogonal, det +1): "
            "remove scale, shear and mirroring."
        )
    return RigidTransform(frame.nearest_rotation(rotation), translation)


def _searched(
    x: np.ndarray, y: np.ndarray, where: frame.Frame, rotation: Rotation, config: RegisterConfig
) -> tuple[RigidTransform, float]:
    """The most plausible pose, and how much more plausible it is than the next that differs."""
    size = clouds.bucket(max(len(x), len(y)), smallest=_SMALLEST, largest=config.search_points)
    unmoved = frame.pose_in(where, RigidTransform(np.eye(3), np.zeros(3)))
    largest = 180.0 if rotation == "full" else config.limited_deg
    found = _search(config.learned)(
        *clouds.padded(x, size),
        *clouds.padded(y, size),
        # Clouds that lie farther apart than float32 reaches do not overlap where they are anyway.
        RigidTransform(*(np.clip(part, -1e6, 1e6).astype(np.float32) for part in unmoved)),
        np.float32(np.radians(largest)),
    )
    poses = RigidTransform(*(np.asarray(part, np.float64) for part in found.poses))
    score, allowed = np.asarray(found.score), np.asarray(found.allowed)
    usable = allowed if allowed.any() else np.ones_like(allowed)
    preferred = score - _PREFERENCE * _angles(poses, np.eye(3)) / np.pi
    best = int(np.argmax(np.where(usable, preferred, -np.inf)))
    apart = np.linalg.norm(poses.translation - poses.translation[best], axis=1)
    others = (_angles(poses, poses.rotation[best]) > np.radians(15)) | (apart > 0.2)
    others &= usable  # A pose that turns too far is no rival: it was ruled out.
    lead = score[best] - score[others].max() if others.any() else verdict.NO_RIVAL
    return RigidTransform(poses.rotation[best], poses.translation[best]), float(lead)


@functools.cache
def _search(learned: bool):
    def run(network, x, x_mask, y, y_mask, also, max_angle):
        return search_poses(
            x,
            y,
            source_mask=x_mask,
            reference_mask=y_mask,
            network=network,
            also=also,
            max_angle=max_angle,
        )

    network = jax.device_put(load_features()) if learned else None
    return functools.partial(_xla.jit(run), network)


def _angles(poses: RigidTransform, rotation: np.ndarray) -> Float[np.ndarray, "p"]:
    """By how much every pose turns from `rotation`, in [0, pi]."""
    chord = np.linalg.norm(poses.rotation - rotation, axis=(1, 2)) / np.sqrt(8)
    return 2 * np.arcsin(np.minimum(chord, 1))


def _refined(x, y, pose, method: Refinement | None, spacing: float, config) -> Refined:
    """The pose refined with more points than the search had; without a method as it is."""
    if method is None:
        rotation = frame.nearest_rotation(pose.rotation)
        return Refined(RigidTransform(rotation, pose.translation), 0, None, _UNREFINED)
    x, y = (_enough(prepare.reduce_to(p, config.refine_points), config) for p in (x, y))
    finer = min(spacing, max(prepare.spacing(x), prepare.spacing(y), prepare.FINEST))
    settings = RefineConfig(
        method=method,
        iterations=config.refine_iterations,
        max_correspondence_distance=config.refine_reach * finer,
        kernel_annealing=config.refine_anneal,
        both_directions=True,
        k=config.refine_neighbors,
        epsilon=config.refine_thickness,
        edges=config.refine_edges,
    )
    return refine_on_host(x, y, initial=pose, config=settings)


def _result(
    x: np.ndarray,
    y: np.ndarray,
    moving: prepare.Scan,
    fixed: prepare.Scan,
    where: frame.Frame,
    refined: Refined,
    judged: verdict.Evidence,
    reach: float,
    begin: float,
) -> ScanRegistration:
    inner = refined.transform
    pose = frame.pose_out(where, inner)
    distance, index = prepare.nearest(cKDTree(y), x @ inner.rotation.T + inner.translation)
    near = distance <= reach
    confidence = np.maximum(0, 1 - (distance / reach) ** 2) ** 2
    units = np.repeat([1.0, where.length], 3)
    chance = verdict.probability(judged)
    known = refined.uncertainty.weight > 0
    centroid = np.zeros(3)  # of the whole reference, in the frame
    covariance = (
        about(refined.uncertainty, centroid).covariance if known else np.full((6, 6), np.nan)
    )
    return ScanRegistration(
        rotation=pose.rotation,
        translation=pose.translation,
        transformation=np.block([[pose.rotation, pose.translation[:, None]], [0, 0, 0, 1]]),
        confidence=prepare.per_input_row(moving, confidence, missing=0.0),
        correspondences=prepare.per_input_row(moving, fixed.points[index], missing=np.nan),
        reach=reach * where.length,
        fitness=float(np.mean(near[moving.row])),
        inlier_rmse=float(np.sqrt(np.mean(distance[near] ** 2)) * where.length)
        if near.any()
        else 0,
        overlap=judged.overlap,
        covariance=covariance * np.outer(units, units),
        weak_directions=tuple(d.name for d in weak_directions(refined.uncertainty)),
        success=chance >= verdict.TRUSTED,
        probability=chance,
        evidence=judged,
        seconds=time.perf_counter() - begin,
        dropped=int(np.sum(~moving.kept) + np.sum(~fixed.kept)),
    )
