"""A few unordered points each, as targets, fiducials or stems of trees, some missing on each side.

They show no surface. The poses come from all triples (`jaxreg.scans.triples`); number of pairs and
residual are the evidence, and two poses that agree equally well are no success.
"""

import functools
import math

import numpy as np
from jaxtyping import Float

from jaxreg.geometry import se3
from jaxreg.judge.odds import chances as chances_of
from jaxreg.refine.uncertainty import WeakDirection
from jaxreg.scans import triples
from jaxreg.scans.dense import MIRRORED
from jaxreg.scans.known import Known
from jaxreg.scans.prepare import Prepared
from jaxreg.scans.result import (
    LISTED,
    Accuracy,
    Alternative,
    FewEvidence,
    ScanRegistration,
    Verdict,
    assembled,
    centred,
    in_unit,
    out_of,
)
from jaxreg.scans.triples import Solution
from jaxreg.types import RigidTransform

MOST = 60
"""Clouds of at most so many points are few; larger ones are surfaces."""
_TRUSTED, _RIVAL = 0.5, 0.1
"""The probability of a success, and that of all other poses which forbids one."""
_FREE = 0.1
"""Standard deviation of the rotation, in radians, from which the points leave it free."""
_REACH = 3.0
"""Points within so many residuals of another count as the same."""


def is_few(source: Prepared, reference: Prepared) -> bool:
    """Whether both clouds are a few points."""
    return max(len(source.points), len(reference.points)) <= MOST


def registered(
    source: Prepared, reference: Prepared, start: RigidTransform | None, known: Known
) -> ScanRegistration | None:
    """The registration of two clouds of a few points; None if no three pairs agree.

    `start` is a pose of the clouds that were given; only what is near it is considered then.
    """
    clouds = source, reference
    # Squares of lengths of any unit might not be finite.
    unit = max(source.radius, reference.radius)
    x, y = (cloud.points * (cloud.radius / unit) for cloud in clouds)
    if source.flat and reference.flat:
        known = known.in_the_plane()
    solved = functools.partial(
        triples.solutions, up=known.up, max_rotation_deg=known.max_rotation_deg,
        initial=None if start is None else in_unit(centred(clouds, start), 1 / unit),
    )  # fmt: skip
    found = solved(x, y)
    if not found or found[0].log_odds <= 0:
        return None
    best = found[0]
    mirrored = solved(x * [-1, 1, 1], y) if len(best.pairs) < min(len(x), len(y)) else []
    mirrored = bool(mirrored) and mirrored[0].log_odds > best.log_odds
    chances = chances_of(np.array([one.log_odds for one in found]))
    accuracy = _accuracy(x, best, known, reference.centre, unit)
    free = bool(accuracy.weak_directions)
    chance = 0.0 if free or mirrored else float(chances[0])
    alone = float(chances[1:].sum()) < _RIVAL
    success = chance >= _TRUSTED and alone
    evidence = FewEvidence(
        len(best.pairs), min(len(x), len(y)), unit * best.residual, best.log_chance / math.log(10)
    )
    reason = MIRRORED if mirrored else _reason(evidence, free, alone)
    distance = _REACH * max(best.residual, triples.EXACT * float(np.ptp(y, axis=0).max()))
    moved = x @ best.pose.rotation.T + best.pose.translation
    shared = 2 * np.sum(np.linalg.norm(moved[:, None] - y, axis=2).min(axis=1) <= distance)
    return assembled(
        clouds,
        in_unit(best.pose, unit),
        Verdict(success, chance, "" if success else reason, evidence),
        accuracy,
        distance=unit * distance,
        overlap=float(min(shared / (len(x) + len(y)), 1.0)),
        alternatives=tuple(
            Alternative(out_of(clouds, in_unit(one.pose, unit)), float(likely))
            for one, likely in zip(found[1:], chances[1:], strict=True)
            if likely >= LISTED
        ),
    )


def _accuracy(
    x: Float[np.ndarray, "n 3"],
    found: Solution,
    known: Known,
    origin: Float[np.ndarray, "3"],
    unit: float,
) -> Accuracy:
    """Covariance from the residuals of the pairs, ``s^2 (sum_i J_i^T J_i)^-1``, about the reference."""
    at = x[found.pairs[:, 0]] @ found.pose.rotation.T + found.pose.translation
    basis = known.motions
    jacobian = np.stack([np.hstack([-se3.skew(p), np.eye(3)]) @ basis for p in at])
    information = np.einsum("pij,pik->jk", jacobian, jacobian)
    # Of each of the three coordinates of a pair, what is left once the pose has been fitted.
    left = max(3 * len(at) - basis.shape[1], 1)
    variance = max(found.squares / left, (triples.EXACT * np.ptp(at)) ** 2 / 9)
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 1e-12 * values[-1])
    covariance = basis @ (vectors / values * variance) @ vectors.T @ basis.T
    units = np.repeat([1.0, unit], 3)
    weak = _free(at * unit, covariance, origin)
    return Accuracy(covariance * np.outer(units, units), weak, True)


def _free(at: np.ndarray, covariance: np.ndarray, origin: np.ndarray) -> tuple[WeakDirection, ...]:
    """The turn that points on a line leave free."""
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    if variances[-1] < _FREE**2:
        return ()
    axis = axes[:, -1] * np.sign(axes[np.argmax(np.abs(axes[:, -1])), -1])
    return (WeakDirection("rotation", axis, origin + at.mean(axis=0), 0.0),)


def _reason(found: FewEvidence, free: bool, alone: bool) -> str:
    if free:
        return "The points that agree lie on a line: the turn about it is free."
    if not alone:
        return "Another pose agrees about as well (see alternatives)."
    agree = f"{found.matched} of {found.of} points agree within {found.residual:.3g}"
    return f"{agree}: so many may by chance."
