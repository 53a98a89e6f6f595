"""Two scans in the plane: contours, floor plans, the lines of a 2-D lidar. Three unknowns.

Points (n, 2), or with one z each, have lines for surfaces and normals in the plane. The pose is
sought among all turns and shifts (`jaxreg.scans.correlation`), refined on the distances from these
lines, and judged by the same evidence as that of surfaces, read along the lines.
"""

import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxreg.geometry import clouds as checks
from jaxreg.geometry import trees
from jaxreg.judge.evidence import REACH, Evidence
from jaxreg.judge.odds import chances as chances_of
from jaxreg.judge.surface import Examined
from jaxreg.refine.uncertainty import PoseUncertainty, WeakDirection, weak_directions
from jaxreg.scans import candidates, correlation, dense, diagnosis, planes, prepare, verdict
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.free_space import Sides, contradiction
from jaxreg.scans.known import UP, Known, turns_about
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.result import (
    LISTED,
    Accuracy,
    Alternative,
    ScanRegistration,
    Verdict,
    assembled,
    centred,
    in_unit,
    out_of,
)
from jaxreg.types import RigidTransform

MOTIONS = np.eye(6)[:, [2, 3, 4]]
"""The unknown ones: the turn in the plane and two shifts."""
_FEWEST = 20
_JUDGED = 512
"""Points that the evidence is read at: a line of so many has about the spacing, beside its length, that
a surface of some thousands has."""
_PLACES = 16
"""Placements that are refined and judged."""
_NEIGHBORS = 8
"""Points of a piece of a line."""
_SAMPLE = 700
"""Points that a placement is refined with."""
_NARROWING, _STEADY = 10, 6
"""Iterations while the kernel narrows, and at the end."""
_START = 0.15
"""How far off points may lie under a pose that is given, in radii."""
_COMPARED, _SUSPECT = 0.5, 0.05
"""If so many points lie beside the other line and so many of these off it, one asks why."""
_OTHER, _MOSTLY_OFF = 0.12, 0.3
"""Another shape or place, if so many are off, of nearly all points and of fewer. Plans, lidar and
leaves under the right pose have at most 0.02, a coast of which a third is missing 0.12."""
_STILL = 1e-4
"""A pose stands still if the last step turns by less (radians) and moves by less (radii)."""
_ENDS = 2.0
"""Where the neighbours of a point lie so much to one side that twice their mean offset is their
mean distance, the line ends."""
_ALIKE, _RAREST = 0.95, 0.02
"""As in `jaxreg.judge.surface`."""


class Line(NamedTuple):
    """A cloud in the plane, around its centre in units of its radius, at two densities, indexed."""

    points: Float[np.ndarray, "n 3"]
    surface: planes.Surface
    normals: Float[np.ndarray, "n 3"]
    judged: Float[np.ndarray, "j 3"]
    judged_tree: trees.Tree
    examined: Examined
    noise: float


def is_planar(source: Prepared, reference: Prepared) -> bool:
    """Whether all points of each cloud have one z, and there are enough to make lines."""
    return all(len(cloud.points) >= _FEWEST and cloud.flat for cloud in (source, reference))


