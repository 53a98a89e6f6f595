"""Register two scans: numpy in, numpy out, any sizes and any unit."""

import time
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from jaxreg import scans
from jaxreg.config import RegisterConfig
from jaxreg.refine.host import Refined
from jaxreg.refine.host import refine as refine_pose
from jaxreg.refine.uncertainty import weak_directions
from jaxreg.search import host, verdict
from jaxreg.types import RigidTransform

Rotation = Literal["limited", "full"]
Refinement = Literal["gicp", "icp", "point_to_plane"]

_DEFAULT = RegisterConfig()
_FEWEST_FOR_FEATURES = 32
_FEWEST_FOR_NORMALS = 11


class ScanRegistration(NamedTuple):
    """Where the source lies in the frame of the reference, and how far that can be trusted.

    float64, in the unit of the input, a row for every row of the source. `confidence[i]`, in
    [0, 1], says how well point `i` agrees with the reference after alignment; `correspondences[i]`
    is the reference point nearest to it there (NaN for a dropped point). `reach` is the distance
    within which two points count as the same surface, taken from their spacing. `fitness` is the
    share of the source within reach of the reference, `inlier_rmse` the root mean square distance
    of those points, `overlap` the share of both clouds within reach of the other, at equal density.

    `covariance` is that of a small rotation vector (rad) and translation about the centroid of the
    reference. `weak_directions` names the motions that the clouds hardly resist. `success` is False
    when the pose should not be trusted, `probability` is the calibrated chance that it is right.
    `evidence` is what that chance is computed from. `dropped` counts the non-finite rows of both
    clouds.
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
    known pose and skips the search. `rotation` says how far the clouds may be turned: "full" by
    anything, "limited" by `config.limited_deg`, which settles symmetric shapes. `refine` None gives
    the pose of the search. The same input gives the same bits.

    Raises:
      ValueError: a cloud is not numeric (n, 3) with three finite points or more (the message names
        the row), `initial` is no rigid transform, or an option is unknown.
    """
    begin = time.perf_counter()
    _check_options(rotation, refine)
    start = None if initial is None else _check_initial(initial)
    moving = scans.make_scan(source, "source", nonfinite=nonfinite)
    fixed = scans.make_scan(reference, "reference", nonfinite=nonfinite)
    frame = scans.common_frame(moving.points, fixed.points)
    x = (moving.points - frame.source_centre) / frame.length
    y = (fixed.points - frame.reference_centre) / frame.length
    clouds = *host.coarse_pair(x, y, config), frame
    rival = verdict.NO_RIVAL
    if start is None:
        pose, rival = _searched(*clouds, rotation, config)
    else:
        start = _stacked(scans.pose_in(frame, start))
        pose = _first(host.polished(start, *clouds[:3])) if refine else _first(start)
    refined = _refined(x, y, pose, refine, clouds[2], config)
    reach = config.reach * clouds[2]
    judged = verdict.evidence(refined.transform, *clouds[:2], reach, rival=rival)
    return _result(x, y, moving, fixed, frame, refined, judged, reach, begin)


def _check_options(rotation: str, refine: str | None) -> None:
    if rotation not in ("limited", "full"):
        raise ValueError(f"rotation must be 'limited' or 'full', got {rotation!r}.")
    if refine not in ("gicp", "icp", "point_to_plane", None):
        raise ValueError(f"refine must be 'gicp', 'icp', 'point_to_plane' or None, got {refine!r}.")


def _check_initial(initial: object) -> RigidTransform:
    if isinstance(initial, RigidTransform):
        rotation, translation = (np.asarray(part, np.float64) for part in initial)
    else:
        matrix = np.asarray(initial, np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"initial must be a 4x4 matrix [[R, t], [0, 1]], got {matrix.shape}.")
        rotation, translation = matrix[:3, :3], matrix[:3, 3]
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise ValueError("initial holds NaN or infinity: give a finite transform.")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise ValueError(
            "initial is no rigid transform (its 3x3 part must be a rotation: orthogonal, det +1): "
            "remove scale, shear and mirroring."
        )
    return RigidTransform(scans.nearest_rotation(rotation), translation)


