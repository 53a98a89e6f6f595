"""Register two scans of surfaces: search, refine, judge, and look at all points."""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxreg._xla import from_host
from jaxreg.geometry import frame
from jaxreg.geometry.clouds import padded_size, sizes_of_pair
from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.judge.evidence import Evidence
from jaxreg.judge.odds import chances
from jaxreg.refine.host import Refined, refine_indexed, unrefined
from jaxreg.refine.uncertainty import PoseUncertainty, WeakDirection, about, weak_directions
from jaxreg.scans import (
    candidates,
    dense,
    diagnosis,
    free_space,
    halves,
    prepare,
    repeats,
    stable,
    verdict,
    weak,
)
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.known import Known
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.result import (
    LISTED,
    Accuracy,
    Alternative,
    ScanRegistration,
    Verdict,
    assembled,
    in_unit,
)
from jaxreg.search.config import SearchConfig
from jaxreg.search.learned import load_features
from jaxreg.search.stages import search_described
from jaxreg.types import RigidTransform

_SMALLEST = 512
"""Smallest size of a padded cloud in the search."""
SURE = 0.9
"""Probability at which the search ends, because an easy pair needs no wider one."""
_NOTHING = Known()
_UNLIKE_SIZES = 2.0
"""Ratio of the radii from which a scan may lie inside the other, and is looked for at its own scale."""
_FIRST, _WIDE = 4, 16
"""Distinct poses that are refined and judged, after the first search and after the wider one."""
_CLOSE = 0.1
"""Poses of this probability are compared with the likeliest one on many points."""
_REPEATS = 16
"""Poses that are judged of those a period on, or turned by half."""
_SOME_SAME = 0.05
"""Share of points that coincide above which the clouds may be copies: two scans share hardly any."""
_ROUNDING_DEG = 0.05
"""A pose at the limit of the rotation is allowed, whatever its rounding."""
_MORE = 200
"""Further iterations of the refinement for a pose that still moves."""


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
    known: Known

    def clouds(self) -> candidates.Clouds:
        """Both fine levels in the frame."""
        sides = (self.source, self.reference)
        source, reference = (side.in_frame(side.fine, self.where) for side in sides)
        examined = (sides[0].fine.examined, sides[1].fine.examined)
        return candidates.Clouds(source, reference, examined, self.free_space())

    def free_space(self) -> free_space.Sides:
        """Both clouds as free space sees them."""
        sides = (self.source, self.reference)
        length = float(self.where.length)
        return free_space.Sides(
            (sides[0].view, sides[1].view),
            (sides[0].coarse.points, sides[1].coarse.points),
            (sides[0].radius / length, sides[1].radius / length),
        )

    @property
    def motions(self) -> Float[np.ndarray, "6 f"] | None:
        """A basis of the unknown motions, None if nothing is known of them."""
        return None if self.known.up is None else self.known.motions

    def reach(self) -> float:
        """The largest distance between corresponding points of the fine levels, in the frame."""
        clouds, length = (self.source, self.reference), float(self.where.length)
        spacings = (cloud.fine.spacing * cloud.radius / length for cloud in clouds)
        return self.config.refine_spacings * min(self.spacing, max(prepare.FINEST, *spacings))


class Found(NamedTuple):
    """The chosen pose in the frame, the others with their log odds, and how likely it is right.

    A pose that was `given` was not searched for: its rivals are those along its weak directions.
    """

    pose: RigidTransform
    others: tuple[tuple[RigidTransform, float], ...]
    probability: float = 1.0
    given: bool = False


def registered(
    source: Prepared,
    reference: Prepared,
    config: RegisterConfig,
    start: RigidTransform | None,
    known: Known,
    *,
    least: float = 0.0,
    thorough: bool = True,
) -> ScanRegistration:
    """The registration of two scans of surfaces; `least` and `thorough` as of `register_prepared`."""
    problem = pose_problem(source, reference, config, known)
    if start is None:
        return finished(problem, searched(problem), least=least, thorough=thorough)
    found = Found(frame.transform_in(problem.where, start), (), given=True)
    return finished(problem, found, thorough=thorough)


def pose_problem(
    source: Prepared, reference: Prepared, config: RegisterConfig, known: Known = _NOTHING
) -> Problem:
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
    return Problem(source, reference, where, levels, unit, spacing, distance, config, known)


