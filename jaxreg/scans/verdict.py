"""Whether two clouds agree under a pose, and the calibrated probability that the pose is right."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxreg.refine.uncertainty import WeakDirection
from jaxreg.scans.prepare import Level, agreement
from jaxreg.types import RigidTransform

TRUSTED = 0.5
"""Probability from which a registration counts as a success."""
NO_RIVAL = 0.5
"""If no other distinct pose was found."""
NOT_SEARCHED = float("nan")
"""If no other pose was searched for: the verdict rests on the other evidence."""


class Evidence(NamedTuple):
    """What the verdict is computed from; numbers without unit.

    `overlap` is the share of the points of both clouds within reach of the other cloud, `smaller`
    that of the cloud with the smaller share. `gap` is the median distance of such points from the
    plane of their partner, and `facing` the mean cosine of the two normals, each compared to what
    neighbours within one cloud show: 1 and 0 when the clouds are samples of one surface.
    `constraint`: how much those distances change, in the mean square, under the unit motion that
    changes them least. `rival` is how much worse, in shares of the points, the best other pose
    agrees; NaN if none was searched for.
    """

    overlap: float
    smaller: float
    gap: float
    facing: float
    constraint: float
    rival: float


def evidence(
    pose: RigidTransform,
    source: tuple[Level, float],
    reference: tuple[Level, float],
    distance: float,
    *,
    rival: float,
) -> Evidence:
    """The evidence for one pose, from every point of both clouds, which have one density.

    Each cloud is a level and its scale in the frame of the pose; points within `distance` of the other
    cloud, in the frame, count as the same surface.
    """
    rotation, translation = pose
    x, y = (level.index._replace(scale=scale) for level, scale in (source, reference))
    x_normals, y_normals = x.host_normals @ rotation.T, y.host_normals
    fixed = y.points * y.scale
    moved = x.points @ (rotation.T * x.scale) + translation
    there, index = y.nearest(moved)
    back, other_index = x.nearest((fixed - translation) @ rotation)
    near, other_near = there < distance, back < distance
    partner, other = index[near], other_index[other_near]
    sides = (
        agreement(moved[near], fixed[partner], x_normals[near], y_normals[partner]),
        agreement(fixed[other_near], moved[other], y_normals[other_near], x_normals[other]),
    )
    own = [
        (scale * across, cosine)
        for level, scale in (source, reference)
        for across, cosine in [level.own_agreement]
    ]
    across, cosine = (np.concatenate(parts) for parts in zip(*sides, strict=True))
    own_across, own_cosine = (np.concatenate(parts) for parts in zip(*own, strict=True))
    return Evidence(
        overlap=float(np.mean(np.concatenate([near, other_near]))),
        smaller=float(min(near.mean(), other_near.mean())),
        gap=_median(across, distance) / max(_median(own_across, distance), 0.01 * distance),
        facing=float(np.mean(cosine) - np.mean(own_cosine)) if len(cosine) else -1.0,
        constraint=_constraint(moved[near], y_normals[partner]),
        rival=float(rival),
    )


def _median(values: np.ndarray, default: float) -> float:
    return float(np.median(values)) if len(values) else default


def _constraint(points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"]) -> float:
    """Smallest eigenvalue of the mean of ``J^T n n^T J`` about the points' centroid."""
    if len(points) < 6:
        return 0.0
    centred = points - points.mean(axis=0)
    radius = np.sqrt(np.mean(np.sum(centred**2, axis=1)))
    if radius == 0:
        return 0.0
    rows = np.concatenate([np.cross(centred / radius, normals), normals], axis=1)
    return float(np.linalg.eigvalsh(rows.T @ rows / len(rows))[0])


def probability(found: Evidence) -> float:
    """The chance that the pose is right: a logistic regression, whose constants' origin is below.

    0 if some motion changes nothing, as for two planes: then no pose is *the* right one.
    """
    if found.constraint < _LEAST_CONSTRAINT:
        return 0.0
    weights = _UNSEARCHED if np.isnan(found.rival) else _SEARCHED
    score = weights[0] + features(found) @ weights[1:]
    return float(1 / (1 + np.exp(-np.clip(score, -50, 50))))


def reason(found: Evidence, weak: tuple[WeakDirection, ...]) -> str:
    """Why a pose is not trusted: the evidence that falls shortest of a usual right pose."""
    if found.constraint < _LEAST_CONSTRAINT:
        free = ", ".join(direction.name for direction in weak) or "a motion"
        return f"The surfaces leave the pose free: {free}."
    weights = _UNSEARCHED if np.isnan(found.rival) else _SEARCHED
    short = weights[1:] * (features(found) - _USUAL[: len(weights) - 1])
    return (
        f"Only {found.overlap:.0%} of the points lie near the other cloud.",
        f"Only {found.smaller:.0%} of one of the clouds lies near the other.",
        f"The surfaces lie {found.gap:.1f} times as far apart as neighbouring points of one cloud.",
        "The surfaces face different ways where they lie near each other.",
        "The surfaces hardly resist a motion: "
        + (", ".join(d.name for d in weak) or "see sigma")
        + ".",
        "Another pose agrees about as well (see alternatives).",
    )[int(np.argmin(short))]


def features(found: Evidence) -> Float[np.ndarray, "k"]:
    """The inputs of the regression; quantities that span decades as their logarithm.

    Six, or five without a rival.
    """
    inputs = np.array(
        [
            found.overlap,
            found.smaller,
            np.log(max(found.gap, 0.1)),
            found.facing,
            np.log10(max(found.constraint, 1e-6)),
            np.log10(max(found.rival, 0) + 0.003),
        ]
    )
    return inputs[:-1] if np.isnan(found.rival) else inputs


_LEAST_CONSTRAINT = 1e-5
_USUAL = np.array([0.9, 0.85, 0.0, -0.05, -1.5, np.log10(0.15)])
"""The features of a usual right pose, which `reason` compares with."""
_SEARCHED = np.array([2.16, 1.21, 3.86, -2.89, 4.27, 2.06, 2.37])
_UNSEARCHED = np.array([1.43, 1.19, 4.33, -3.04, 6.65, 3.13])
"""Intercept and coefficients, with and without a rival.

Fitted by research/fit_verdict.py (2026-11-26) to 200 pairs of procedural shapes and 200 of
ModelNet40's training shapes: full, noisy and cropped samplings, unrelated shapes, ends of one shape.
Right poses called a failure on these pairs: 6, 4 and 22 %; no unrelated pair, but 11 % of the ends of
one shape (many are congruent, as those of a box are) are called a success. A new fit with the search
that settles close calls (`search.ranking.break_ties`) judged other pairs no better.
"""
