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
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.judge.evidence import Evidence
from jaxreg.judge.odds import probabilities
from jaxreg.refine.host import Refined, refine_indexed, unrefined
from jaxreg.refine.uncertainty import PoseUncertainty, WeakDirection, about, weak_directions
from jaxreg.scans import candidates, dense, diagnosis, prepare, verdict
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.prepare import Prepared
from jaxreg.search.config import SearchConfig
from jaxreg.search.learned import load_features
from jaxreg.search.stages import search_described
from jaxreg.types import RigidTransform

_SMALLEST = 512
"""Smallest size of a padded cloud in the search."""
_TURN_COST = 0.2
"""Log odds that half a turn costs in the choice of a pose: of poses that agree equally well (a
symmetric shape) the one that turns least is taken."""
_SURE = 0.9
"""Probability at which the search ends, because an easy pair needs no wider one."""
_UNLIKE_SIZES = 2.0
"""Ratio of the radii from which a scan may lie inside the other, and is looked for at its own scale."""
_FIRST, _WIDE = 4, 16
"""Distinct poses that are refined and judged, after the first search and after the wider one."""
_MORE = 200
"""Further iterations of the refinement for a pose that still moves."""
_LISTED = 0.01
"""Smallest probability at which a pose is listed among the alternatives."""


class Alternative(NamedTuple):
    """Another pose of the source, and the probability that it is the right one."""

    transform: RigidTransform
    probability: float


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
    evidence: Evidence
    converged: bool | None
    dropped: int
    notes: tuple[str, ...]

    @property
    def transform(self) -> RigidTransform:
        """Rotation and translation, from source to reference."""
        return RigidTransform(self.rotation, self.translation)

    @property
    def reach(self) -> float:
        """`max_correspondence_distance` by its short name."""
        return self.max_correspondence_distance


class Problem(NamedTuple):
    """Two prepared clouds in one frame; points within `distance` count as the same.

    `levels` and `unit` are what the search compares, and its unit in that of the input.
    """

    source: Prepared
    reference: Prepared
    where: frame.Frame
    levels: tuple[prepare.Level, prepare.Level]
    unit: float
    spacing: float
    distance: float
    config: RegisterConfig

    def clouds(self) -> candidates.Clouds:
        """Both fine levels in the frame."""
        sides = (self.source, self.reference)
        source, reference = (side.in_frame(side.fine, self.where) for side in sides)
        return candidates.Clouds(
            source, reference, (sides[0].fine.examined, sides[1].fine.examined)
        )

    def reach(self) -> float:
        """The largest distance between corresponding points of the fine levels, in the frame."""
        clouds, length = (self.source, self.reference), float(self.where.length)
        spacings = (cloud.fine.spacing * cloud.radius / length for cloud in clouds)
        return self.config.refine_spacings * min(self.spacing, max(prepare.FINEST, *spacings))


class _Found(NamedTuple):
    """The chosen pose in the frame, the others with their log odds, and how likely it is right."""

    pose: RigidTransform
    others: tuple[tuple[RigidTransform, float], ...]
    probability: float = 1.0


def register(
    source: object,
    reference: object,
    *,
    initial: object = None,
    max_rotation_deg: float | None = None,
    nonfinite: Literal["raise", "drop"] = "raise",
    strays: Literal["drop", "keep", "raise"] = "drop",
    config: RegisterConfig | None = None,
) -> ScanRegistration:
    """Register two scans: the transform ``y = R x + t`` from source to reference, with a verdict.

    The clouds are array-likes (n, 3) and (m, 3) in one unit, or results of `jaxreg.prepare`; size,
    order of the points and origin do not matter. `initial` (4x4 or a `RigidTransform`) starts from
    a known pose. The search is skipped, so `alternatives` is empty and the verdict does without
    rival poses. `max_rotation_deg` is the largest rotation to consider (None: any); it decides
    between the poses of a symmetric shape. `nonfinite` and `strays` say what to do with rows that are
    NaN or infinite, and with a few points that lie ten times as far from the middle as all others.
    The same input gives the same bits.

    Raises:
      ValueError: a cloud is not a numeric (n, 3) array with at least three finite points (the
        message names the row), `initial` is not rigid, an option is out of range, or a cloud was
        prepared with another configuration.
    """
    config = RegisterConfig() if config is None else config
    _check_options(max_rotation_deg, config)
    start = None if initial is None else check_pose(initial, "initial")
    return register_prepared(
        _prepared(source, "source", nonfinite, strays, config),
        _prepared(reference, "reference", nonfinite, strays, config),
        config,
        start=start,
        max_rotation_deg=max_rotation_deg,
    )