def searched(problem: Problem) -> Found:
    """The most plausible pose: by the first search, or where that leaves doubts by a wider one."""
    config = problem.config
    found = searched_and_judged(problem, config.search)
    if config.wide is not None and chances(found.score).max() < SURE:
        found = candidates.merged(found, searched_and_judged(problem, config.wide))
        if (nearer := closer(problem)) and chances(found.score).max() < SURE:
            found = candidates.merged(found, searched_and_judged(nearer, config.wide))
    if chances(found.score).max() >= verdict.TRUSTED:
        found = _with_repeats(problem, found)
    turned = rotation_angle_deg(found.poses.rotation, np.eye(3)[None])
    # A pose that turns too far is not a rival: it was ruled out. If no pose is allowed, the best of
    # the others is at least an answer.
    allowed = turned <= problem.known.max_rotation_deg + _ROUNDING_DEG
    allowed = allowed if allowed.any() else np.ones_like(allowed)
    best = int(
        np.argmax(np.where(allowed, found.score - candidates.TURN_COST * turned / 180, -np.inf))
    )
    poses = [RigidTransform(*pose) for pose in zip(*found.poses, strict=True)]
    others = np.flatnonzero(allowed & (np.arange(len(poses)) != best))
    return Found(
        poses[best],
        tuple((poses[i], float(found.score[i])) for i in others),
        float(chances(found.score)[best]),
    )


def _with_repeats(problem: Problem, found: candidates.Judged) -> candidates.Judged:
    """Also the poses that lay about as much of the source on the reference as the best one does."""
    clouds = problem.clouds()
    source, reference = (cloud.points * cloud.scale for cloud in clouds[:2])
    best = RigidTransform(found.poses.rotation[0], found.poses.translation[0])
    none, axes = np.zeros((0, 3)), repeats.axes_of(source, problem.known.up)
    # Few cells tell that no half turn is as good, and one transform that no shift is.
    at_all = [
        repeats.others(source[::4], reference, best, axes=axes, most=1, resolution=repeats.COARSE),
        repeats.others(source, reference, best, axes=none, most=1),
    ]
    if not any(len(share) for _, share in at_all):
        return found
    poses, share = repeats.others(source, reference, best, axes=axes, most=_REPEATS)
    if not len(share):
        return found
    again = candidates.judged(
        clouds, poses, share, distance=problem.reach(), most=_REPEATS, motions=problem.motions
    )
    return candidates.merged(found, again)


def closer(problem: Problem) -> Problem | None:
    """The pair in the unit of the smaller cloud and at the density that shows it, if sizes differ."""
    radii = sorted((problem.source.radius, problem.reference.radius))
    if radii[1] < _UNLIKE_SIZES * radii[0]:
        return None
    levels = prepare.at_fine_density(problem.source, problem.reference)
    return problem._replace(levels=levels, unit=prepare.in_steps(2 * radii[0]))


def searched_and_judged(problem: Problem, search: SearchConfig) -> candidates.Judged:
    """The distinct poses of one search, refined and judged."""
    first = search == problem.config.search
    learned = problem.config.learned or not first
    poses, score = searched_poses(problem, search, learned=learned)
    most_poses = _FIRST if first else _WIDE
    return candidates.judged(
        problem.clouds(),
        poses,
        score,
        distance=problem.reach(),
        most=most_poses,
        motions=problem.motions,
    )


