"""The poses of all scans refined together on their surfaces: generalised ICP of many views.

Pairs that were registered one by one disagree a little, and a pose graph spreads what they disagree by
without looking at the scans again. Here every pair of overlapping scans pulls at both of its poses at
once (Pulli, 1999; the cost of a pair is that of generalised ICP, Segal et al., 2009).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxreg.geometry import se3
from jaxreg.graph.pose_graph import EdgeEquations, PoseGraph, retract
from jaxreg.graph.sparse import gauss_newton_steps
from jaxreg.refine.kdtree import IndexedCloud
from jaxreg.scans.placing import Placement
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.relation import Relation
from jaxreg.types import RigidTransform

_EPSILON = 0.01
"""Variance across a surface, in units of that along it."""
_WIDTHS = np.geomspace(8.0, 1.0, 6)
"""How many times wider than the noise the kernel is, iteration by iteration."""
_NARROW = 3.0
"""The last width of the kernel, in standard deviations of the residuals."""
_PASSES = (1.0, 0.5)
"""The largest distance of corresponding points in each pass, in reaches of a pair."""
_PULLING = 1000
"""About so many points of a scan pull at each of its pairs; as many others tell whether it helped."""


class JointRefinement(NamedTuple):
    """One pass: corresponding points up to `distance` reaches apart, and what it gained.

    `before` and `after` are the mean distance between surfaces (unit of the input; points farther off
    than half the reach count as that) at points that did not take part. `kept`: it was lower.
    """

    distance: float
    before: float
    after: float
    kept: bool


class _View(NamedTuple):
    """Two scans (numbers), the clouds of both, and within what distance their points correspond."""

    source: int
    reference: int
    clouds: tuple[IndexedCloud, IndexedCloud]
    scales: tuple[float, float]
    reach: float


def refine_jointly(
    placement: Placement, relations: list[Relation], prepared: list[Prepared]
) -> tuple[Placement, tuple[JointRefinement, ...]]:
    """The placement with poses refined on all used pairs; a pass that does not help is undone."""
    used = [r for r, is_used in zip(relations, placement.used, strict=True) if is_used]
    unit = float(np.median([cloud.radius for cloud in prepared]))
    views = [_view(relation, prepared, unit) for relation in used]
    centres = np.array([cloud.centre for cloud in prepared])
    alone = placement.group < 0
    poses = RigidTransform(
        np.where(alone[:, None, None], np.eye(3), placement.poses.rotation),
        np.where(alone[:, None], 0, _centred(placement.poses, centres) / unit),
    )
    fixed = alone.copy()
    fixed[[members[0] for members in placement.members()]] = True
    steps, before = [], _distance(views, poses)
    for distance in _PASSES:
        new = _refined(views, poses, fixed, distance)
        after = _distance(views, new)
        steps.append(JointRefinement(distance, before * unit, after * unit, after < before))
        if after < before:
            poses, before = new, after
    shift = poses.translation * unit - se3.applied(poses.rotation, centres)
    # What is fixed keeps its pose to the last bit.
    moved = RigidTransform(
        np.where(fixed[:, None, None], placement.poses.rotation, poses.rotation),
        np.where(fixed[:, None], placement.poses.translation, shift),
    )
    return placement._replace(poses=moved), tuple(steps)


def _centred(poses: RigidTransform, centres: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Where the centres of the scans lie."""
    return se3.applied(poses.rotation, centres) + poses.translation


def _view(relation: Relation, prepared: list[Prepared], unit: float) -> _View:
    ends = prepared[relation.source], prepared[relation.reference]
    return _View(
        relation.source,
        relation.reference,
        (ends[0].fine.index, ends[1].fine.index),
        (ends[0].radius / unit, ends[1].radius / unit),
        relation.max_correspondence_distance / unit,
    )


def _refined(
    views: list[_View], poses: RigidTransform, fixed: Bool[np.ndarray, "n"], distance: float
) -> RigidTransform:
    first, second = (
        np.array([getattr(v, name) for v in views]) for name in ("source", "reference")
    )
    none = RigidTransform(np.empty((0, 3, 3)), np.empty((0, 3)))
    graph = PoseGraph(first, second, none, np.empty((0, 6, 6)), np.ones(len(views), bool))
    for width in _WIDTHS:
        parts = [_equations(view, poses, distance * view.reach, float(width)) for view in views]
        source, reference, coupling, slopes, other = (
            np.stack(part) for part in zip(*parts, strict=True)
        )
        equations = EdgeEquations((slopes, other), (source, reference), coupling)
        poses = retract(poses, gauss_newton_steps(graph, fixed, equations, 1e-6))
    return poses