def register_prepared(
    source: Prepared,
    reference: Prepared,
    config: RegisterConfig,
    *,
    start: RigidTransform | None = None,
    max_rotation_deg: float | None = None,
    least: float = 0.0,
) -> ScanRegistration:
    """`register` of clouds that were prepared with `config`, or with one that differs in `wide` only.

    A pose whose probability is below `least` after the search is left as the search had it.
    """
    problem = pose_problem(source, reference, config)
    if start is None:
        found = _search(problem, max_rotation_deg)
    else:
        found = _Found(frame.transform_in(problem.where, start), ())
    if found.probability < least:
        refined = unrefined(found.pose)
        return _result(problem, refined, found, "")
    refined = _refine(problem, found.pose)
    return _result(problem, refined, found, _another_cause(problem, refined.transform))


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


def _prepared(cloud: object, name: str, nonfinite, strays, config: RegisterConfig) -> Prepared:
    if not isinstance(cloud, Prepared):
        return prepare.prepare(cloud, nonfinite=nonfinite, strays=strays, config=config, name=name)
    if cloud.config != config:
        raise ValueError(
            f"{name} was prepared with another configuration than this registration's: give "
            "jaxreg.prepare and jaxreg.register the same config."
        )
    return cloud


def pose_problem(source: Prepared, reference: Prepared, config: RegisterConfig) -> Problem:
    """Two prepared clouds in one frame."""
    length = math.hypot(source.radius, reference.radius) / math.sqrt(2)
    where = frame.Frame(source.centre, reference.centre, length)
    levels = prepare.at_one_density(source, reference)
    sides = zip(levels, (source, reference), strict=True)
    spacing = max(
        prepare.FINEST, *(level.spacing * cloud.radius / length for level, cloud in sides)
    )
    distance = config.inlier_spacings * spacing
    # Twice the radius: a usual shape then fills the unit sphere.
    unit = prepare.in_steps(2 * length)
    return Problem(source, reference, where, levels, unit, spacing, distance, config)


def _search(problem: Problem, max_rotation_deg: float | None) -> _Found:
    """The most plausible pose: by the first search, or where that leaves doubts by a wider one."""
    config, most = problem.config, math.radians(max_rotation_deg or 180.0)
    found = searched_and_judged(problem, most, config.search)
    if config.wide is not None and probabilities(found.score).max() < _SURE:
        found = candidates.merged(found, searched_and_judged(problem, most, config.wide))
        if (nearer := closer(problem)) and probabilities(found.score).max() < _SURE:
            found = candidates.merged(found, searched_and_judged(nearer, most, config.wide))
    turned = np.radians(rotation_angle_deg(found.poses.rotation, np.eye(3)[None]))
    # A pose that turns too far is not a rival: it was ruled out. If no pose is allowed, the best of
    # the others is at least an answer.
    allowed = turned <= most + 1e-3
    allowed = allowed if allowed.any() else np.ones_like(allowed)
    best = int(np.argmax(np.where(allowed, found.score - _TURN_COST * turned / np.pi, -np.inf)))
    poses = [RigidTransform(*pose) for pose in zip(*found.poses, strict=True)]
    others = np.flatnonzero(allowed & (np.arange(len(poses)) != best))
    return _Found(
        poses[best],
        tuple((poses[i], float(found.score[i])) for i in others),
        float(probabilities(found.score)[best]),
    )