def searched_poses(
    problem: Problem, search: SearchConfig, *, learned: bool
) -> tuple[RigidTransform, np.ndarray]:
    """The poses of the search in the pair's frame (float64), and their scores; the allowed ones."""
    where, unit, most = problem.where, problem.unit, math.radians(problem.known.max_rotation_deg)
    sizes = sizes_of_pair(
        [padded_size(len(level.points), smallest=_SMALLEST) for level in problem.levels]
    )
    sides = zip(problem.levels, sizes, (problem.source, problem.reference), strict=True)
    described = (
        level.described(unit / cloud.radius, size, search.radii) for level, size, cloud in sides
    )
    unmoved = frame.transform_in(
        where._replace(length=unit), RigidTransform(np.eye(3), np.zeros(3))
    )
    # Clouds that lie farther apart than float32 reaches do not overlap as they are anyway.
    also = RigidTransform(*(np.clip(part, -1e6, 1e6).astype(np.float32) for part in unmoved))
    up = None if problem.known.up is None else problem.known.up.astype(np.float32)
    search = search if up is None else _eased(search)
    found = _program(search, learned)(*described, also, np.float32(most), up)
    poses = RigidTransform(*(np.asarray(part, np.float64) for part in found.poses))
    scale = unit / float(where.length)
    poses = poses._replace(translation=poses.translation * scale)
    chosen = np.flatnonzero(found.allowed)
    # If no pose is allowed, the best of the others is at least an answer.
    chosen = chosen if len(chosen) else np.arange(len(found.allowed))
    poses = RigidTransform(poses.rotation[chosen], poses.translation[chosen])
    return poses, np.asarray(found.score)[chosen]


