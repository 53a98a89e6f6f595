"""Register two scans: numpy in, numpy out, any sizes and any unit."""

import dataclasses
import functools
import math
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxreg.geometry import frame
from jaxreg.geometry.clouds import check_pose, padded_size
from jaxreg.geometry.rigid import nearest_rotation, rotation_angle_deg
from jaxreg.refine.host import Refined, refine_indexed, unrefined
from jaxreg.refine.uncertainty import PoseUncertainty, WeakDirection, about, weak_directions
from jaxreg.scans import diagnosis, prepare, verdict
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.prepare import Prepared
from jaxreg.search.learned import load_features
from jaxreg.search.stages import search_described
from jaxreg.types import RigidTransform

_SMALLEST = 512
"""Smallest size of a padded cloud in the search."""
_TURN_COST = 0.01
"""What half a turn costs in the choice of a pose, in units of the search's score: among poses that
agree equally (a symmetric shape) the one that turns least is chosen."""
_RIVAL_DEG, _RIVAL_DISTANCE = 15.0, 0.2
"""A pose that turns by more than this from the chosen one, or moves the source's centroid farther
away (in the unit of the frame), is another pose and not a variant of it."""


class Alternative(NamedTuple):
    """Another pose that the search found, and how much worse it agrees.

    `lead` is in shares of the points; near 0 the two poses agree equally well.
    """

    transform: RigidTransform
    lead: float


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
    computed from. `alternatives` are the other poses that the search found, the best first.

    `covariance` is that of a small rotation vector (rad) and translation about the centroid of the
    reference's distinct points; NaN if nothing was refined or no surfaces were near each other.
    `weak_directions` are the motions that barely change the fit. `converged` says whether the last
    step of the refinement was below its tolerance (None: not refined). `dropped` counts the
    non-finite rows of both clouds.
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
    evidence: verdict.Evidence
    converged: bool | None
    dropped: int

    @property
    def transform(self) -> RigidTransform:
        """Rotation and translation, from source to reference."""
        return RigidTransform(self.rotation, self.translation)


class _Problem(NamedTuple):
    """Two prepared clouds in one frame; points within `distance` count as the same."""

    source: Prepared
    reference: Prepared
    where: frame.Frame
    levels: tuple[prepare.Level, prepare.Level]
    spacing: float
    distance: float
    config: RegisterConfig

    def placed(self) -> tuple[tuple[prepare.Level, float], tuple[prepare.Level, float]]:
        """Both levels, each with its scale in the frame."""
        source, reference = self.levels
        length = float(self.where.length)
        return (source, self.source.radius / length), (reference, self.reference.radius / length)


class _Found(NamedTuple):
    """A pose in the frame, how much better it is than the next distinct one, and the others."""

    pose: RigidTransform
    rival: float
    alternatives: tuple[Alternative, ...]


def register(
    source: object,
    reference: object,
    *,
    initial: object = None,
    max_rotation_deg: float | None = None,
    nonfinite: Literal["raise", "drop"] = "raise",
    config: RegisterConfig | None = None,
) -> ScanRegistration:
    """Register two scans: the transform ``y = R x + t`` from source to reference, with a verdict.

    The clouds are array-likes (n, 3) and (m, 3) in one unit, or results of `jaxreg.prepare`; size,
    order of the points and origin do not matter. `initial` (4x4 or a `RigidTransform`) starts from
    a known pose. The search is skipped, so `alternatives` is empty and the verdict does without
    rival poses. `max_rotation_deg` is the largest rotation to consider (None: any); it decides
    between the poses of a symmetric shape. The same input gives the same bits.

    Raises:
      ValueError: a cloud is not a numeric (n, 3) array with at least three finite points (the
        message names the row), `initial` is not rigid, an option is out of range, or a cloud was
        prepared with another configuration.
    """
    config = RegisterConfig() if config is None else config
    _check_options(max_rotation_deg, config)
    start = None if initial is None else check_pose(initial, "initial")
    problem = _pose_problem(
        _prepared(source, "source", nonfinite, config),
        _prepared(reference, "reference", nonfinite, config),
        config,
    )
    if start is None:
        found = _search(problem, max_rotation_deg)
    else:
        found = _Found(frame.transform_in(problem.where, start), verdict.NOT_SEARCHED, ())
    refined = _refine(problem, found.pose)
    placed = problem.placed()
    judged = verdict.evidence(
        refined.transform, placed[0], placed[1], problem.distance, rival=found.rival
    )
    return _result(problem, refined, judged, found.alternatives)