def closer(problem: Problem) -> Problem | None:
    """The pair in the unit of the smaller cloud and at the density that shows it, if sizes differ."""
    radii = sorted((problem.source.radius, problem.reference.radius))
    if radii[1] < _UNLIKE_SIZES * radii[0]:
        return None
    levels = prepare.at_fine_density(problem.source, problem.reference)
    return problem._replace(levels=levels, unit=prepare.in_steps(2 * radii[0]))


def searched_and_judged(problem: Problem, most: float, search: SearchConfig) -> candidates.Judged:
    """The distinct poses of one search, refined and judged; they turn by at most `most` radians."""
    first = search == problem.config.search
    poses, score = _searched_poses(problem, most, search, problem.config.learned or not first)
    most_poses = _FIRST if first else _WIDE
    return candidates.judged(
        problem.clouds(), poses, score, distance=problem.reach(), most=most_poses
    )


def _searched_poses(
    problem: Problem, most: float, search: SearchConfig, learned: bool
) -> tuple[RigidTransform, np.ndarray]:
    """The poses of the search in the pair's frame (float64), and their scores; the allowed ones."""
    where, unit = problem.where, problem.unit
    sizes = [padded_size(len(level.points), smallest=_SMALLEST) for level in problem.levels]
    # One size for both, so that few programs are compiled, unless one cloud is far larger.
    sizes = sizes if max(sizes) > 2 * min(sizes) else 2 * [max(sizes)]
    sides = zip(problem.levels, sizes, (problem.source, problem.reference), strict=True)
    described = (
        level.described(unit / cloud.radius, size, search.radii) for level, size, cloud in sides
    )
    unmoved = frame.transform_in(
        where._replace(length=unit), RigidTransform(np.eye(3), np.zeros(3))
    )
    # Clouds that lie farther apart than float32 reaches do not overlap as they are anyway.
    also = RigidTransform(*(np.clip(part, -1e6, 1e6).astype(np.float32) for part in unmoved))
    found = _program(search, learned)(*described, also, np.float32(most))
    poses = RigidTransform(*(np.asarray(part, np.float64) for part in found.poses))
    scale = unit / float(where.length)
    poses = poses._replace(translation=poses.translation * scale)
    chosen = np.flatnonzero(found.allowed)
    # If no pose is allowed, the best of the others is at least an answer.
    chosen = chosen if len(chosen) else np.arange(len(found.allowed))
    poses = RigidTransform(poses.rotation[chosen], poses.translation[chosen])
    return poses, np.asarray(found.score)[chosen]


@functools.cache
def _program(search: SearchConfig, learned: bool):
    def run(network, source, reference, also, max_angle):
        return search_described(
            source, reference, network=network, also=also, max_angle=max_angle, config=search
        )

    network = jax.device_put(load_features()) if learned else None
    return functools.partial(jax.jit(run), network)


def _refine(problem: Problem, pose: RigidTransform) -> Refined:
    """The pose refined with more points than the search had, or as it is."""
    config = problem.config
    if config.refine is None:
        return unrefined(pose)
    given = config.refine.max_correspondence_distance
    distance = given / float(problem.where.length) if math.isfinite(given) else problem.reach()
    source, reference, _ = problem.clouds()
    return refine_indexed(
        source, reference, initial=pose, distance=distance, config=config.refine, more=_MORE
    )


def _another_cause(problem: Problem, pose: RigidTransform) -> str:
    """A sentence if the clouds fit far better mirrored, or at another size; mostly there is none."""
    source, reference, config = problem.source, problem.reference, problem.config
    pose = _lengthened(pose, problem.where)
    now = dense.at_a_glance(source, reference, pose)
    if not now.suspicious:
        return ""
    reach = problem.distance * float(problem.where.length)
    scale, then = dense.at_another_size(source, reference, pose, reach)
    if told := dense.size_text(scale, now, then):
        return told
    mirrored = prepare.prepare(source.points * source.radius * [-1, 1, 1], config=config)
    twin = pose_problem(mirrored, reference, config)
    other = _lengthened(_refine(twin, _search(twin, None).pose).transform, twin.where)
    if dense.agreement(mirrored, reference, other).explains(now):
        return "The mirrored source fits better."
    return ""