def _eased(search: SearchConfig) -> SearchConfig:
    """Where both scans are level, half as many poses are enough."""
    return dataclasses.replace(
        search,
        seeds=max(1, search.seeds // 2),
        screened=max(1, search.screened // 2),
        aligned=max(1, search.aligned // 2),
    )


@functools.cache
def _program(search: SearchConfig, learned: bool):
    def run(network, source, reference, also, max_angle, up):
        return search_described(
            source, reference, network=network, also=also, max_angle=max_angle, up=up, config=search
        )

    network = jax.device_put(load_features()) if learned else None
    return functools.partial(from_host(jax.jit(run), told=(search,)), network)


def refine_pose(problem: Problem, pose: RigidTransform) -> Refined:
    """The pose refined with more points than the search had, or as it is."""
    config = problem.config
    if config.refine is None:
        return unrefined(pose)
    given = config.refine.max_correspondence_distance
    distance = given / float(problem.where.length) if math.isfinite(given) else problem.reach()
    source, reference, *_ = problem.clouds()
    return refine_indexed(
        source, reference, initial=pose, distance=distance, config=config.refine, more=_MORE,
        motions=problem.motions,
    )  # fmt: skip


class _Closing(NamedTuple):
    """What all points say of a pose: a better one if there is one, why it is wrong, what to note."""

    settled: stable.Settled | None = None
    cause: str = ""

    @property
    def notes(self) -> tuple[str, ...]:
        if self.settled is None:
            return ()
        moved = 1 - self.settled.stayed
        return (f"{moved:.0%} of the points moved or changed: the pose rests on the others",)


def _with_all_points(problem: Problem, refined: Refined, *, causes: bool) -> _Closing:
    """The last stage where parts have moved; where that is not why points disagree, the cause."""
    source, reference = problem.source, problem.reference
    pose = in_unit(refined.transform, float(problem.where.length))
    now = dense.at_a_glance(source, reference, pose)
    weights, reach = problem.known.weights, problem.reach() * float(problem.where.length)
    if weights is None and not (now.suspicious or now.drawn or now.rough):
        return _Closing(cause=_slight_size(problem, pose, now))
    settled = None
    if problem.config.refine is not None:
        settled = stable.settled(source, reference, pose, reach, known=problem.known)
        # Where the points are few, patches of the surface are coarser than what was found before.
        given = weights is not None and settled.no_worse
        settled = settled if settled.better or given else None
    if settled is not None:
        pose, now = settled.pose, dense.agreement(source, reference, settled.pose)
    cause = ""
    if causes and now.suspicious:
        cause = _another_cause(problem, pose, now)
        if not cause and weights is None:
            # Where a part has moved, the points on it are off.
            cause = settled.doubt if settled else dense.different_text(now)
    if not cause and weights is None:
        cause = _slight_size(problem, pose, now)
    return _Closing(settled, cause)


def _slight_size(problem: Problem, pose: RigidTransform, now: dense.Agreement) -> str:
    """A sentence if nearly all of the source can be compared and fits at a slightly other size."""
    radii = sorted((problem.source.radius, problem.reference.radius))
    alike = now.comparable and radii[1] < _UNLIKE_SIZES * radii[0]
    if not alike or problem.config.refine is None:
        return ""
    reach = problem.reach() * float(problem.where.length)
    scale = dense.slight_size(problem.source, problem.reference, pose, reach)
    return "" if scale is None else dense.at_size_text(scale)


def _another_cause(problem: Problem, pose: RigidTransform, now: dense.Agreement) -> str:
    """A sentence if the clouds fit far better at another size, stretched or mirrored."""
    source, reference, config = problem.source, problem.reference, problem.config
    reach = problem.distance * float(problem.where.length)
    scale, then = dense.at_another_size(source, reference, pose, reach)
    if told := dense.size_text(scale, now, then):
        return told
    sizes, then = dense.stretched(source, reference, pose, reach)
    if told := dense.stretch_text(sizes, now, then):
        return told
    mirrored = prepare.mirrored(source, config)
    # Nearly all of both clouds overlap here, which needs no wider search.
    twin = pose_problem(mirrored, reference, dataclasses.replace(config, wide=None))
    other = refine_pose(twin, searched(twin).pose).transform
    other = in_unit(other, float(twin.where.length))
    if dense.agreement(mirrored, reference, other).explains(now):
        return dense.MIRRORED
    return ""


def finished(
    problem: Problem, found: Found, *, least: float = 0.0, thorough: bool = True
) -> ScanRegistration:
    """The chosen pose refined, looked at with all points, and judged beside the others."""
    closely = thorough and found.probability >= least
    if found.probability < least:
        refined, closing = unrefined(found.pose), _Closing()
    else:
        refined, closing = refine_pose(problem, found.pose), _Closing()
        if thorough or found.probability >= verdict.TRUSTED:
            closing = _with_all_points(problem, refined, causes=thorough)
    source, where = problem.source, problem.where
    length, cause = float(where.length), closing.cause
    covariance = problem.known.conditional(_covariance(refined.uncertainty, length))
    hardly_held = weak_directions(problem.known.held(refined.uncertainty))
    settled, as_good = closing.settled, ()
    if closely:
        pose = refined.transform if settled is None else in_unit(settled.pose, 1 / length)
        settled, as_good = _along_weak(problem, pose, hardly_held, settled)
    if settled is not None:
        covariance = settled.covariance
        refined = refined._replace(transform=in_unit(settled.pose, 1 / length))
    if closely:
        covariance = _with_halves(problem, refined.transform, covariance)
    evidence, score = problem.clouds().judge(
        jax.tree.map(lambda leaf: leaf[None], refined.transform)
    )
    judged = jax.tree.map(lambda leaf: float(leaf[0]), evidence)
    cause = cause or verdict.in_a_volume(
        judged, source.fine.examined, problem.reference.fine.examined
    )
    others = found.others
    if judged.same > _SOME_SAME and not found.given and problem.motions is None:
        points = source.points * (source.radius / length)
        others = candidates.with_half_turns(problem.clouds(), points, refined.transform, others)
        others = tuple(pair for pair in others if _is_allowed(problem, pair[0]))
    # Nothing tells these from the pose, so their odds are its own.
    rivals = tuple((one, float(score[0])) for one in as_good if _is_allowed(problem, one))
    if rivals:
        others = candidates.distinct_from(refined.transform, (*others, *rivals))
    likelihood = chances(np.array([score[0], *(s for _, s in others)]))
    if closely and (as_likely := _as_likely(problem, refined.transform, others, likelihood)):
        raised = ((other, float(score[0])) for other in as_likely)
        others = candidates.distinct_from(refined.transform, (*others, *raised))
        likelihood = chances(np.array([score[0], *(s for _, s in others)]))
    free = tuple(
        direction._replace(point=where.reference_centre + length * direction.point)
        for direction in hardly_held
    )
    chance = 0.0 if cause or verdict.is_free(judged, free) else float(likelihood[0])
    likely = verdict.is_success(chance, likelihood[1:], refined.converged)
    loose = verdict.held_loosely(covariance) if likely else ""
    success, reason = likely and not loose, ""
    if not success:
        rivals = float(likelihood[1:].sum())
        cause = cause or _contradiction(problem, refined.transform)
        reason = cause or loose or _reason(problem, refined, judged, free, rivals)
    return assembled(
        (source, problem.reference),
        in_unit(refined.transform, length),
        Verdict(success, chance, reason, judged),
        Accuracy(covariance, free, refined.converged),
        distance=problem.distance * length,
        overlap=_overlap(problem, refined.transform),
        alternatives=tuple(
            Alternative(frame.transform_out(where, other), float(likely))
            for (other, _), likely in zip(others, likelihood[1:], strict=True)
            if likely >= LISTED
        ),
        notes=closing.notes,
    )


def _is_allowed(problem: Problem, pose: RigidTransform) -> bool:
    """Whether a pose turns by no more than is known of the pair."""
    turned = rotation_angle_deg(pose.rotation, np.eye(3))
    return bool(turned <= problem.known.max_rotation_deg + _ROUNDING_DEG)


def _along_weak(
    problem: Problem,
    pose: RigidTransform,
    hardly_held: tuple[WeakDirection, ...],
    settled: stable.Settled | None,
) -> tuple[stable.Settled | None, tuple[RigidTransform, ...]]:
    """A better pose along weak directions settled, else what was; the poses that fit as well."""
    if not hardly_held or problem.config.refine is None or problem.known.weights is not None:
        return settled, ()
    source, reference, length = problem.source, problem.reference, float(problem.where.length)
    reach = problem.reach() * length
    directions = tuple(one._replace(point=length * one.point) for one in hardly_held)
    found = weak.elsewhere(
        source, reference, in_unit(pose, length), directions, reach, problem.known
    )
    if found.better is not None:
        settled = stable.settled(source, reference, found.better, reach, known=problem.known)
    return settled, tuple(in_unit(other, 1 / length) for other in found.as_good)


def _as_likely(
    problem: Problem,
    pose: RigidTransform,
    others: tuple[tuple[RigidTransform, float], ...],
    likelihood: Float[np.ndarray, "k"],
) -> tuple[RigidTransform, ...]:
    """The likelier ones of the other poses, where many points speak for them as much as for the pose.

    Of two places one period apart the judge prefers one for what lies where the scans end.
    """
    if likelihood[0] < verdict.TRUSTED or problem.config.refine is None:
        return ()
    close = (likelihood[1:] >= _CLOSE) & (likelihood[1:] < verdict.RIVAL)
    length, reach = float(problem.where.length), problem.reach()
    rivals = tuple(in_unit(others[i][0], length) for i in np.flatnonzero(close))
    if not rivals:
        return ()
    clouds = problem.source, problem.reference
    found = weak.elsewhere(
        *clouds, in_unit(pose, length), (), reach * length, problem.known, rivals
    )
    better = () if found.better is None else (found.better,)
    return tuple(in_unit(other, 1 / length) for other in (*better, *found.as_good))


def _with_halves(
    problem: Problem, pose: RigidTransform, covariance: Float[np.ndarray, "6 6"]
) -> Float[np.ndarray, "6 6"]:
    """The covariance of a pose, wider where halves of the overlap differ by more than it says."""
    config, motions = problem.config, problem.motions
    if config.refine is None or not config.halves or not np.isfinite(covariance).all():
        return covariance
    source, reference, *_ = problem.clouds()
    found = halves.differences(source, reference, pose, distance=problem.reach(), motions=motions)
    units = np.repeat([1.0, float(problem.where.length)], 3)
    units = np.outer(units, units)
    if not (units > 0).all() or not np.isfinite(units).all():
        return covariance  # The unit is so odd that no variance in it is a number.
    free = 6 if motions is None else motions.shape[1]
    return halves.widened(covariance / units, found, free) * units


def _reason(
    problem: Problem,
    refined: Refined,
    judged: Evidence,
    free: tuple[WeakDirection, ...],
    rivals: float,
) -> str:
    """Why the pose is not trusted, and whether the clouds seem to be in different units."""
    source, reference = (c.points * c.radius for c in (problem.source, problem.reference))
    units = diagnosis.compared(source, reference, least=3.0)
    moving = f"The pose was still moving after {refined.iterations} iterations of the refinement."
    return " ".join(
        [
            moving if refined.converged is False else verdict.reason(judged, free, rivals),
            *(f"{told[:1].upper()}{told[1:]}." for told in units),
        ]
    )


def _contradiction(problem: Problem, pose: RigidTransform) -> str:
    """A sentence if free space speaks against the pose."""
    poses = jax.tree.map(lambda leaf: leaf[None], pose)
    return free_space.contradiction(float(problem.free_space().share_in_front(poses)[0]))


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