def _searched(
    source: host.Coarse,
    reference: host.Coarse,
    spacing: float,
    frame: scans.Frame,
    rotation: Rotation,
    config: RegisterConfig,
) -> tuple[RigidTransform, float]:
    """The pose on which the coarse clouds agree best, and how much worse the next best agrees.

    Poses come from matched histograms. Where the best of them leaves a doubt, the dense path adds
    its own; clouds of few points have no histograms, and are turned by a covering of the rotations.
    """
    largest = 180.0 if rotation == "full" else config.limited_deg
    unmoved = scans.pose_in(frame, RigidTransform(np.eye(3), np.zeros(3)))
    pool = RigidTransform(np.stack([np.eye(3)] * 2), np.stack([np.zeros(3), unmoved.translation]))
    if min(len(source.valid), len(reference.valid)) < _FEWEST_FOR_FEATURES:
        pool = host.joined(pool, host.start_poses(source, reference, config, largest_deg=largest))
        return _best(pool, source, reference, spacing, largest, config)
    pool = host.joined(pool, host.feature_poses(source, reference, spacing, config))
    pose, lead = _best(pool, source, reference, spacing, largest, config)
    found = verdict.evidence(pose, source, reference, config.reach * spacing, rival=lead)
    if verdict.probability(found) > config.convincing:
        return pose, lead
    more = host.joined(_stacked(pose), host.dense_poses(source, reference))
    return _best(more, source, reference, spacing, largest, config)


def _best(pool, source, reference, spacing, largest_deg, config) -> tuple[RigidTransform, float]:
    """The pose of a pool that agrees best after polishing, the lead over others, its disagreement."""
    pool = host.turned_less(pool, largest_deg)
    scores = host.disagreement(pool, source, reference, 3 * spacing)
    chosen = host.distinct_best(pool, scores, config.verified, apart=2 * spacing)
    chosen = host.polished(chosen, source, reference, spacing)
    # A narrow reach: flips of nearly symmetric shapes agree roughly, and only the truth closely.
    scores = host.disagreement(chosen, source, reference, spacing)
    # Of poses that agree equally (a symmetric shape) the one that turns least.
    best = int(np.argmin(scores + 0.01 * host.angles(chosen) / np.pi))
    others = host.differs(chosen, best)
    lead = scores[others].min() - scores[best] if others.any() else verdict.NO_RIVAL
    return jax.tree.map(lambda part: part[best], chosen), float(lead)


def _stacked(pose: RigidTransform) -> RigidTransform:
    return RigidTransform(*(part[None] for part in pose))


def _first(poses: RigidTransform) -> RigidTransform:
    return jax.tree.map(lambda part: part[0], poses)


def _refined(x, y, pose, method: Refinement | None, spacing: float, config) -> Refined:
    """The pose refined with more points than the search had."""
    x, y = (scans.reduce_to(points, config.refine_points) for points in (x, y))
    finer = min(spacing, max(scans.spacing(x), scans.spacing(y)))
    few = min(len(x), len(y)) < _FEWEST_FOR_NORMALS
    if few:
        x, y = (np.resize(points, (_FEWEST_FOR_NORMALS, 3)) for points in (x, y))
    return refine_pose(
        x,
        y,
        method="icp" if few else method or "icp",
        initial=pose,
        iterations=config.refine_iterations if method else 1,
        max_distance=3 * finer if method else 0.0,
        anneal=4.0,
        both_directions=True,
        dense_limit=0,
    )


def _result(
    x: np.ndarray,
    y: np.ndarray,
    moving: scans.Scan,
    fixed: scans.Scan,
    frame: scans.Frame,
    refined: Refined,
    judged: verdict.Evidence,
    reach: float,
    begin: float,
) -> ScanRegistration:
    inner = RigidTransform(scans.nearest_rotation(refined.transform.rotation), refined.transform[1])
    pose = scans.pose_out(frame, inner)
    distance, index = scans.nearest(cKDTree(y), x @ inner.rotation.T + inner.translation)
    near = distance <= reach
    confidence = np.maximum(0, 1 - (distance / reach) ** 2) ** 2
    units = np.repeat([1.0, frame.length], 3)
    chance = verdict.probability(judged)
    return ScanRegistration(
        rotation=pose.rotation,
        translation=pose.translation,
        transformation=np.block([[pose.rotation, pose.translation[:, None]], [0, 0, 0, 1]]),
        confidence=scans.per_input_row(moving, confidence, missing=0.0),
        correspondences=scans.per_input_row(moving, fixed.points[index], missing=np.nan),
        reach=reach * frame.length,
        fitness=float(np.mean(near[moving.row])),
        inlier_rmse=float(np.sqrt(np.mean(distance[near] ** 2)) * frame.length)
        if near.any()
        else 0,
        overlap=judged.overlap,
        covariance=refined.uncertainty.covariance * np.outer(units, units),
        weak_directions=tuple(d.name for d in weak_directions(refined.uncertainty)),
        success=chance >= verdict.TRUSTED,
        probability=chance,
        evidence=judged,
        seconds=time.perf_counter() - begin,
        dropped=int(np.sum(~moving.kept) + np.sum(~fixed.kept)),
    )