_LEAST = {"search_points": 16, "refine_points": 16}
"""The smallest allowed value of these settings; the others must be positive."""


def _check_options(max_rotation_deg: float | None, config: RegisterConfig) -> None:
    for name in ("search_points", "refine_points", "inlier_spacings", "refine_spacings"):
        value, least = getattr(config, name), _LEAST.get(name, 0)
        if not (least <= value < np.inf and value > 0):
            bound = f"at least {least}" if least else "positive"
            raise ValueError(f"config.{name} must be {bound} and finite, got {value}.")
    if max_rotation_deg is not None and not 0 < max_rotation_deg <= 180:
        raise ValueError(
            f"max_rotation_deg must be above 0 and at most 180, got {max_rotation_deg}: leave it out "
            "for clouds in any orientation."
        )


def _prepared(cloud: object, name: str, nonfinite, config: RegisterConfig) -> Prepared:
    if not isinstance(cloud, Prepared):
        return prepare.prepare(cloud, nonfinite=nonfinite, config=config, name=name)
    if cloud.config != config:
        raise ValueError(
            f"{name} was prepared with another configuration than this registration's: give "
            "jaxreg.prepare and jaxreg.register the same config."
        )
    return cloud


def _pose_problem(source: Prepared, reference: Prepared, config: RegisterConfig) -> _Problem:
    length = math.hypot(source.radius, reference.radius) / math.sqrt(2)
    where = frame.Frame(source.centre, reference.centre, length)
    levels = prepare.at_one_density(source, reference)
    sides = zip(levels, (source, reference), strict=True)
    spacing = max(
        prepare.FINEST, *(level.spacing * cloud.radius / length for level, cloud in sides)
    )
    distance = config.inlier_spacings * spacing
    return _Problem(source, reference, where, levels, spacing, distance, config)


def _search(problem: _Problem, max_rotation_deg: float | None) -> _Found:
    """The most plausible pose, and how much more plausible it is than the next distinct one."""
    where, most = problem.where, math.radians(max_rotation_deg or 180.0)
    poses, score, allowed = _searched_poses(problem, most)
    turned = np.radians(rotation_angle_deg(poses.rotation, np.eye(3)[None]))
    # If no pose is allowed, the best of the others is at least an answer.
    allowed = allowed if allowed.any() else np.ones_like(allowed)
    best = int(np.argmax(np.where(allowed, score, -np.inf) - _TURN_COST * turned / np.pi))
    apart = np.linalg.norm(poses.translation - poses.translation[best], axis=1)
    angle = rotation_angle_deg(poses.rotation, poses.rotation[best][None])
    # A pose that turns too far is not a rival: it was ruled out.
    others = allowed & ((angle > _RIVAL_DEG) | (apart > _RIVAL_DISTANCE))
    rival = float(score[best] - score[others].max()) if others.any() else verdict.NO_RIVAL
    alternatives = tuple(
        Alternative(frame.transform_out(where, _nth(poses, i)), float(score[best] - score[i]))
        for i in np.flatnonzero(others).tolist()
    )
    return _Found(_nth(poses, best), rival, alternatives)


def _searched_poses(
    problem: _Problem, most: float
) -> tuple[RigidTransform, np.ndarray, np.ndarray]:
    """The poses of the search in the pair's frame (float64), their scores, and which are allowed."""
    where, config = problem.where, problem.config
    # Twice the radius: a usual shape then fills the unit sphere.
    unit = prepare.in_steps(2 * float(where.length))
    size = padded_size(max(len(level.points) for level in problem.levels), smallest=_SMALLEST)
    described = (
        level.described(unit / cloud.radius, size, config.search)
        for level, cloud in zip(problem.levels, (problem.source, problem.reference), strict=True)
    )
    unmoved = frame.transform_in(
        where._replace(length=unit), RigidTransform(np.eye(3), np.zeros(3))
    )
    # Clouds that lie farther apart than float32 reaches do not overlap as they are anyway.
    also = RigidTransform(*(np.clip(part, -1e6, 1e6).astype(np.float32) for part in unmoved))
    found = _program(config)(*described, also, np.float32(most))
    poses = RigidTransform(*(np.asarray(part, np.float64) for part in found.poses))
    scale = unit / float(where.length)
    poses = poses._replace(translation=poses.translation * scale)
    return poses, np.asarray(found.score), np.asarray(found.allowed)