def registered(
    source: Prepared,
    reference: Prepared,
    config: RegisterConfig,
    start: RigidTransform | None,
    known: Known,
) -> ScanRegistration:
    """The registration of two clouds in the plane; `start` is a pose of the clouds as given."""
    clouds = source, reference
    x, y = (_line(cloud) for cloud in clouds)
    ratio = source.radius / reference.radius  # from here on in radii of the reference
    if start is None:
        fits = _searched(x, y, ratio, config, known)
    else:
        inner = known.allowed(centred(clouds, start))
        fits = [_refined(x, y, ratio, in_unit(inner, 1 / reference.radius), _START, config)]
    poses = _stacked([fit.pose for fit in fits])
    evidence, score = _judged(x, y, ratio, poses)
    free_space = Sides(
        (source.view, reference.view), (source.coarse.points, reference.coarse.points), (ratio, 1.0)
    )
    ranked = candidates.ranked(poses, evidence, score + free_space.log_odds(poses))
    turned = np.abs(np.arctan2(ranked.poses.rotation[:, 1, 0], ranked.poses.rotation[:, 0, 0]))
    best = int(np.argmax(ranked.score - candidates.TURN_COST * turned / np.pi))
    order = [best, *(i for i in range(len(ranked.score)) if i != best)]
    pose, *others = (
        RigidTransform(ranked.poses.rotation[i], ranked.poses.translation[i]) for i in order
    )
    chances = chances_of(ranked.score[order])
    judged = jax.tree.map(lambda leaf: float(leaf[best]), ranked.evidence)
    weights = known.weights
    if weights is not None:
        weights = weights[trees.nearest(source.tree, source.fine.points)[1]]
    fit = _closed(x, y, ratio, pose, config, weights)
    accuracy = _accuracy(fit, reference, config)
    cause = ""
    if config.refine is not None and weights is None:
        cause = _cause(source, x, y, ratio, fit, config, known)
    chance = 0.0 if cause or accuracy.weak_directions else float(chances[0])
    rivals = chances[1:]
    success = verdict.is_success(chance, rivals, accuracy.converged)
    reason = ""
    if not success:
        in_front = float(free_space.share_in_front(_stacked([fit.pose]))[0])
        sizes = source.points * source.radius, reference.points * reference.radius
        units = (f"{told[:1].upper()}{told[1:]}." for told in diagnosis.compared(*sizes))
        cause = cause or _reason(judged, accuracy, float(rivals.sum()), in_front)
        reason = " ".join([cause, *units])
    spacing = max(
        float(x.examined.spacing) * source.radius, float(y.examined.spacing) * reference.radius
    )
    distance = config.inlier_spacings * spacing
    return assembled(
        clouds,
        in_unit(fit.pose, reference.radius),
        Verdict(success, chance, reason, judged),
        accuracy,
        distance=distance,
        overlap=_overlap(x, y, ratio, fit.pose, distance / reference.radius),
        alternatives=tuple(
            Alternative(out_of(clouds, in_unit(other, reference.radius)), float(likely))
            for other, likely in zip(others, rivals, strict=True)
            if likely >= LISTED
        ),
    )


def _line(cloud: Prepared) -> Line:
    points = cloud.fine.points * [1, 1, 0]
    tree = trees.Tree(points)
    surface = planes.Surface(points, tree, count=_NEIGHBORS, flat=True)
    normals = cloud.fine.normals
    normals = surface.next_to(points).normal if normals is None else normals
    judged = prepare.reduce_to(points, _JUDGED)
    noise = planes.patches(points, tree, judged, count=_NEIGHBORS, flat=True).noise
    judged_tree = trees.Tree(judged)
    examined = _examined(judged, judged_tree, cloud)
    return Line(points, surface, normals, judged, judged_tree, examined, float(np.median(noise)))


def _examined(points: Float[np.ndarray, "j 3"], tree: trees.Tree, cloud: Prepared) -> Examined:
    """A line as the judge sees a surface: padded, with normals, corners, rare directions and ends."""
    count = min(_NEIGHBORS, len(points) - 1)
    distance, index = trees.neighbors(tree, points, count + 1)
    spread = points[index] - points[index].mean(axis=1, keepdims=True)
    moment = np.einsum("nki,nkj->nij", spread, spread)[:, :2, :2]
    variance, axes = np.linalg.eigh(moment)
    normals = np.concatenate([axes[:, :, 0], np.zeros((len(points), 1))], axis=1)
    if cloud.normals is not None:
        normals = cloud.normals[trees.nearest(cloud.tree, points)[1]]
    alike = np.mean(np.abs(normals @ normals.T) > _ALIKE, axis=1)
    aside = np.linalg.norm(points[index[:, 1:]].mean(axis=1) - points, axis=1)
    size = checks.padded_size(len(points), smallest=512)
    pad = lambda values: np.pad(  # noqa: E731
        values.astype(np.float32), [(0, size - len(points))] + [(0, 0)] * (values.ndim - 1)
    )
    parts = (
        pad(points),
        pad(normals),
        pad(variance[:, 0] / np.maximum(variance.sum(axis=1), 1e-300)),
        pad(1 / np.maximum(alike, _RAREST)),
        pad(np.maximum(0, 1 - _ENDS * aside / np.maximum(distance[:, 1:].mean(axis=1), 1e-300))),
        np.arange(size) < len(points),
        np.float32(np.median(distance[:, min(2, count)])),
    )
    return Examined(*jax.device_put(parts))