def _equations(view: _View, poses: RigidTransform, within: float, width: float):
    """Blocks of the normal equations of a pair, with its points paired both ways."""
    there = _between(poses, view.reference, view.source)
    (x, y), (a, b) = view.clouds, view.scales
    one = _one_way(x, y, a, b, there, within, width)
    back = _one_way(y, x, b, a, se3.inverted(there), within, width)
    return (
        one[0] + back[1], one[1] + back[0], one[2] + back[2].T, one[3] + back[4], one[4] + back[3]
    )  # fmt: skip


def _one_way(moving, still, moving_scale, still_scale, pose: RigidTransform, within, width):
    """The same of pairs (moving point, nearest point of the other), in the frame of the other.

    ``r = T x - y``, with ``T exp(delta_x)`` and ``exp(-delta_y) T``.
    """
    stride = _stride(moving)
    x = moving.points[::stride] * moving_scale
    moved = x @ pose.rotation.T + pose.translation
    distance, index = still._replace(scale=still_scale).nearest(moved, within=within)
    near = np.isfinite(distance)
    x, moved, index = x[near], moved[near], index[near]
    residual = moved - still.points[index] * still_scale
    turned = moving.host_normals[::stride][near] @ pose.rotation.T
    metric = _metric(turned, still.host_normals[index])
    force = se3.applied(metric, residual)
    squared = np.sum(residual * force, axis=1)
    noise = max(np.median(squared) / 0.455, 1e-16) if len(squared) else 1.0
    kernel = (_NARROW * width) ** 2 * noise
    weight = (kernel / (kernel + squared)) ** 2  # Geman-McClure
    by_moving = np.concatenate(
        [-pose.rotation @ se3.skew(x), np.broadcast_to(pose.rotation, (len(x), 3, 3))], axis=2
    )
    by_still = np.concatenate(
        [se3.skew(moved), np.broadcast_to(-np.eye(3), (len(x), 3, 3))], axis=2
    )
    weighted = (weight / noise)[:, None, None] * metric
    flat = lambda m: m.reshape(-1, 6)  # noqa: E731
    left, right = weighted @ by_moving, weighted @ by_still
    force = (weight / noise)[:, None] * force
    return (
        flat(by_moving).T @ flat(left),
        flat(by_still).T @ flat(right),
        flat(by_still).T @ flat(left),
        flat(by_moving).T @ force.ravel(),
        flat(by_still).T @ force.ravel(),
    )


def _stride(cloud: IndexedCloud) -> int:
    """Every so many points pull; two at least, so that some are left."""
    return max(2, len(cloud.points) // _PULLING)


def _metric(one: Float[np.ndarray, "p 3"], other: Float[np.ndarray, "p 3"]) -> np.ndarray:
    """``2 e (C_x + C_y)^-1`` of planes with these normals, ``C = I - (1 - e) n n^T``; by Woodbury."""
    e = _EPSILON
    cosine = np.sum(one * other, axis=1)
    # (2 I - a (n n^T + m m^T))^-1 = I / 2 + N (2 I / a - N^T N)^-1 N^T / 2, with N = [n m].
    a = 2 / (1 - e) - 1
    determinant = a * a - cosine * cosine
    outer = one[:, :, None] * one[:, None] + other[:, :, None] * other[:, None]
    mixed = one[:, :, None] * other[:, None]
    mixed = mixed + mixed.swapaxes(1, 2)
    inner = (a * outer + cosine[:, None, None] * mixed) / determinant[:, None, None]
    return e * (np.eye(3) + inner)


def _between(poses: RigidTransform, reference: int, source: int) -> RigidTransform:
    ends = (RigidTransform(*(part[k] for part in poses)) for k in (reference, source))
    return se3.between(*ends)


def _distance(views: list[_View], poses: RigidTransform) -> float:
    """The mean distance of the points that did not take part from the other's planes, both ways."""
    found = []
    for view in views:
        there = _between(poses, view.reference, view.source)
        (x, y), (a, b) = view.clouds, view.scales
        found += [_off(x, y, a, b, there, view.reach)]
        found += [_off(y, x, b, a, se3.inverted(there), view.reach)]
    return float(np.concatenate(found).mean())


def _off(moving, still, moving_scale, still_scale, pose, reach) -> np.ndarray:
    stride = _stride(moving)
    others = moving.points[stride // 2 :: stride] * moving_scale
    moved = others @ pose.rotation.T + pose.translation
    distance, index = still._replace(scale=still_scale).nearest(moved, within=reach)
    near = np.isfinite(distance)
    residual = moved[near] - still.points[index[near]] * still_scale
    off = np.full(len(moved), reach / 2)
    off[near] = np.abs(np.sum(residual * still.host_normals[index[near]], axis=1))
    return np.minimum(off, reach / 2)