@functools.cache
def _program(config: RegisterConfig):
    def run(network, source, reference, also, max_angle):
        return search_described(
            source, reference, network=network, also=also, max_angle=max_angle, config=config.search
        )

    network = jax.device_put(load_features()) if config.learned else None
    return functools.partial(jax.jit(run), network)


def _nth(poses: RigidTransform, i: int) -> RigidTransform:
    return RigidTransform(nearest_rotation(poses.rotation[i]), poses.translation[i])


def _refine(problem: _Problem, pose: RigidTransform) -> Refined:
    """The pose refined with more points than the search had, or as it is."""
    config = problem.config
    if config.refine is None:
        return unrefined(pose)
    source, reference, where = problem.source, problem.reference, problem.where
    clouds = [cloud.in_frame(cloud.fine, where) for cloud in (source, reference)]
    given = config.refine.max_correspondence_distance
    if math.isfinite(given):
        distance = given / float(where.length)
    else:
        spacings = (c.fine.spacing * c.radius / float(where.length) for c in (source, reference))
        distance = config.refine_spacings * min(problem.spacing, max(prepare.FINEST, *spacings))
    return refine_indexed(*clouds, initial=pose, distance=distance, config=config.refine)


def _result(
    problem: _Problem,
    refined: Refined,
    judged: verdict.Evidence,
    alternatives: tuple[Alternative, ...],
) -> ScanRegistration:
    source, where = problem.source, problem.where
    length = float(where.length)
    pose = frame.transform_out(where, refined.transform)
    near, nearest = _nearest(problem, refined.transform)
    inside = near <= problem.distance
    confidence = np.maximum(0, 1 - (near / problem.distance) ** 2) ** 2
    correspondences = problem.reference.points[nearest] * problem.reference.radius
    chance = verdict.probability(judged)
    weak = tuple(
        direction._replace(point=where.reference_centre + length * direction.point)
        for direction in weak_directions(refined.uncertainty)
    )
    return ScanRegistration(
        rotation=pose.rotation,
        translation=pose.translation,
        transformation=np.block([[pose.rotation, pose.translation[:, None]], [0, 0, 0, 1]]),
        confidence=source.per_input_row(confidence, missing=0.0),
        correspondences=source.per_input_row(
            correspondences + problem.reference.centre, missing=np.nan
        ),
        success=chance >= verdict.TRUSTED,
        probability=chance,
        reason=_reason(problem, judged, weak) if chance < verdict.TRUSTED else "",
        overlap=judged.overlap,
        fitness=float(np.mean(inside[source.row])),
        inlier_rmse=float(np.sqrt(np.mean(near[inside] ** 2)) * length) if inside.any() else 0.0,
        max_correspondence_distance=problem.distance * length,
        covariance=_covariance(refined.uncertainty, length),
        weak_directions=weak,
        alternatives=alternatives,
        evidence=judged,
        converged=refined.converged,
        dropped=int(np.sum(~source.kept) + np.sum(~problem.reference.kept)),
    )


def _reason(problem: _Problem, judged: verdict.Evidence, weak: tuple[WeakDirection, ...]) -> str:
    """Why the pose is not trusted, and whether the clouds seem to be in different units."""
    source, reference = (c.points * c.radius for c in (problem.source, problem.reference))
    units = diagnosis.compared(source, reference, least=3.0)
    return " ".join(
        [verdict.reason(judged, weak), *(f"{told[:1].upper()}{told[1:]}." for told in units)]
    )


def _nearest(problem: _Problem, pose: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """For every source point: distance, in the frame, to the nearest reference point, and its index."""
    source, reference, length = problem.source, problem.reference, float(problem.where.length)
    moved = source.points @ (pose.rotation.T * (source.radius / length)) + pose.translation
    near, index = prepare.nearest(reference.tree, moved * (length / reference.radius))
    return near * (reference.radius / length), index


def _covariance(uncertainty: PoseUncertainty, length: float) -> Float[np.ndarray, "6 6"]:
    """About the centroid of the reference, which is the origin of the frame; NaN if unknown."""
    if not uncertainty.weight > 0:
        return np.full((6, 6), np.nan)
    units = np.repeat([1.0, length], 3)
    return about(uncertainty, np.zeros(3)).covariance * np.outer(units, units)