def _searched(
    x: Line, y: Line, ratio: float, config: RegisterConfig, known: Known
) -> list[planes.Fitted]:
    outlines = (
        correlation.Outline(line.points[:, :2] * scale, line.normals[:, :2])
        for line, scale in ((x, ratio), (y, 1.0))
    )
    found = correlation.placed(
        *outlines, most=_PLACES, max_turn=math.radians(known.max_rotation_deg)
    )
    shifts = np.concatenate([found.shift, np.zeros((len(found.turn), 1))], axis=1)
    return [
        _refined(x, y, ratio, RigidTransform(rotation, shift), 4 * found.cell, config)
        for rotation, shift in zip(turns_about(UP, found.turn), shifts, strict=True)
    ]


def _refined(
    x: Line, y: Line, ratio: float, pose: RigidTransform, reach: float, config: RegisterConfig
) -> planes.Fitted:
    """A pose refined with some of the points, with a kernel that narrows from `reach`."""
    some = x.points[:: -(-len(x.points) // _SAMPLE)] * ratio
    widths = np.geomspace(reach, max(planes.TUKEY * _noise(x, y, ratio), reach / 30), _NARROWING)
    return _fitted(some, y, pose, widths if config.refine else np.zeros(0))


def _closed(
    x: Line,
    y: Line,
    ratio: float,
    pose: RigidTransform,
    config: RegisterConfig,
    weights: Float[np.ndarray, "n"] | None,
) -> planes.Fitted:
    """The chosen pose, refined with all points of the line as much as they count."""
    width = planes.TUKEY * max(_noise(x, y, ratio), 1e-6)
    widths = np.zeros(0) if config.refine is None else np.full(_STEADY, width)
    return _fitted(x.points * ratio, y, pose, widths, weights)


def _fitted(
    points: np.ndarray,
    y: Line,
    pose: RigidTransform,
    widths: np.ndarray,
    weights: Float[np.ndarray, "n"] | None = None,
) -> planes.Fitted:
    return planes.fitted(points, y.surface, pose, widths, motions=MOTIONS, weights=weights)


def _noise(x: Line, y: Line, ratio: float) -> float:
    return math.hypot(x.noise * ratio, y.noise)


def _judged(
    x: Line, y: Line, ratio: float, poses: RigidTransform
) -> tuple[Evidence, Float[np.ndarray, "k"]]:
    """The evidence for every pose and its log odds, with what holds a pose in the plane."""
    sides = (x, ratio), (y, 1.0)
    reach = 1.0001 * REACH * max(float(line.examined.spacing) * scale for line, scale in sides)
    moved = ratio * x.judged @ np.swapaxes(poses.rotation, 1, 2) + poses.translation[:, None]
    back = (y.judged - poses.translation[:, None]) @ poses.rotation / ratio
    off, there = trees.nearest(y.judged_tree, moved, within=reach)
    here = trees.nearest(x.judged_tree, back, within=reach / ratio)[1]
    evidence = candidates.read(
        poses, (x.examined, y.examined), (ratio, 1.0),
        np.minimum(there, len(y.judged) - 1), np.minimum(here, len(x.judged) - 1),
    )  # fmt: skip
    near = off < reach / 2
    normals = np.asarray(y.examined.normals)
    held = [
        _held(m, normals[t], n)
        for m, t, n in zip(moved, np.minimum(there, len(y.judged) - 1), near, strict=True)
    ]
    sparse = max(0.0, 1 - 2 * min(len(x.judged), len(y.judged)) / _JUDGED)
    evidence = evidence._replace(held=np.array(held), sparse=np.full(len(held), sparse))
    return evidence, candidates.odds(evidence)


def _held(points: np.ndarray, normals: np.ndarray, near: np.ndarray) -> float:
    """`Evidence.held` of three unknowns: 4/15 for lines that face all directions everywhere."""
    at, across = points[near], np.asarray(normals, np.float64)[near]
    if len(at) < 3:
        return 0.0
    at = at - at.mean(axis=0)
    radius = np.sqrt(np.mean(np.sum(at**2, axis=1))) + 1e-12
    rows = np.column_stack([np.cross(at / radius, across)[:, 2], across[:, :2]])
    values = np.linalg.eigvalsh(rows.T @ rows / len(at))
    return 8 / 15 * 3 / float(np.sum(1 / (np.maximum(values, 0) + 1e-6))) - 1e-7


def _cause(
    source: Prepared,
    x: Line,
    y: Line,
    ratio: float,
    fit: planes.Fitted,
    config: RegisterConfig,
    known: Known,
) -> str:
    """A sentence where many points lie off the other line: another size, a mirror image, or a doubt."""
    width = float(np.median(y.surface.next_to(y.points).width))
    noise = max(_noise(x, y, ratio), planes.FLOOR * width, 1e-12)
    now = _agreement(fit, noise)
    if now.compared < _COMPARED or (now.off < _SUSPECT and not now.drawn):
        return ""
    widths = np.geomspace(_START, planes.TUKEY * max(_noise(x, y, ratio), 1e-6), _NARROWING)
    sized = planes.fitted(x.points * ratio, y.surface, fit.pose, widths, motions=MOTIONS, scale=1.0)
    if told := dense.size_text(sized.scale, now, _agreement(sized, noise)):
        return told
    twin = _line(prepare.mirrored(source, config))
    for other in _searched(twin, y, ratio, config, known):
        closed = _closed(twin, y, ratio, other.pose, config, None)
        if _agreement(closed, noise).explains(now):
            return dense.MIRRORED
    if now.off < (_OTHER if now.comparable else _MOSTLY_OFF):
        return ""
    return (
        f"{now.off:.0%} of the points lie beside the other line and off it by more than "
        f"{dense.OFF:.0f} times the noise: it is another shape, or another place."
    )


def _agreement(fit: planes.Fitted, noise: float) -> dense.Agreement:
    """How many of the points of a line lie beside the other, and how many of them off it."""
    off = np.abs(fit.off[fit.over])
    if not len(off):
        return dense.Agreement(0.0, 0.0, 0.0)
    share = float(np.mean(off > dense.OFF * noise))
    return dense.Agreement(float(fit.over.mean()), share, float(np.median(off)) / noise)


def _accuracy(fit: planes.Fitted, reference: Prepared, config: RegisterConfig) -> Accuracy:
    """Covariance of the three unknowns (all else is known: 0), and what the lines leave free."""
    if config.refine is None:
        return Accuracy(np.full((6, 6), np.nan), (), None)
    units = np.repeat([1.0, reference.radius], 3)
    weak = tuple(
        one._replace(point=reference.centre + reference.radius * one.point) for one in _weak(fit)
    )
    return Accuracy(fit.covariance[:6, :6] * np.outer(units, units), weak, fit.last_step < _STILL)


def _weak(fit: planes.Fitted) -> tuple[WeakDirection, ...]:
    # What is known counts as held by every point.
    information = fit.information + np.diag([1.0, 1, 0, 0, 0, 1]) * fit.weight
    uncertainty = PoseUncertainty(
        information, np.zeros((6, 6)), np.zeros(()), np.array(fit.weight), np.zeros(3), np.ones(())
    )
    return weak_directions(uncertainty)


def _overlap(x: Line, y: Line, ratio: float, pose: RigidTransform, within: float) -> float:
    moved = ratio * x.judged @ pose.rotation.T + pose.translation
    back = (y.judged - pose.translation) @ pose.rotation / ratio
    there, here = (
        trees.nearest(y.judged_tree, moved)[0],
        ratio * trees.nearest(x.judged_tree, back)[0],
    )
    return float(np.mean(np.concatenate([there, here]) < within))


def _reason(judged: Evidence, accuracy: Accuracy, rivals: float, in_front: float) -> str:
    if accuracy.weak_directions:
        names = ", ".join(direction.name for direction in accuracy.weak_directions)
        return f"The lines leave the pose free: {names}."
    if accuracy.converged is False:
        return "The pose was still moving at the end of the refinement."
    return contradiction(in_front) or verdict.reason(judged, (), rivals)


def _stacked(poses: list[RigidTransform]) -> RigidTransform:
    return RigidTransform(*(np.stack(parts) for parts in zip(*poses, strict=True)))