def _lengthened(pose: RigidTransform, where: frame.Frame) -> RigidTransform:
    """A pose in the frame as one of the centred clouds in the unit of the input."""
    return RigidTransform(pose.rotation, pose.translation * float(where.length))


def _result(problem: Problem, refined: Refined, found: _Found, cause: str) -> ScanRegistration:
    source, where = problem.source, problem.where
    length = float(where.length)
    pose = frame.transform_out(where, refined.transform)
    near, nearest = _nearest(problem, refined.transform)
    inside = near <= problem.distance
    confidence = np.maximum(0, 1 - (near / problem.distance) ** 2) ** 2
    correspondences = problem.reference.points[nearest] * problem.reference.radius
    evidence, score = problem.clouds().judge(
        jax.tree.map(lambda leaf: leaf[None], refined.transform)
    )
    judged = jax.tree.map(lambda leaf: float(leaf[0]), evidence)
    chances = np.asarray(probabilities(np.array([score[0], *(s for _, s in found.others)])))
    chance = 0.0 if cause or verdict.is_free(judged) else float(chances[0])
    success = chance >= verdict.TRUSTED and refined.converged is not False
    alternatives = tuple(
        Alternative(frame.transform_out(where, other), float(likely))
        for (other, _), likely in zip(found.others, chances[1:], strict=True)
        if likely >= _LISTED
    )
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
        success=success,
        probability=chance,
        reason=""
        if success
        else cause or _reason(problem, refined, judged, weak, float(chances[1:].sum())),
        overlap=_overlap(problem, refined.transform),
        fitness=float(np.mean(inside[source.row])),
        inlier_rmse=float(np.sqrt(np.mean(near[inside] ** 2)) * length) if inside.any() else 0.0,
        max_correspondence_distance=problem.distance * length,
        covariance=_covariance(refined.uncertainty, length),
        weak_directions=weak,
        alternatives=alternatives,
        evidence=judged,
        converged=refined.converged,
        dropped=int(np.sum(~source.kept) + np.sum(~problem.reference.kept)),
        notes=(*source.notes, *problem.reference.notes),
    )


def _reason(
    problem: Problem,
    refined: Refined,
    judged: Evidence,
    weak: tuple[WeakDirection, ...],
    rivals: float,
) -> str:
    """Why the pose is not trusted, and whether the clouds seem to be in different units."""
    source, reference = (c.points * c.radius for c in (problem.source, problem.reference))
    units = diagnosis.compared(source, reference, least=3.0)
    moving = f"The pose was still moving after {refined.iterations} iterations of the refinement."
    return " ".join(
        [
            moving if refined.converged is False else verdict.reason(judged, weak, rivals),
            *(f"{told[:1].upper()}{told[1:]}." for told in units),
        ]
    )


def _nearest(problem: Problem, pose: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """For every source point: distance, in the frame, to the nearest reference point, and its index."""
    source, reference, length = problem.source, problem.reference, float(problem.where.length)
    moved = source.points @ (pose.rotation.T * (source.radius / length)) + pose.translation
    near, index = prepare.nearest(reference.tree, moved * (length / reference.radius))
    return near * (reference.radius / length), index


def _overlap(problem: Problem, pose: RigidTransform) -> float:
    """Share of the points of both clouds, at one density, within reach of the other."""
    sides = zip(problem.levels, (problem.source, problem.reference), strict=True)
    source, reference = (cloud.in_frame(level, problem.where) for level, cloud in sides)
    within = problem.distance
    there = reference.nearest(source.moved_by(pose), within=within)[0]
    back = source.nearest(reference.moved_back_by(pose), within=within)[0]
    distances = np.concatenate([there, back])
    return float(np.mean(distances < problem.distance))


def _covariance(uncertainty: PoseUncertainty, length: float) -> Float[np.ndarray, "6 6"]:
    """About the centroid of the reference, which is the origin of the frame; NaN if unknown."""
    if not uncertainty.weight > 0:
        return np.full((6, 6), np.nan)
    units = np.repeat([1.0, length], 3)
    return about(uncertainty, np.zeros(3)).covariance * np.outer(units, units)
