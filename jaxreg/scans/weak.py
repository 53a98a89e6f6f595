"""Other poses along the motions that a pair hardly resists: better ones, and ones as good.

A tunnel with one niche, a road with three poles and a body that is nearly round hold some motion by
few of their points. A refinement ends there before it is where these agree, and the few points that
a pose is judged with may show none of them. So the pose is moved along such motions, fitted to the
surface again, and compared with what it was on many points. Where nothing tells the two apart, as on
every body of revolution, both are right as far as anyone can see.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxreg.refine.uncertainty import WeakDirection
from jaxreg.scans import planes, stable
from jaxreg.scans.candidates import are_apart
from jaxreg.scans.known import Known
from jaxreg.scans.prepare import Prepared
from jaxreg.types import RigidTransform

_FITTED, _COMPARED = 2000, 8000
"""Points of the source that a pose is fitted with, and that tell which pose is better."""
_MOVED = math.radians(15)
"""How far a pose is moved: a rotation by so much, or a translation by as many radii. A pose that comes
back from there is held after all; farther away another part of the surface would draw it."""
_WITHIN_LIMIT = 0.8
"""And no farther than this share of the largest rotation, or none would be within it."""
_MOST = 2
"""Directions that are tried, the weakest first: of a sphere all three give the same poses."""
_NARROWING = 8
_LIMITS = 3.0, 8.0
"""Distances in noise levels from which a point counts in full against a pose: the lower sees small
steps of the surface, the upper what few points far off say, which the noise of all others hides."""
_BETTER, _WORSE = 6.0, 3.0
"""Standard errors of the mean difference from which a pose is better, or worse."""


class Elsewhere(NamedTuple):
    """A pose that fits better than the one that was given, if any, and others that fit as well."""

    better: RigidTransform | None
    as_good: tuple[RigidTransform, ...]


def elsewhere(
    source: Prepared,
    reference: Prepared,
    pose: RigidTransform,
    weak: tuple[WeakDirection, ...],
    reach: float,
    known: Known,
    rivals: tuple[RigidTransform, ...] = (),
) -> Elsewhere:
    """What lies along the `weak` directions of a pose, on the points of the prepared clouds.

    The same is told of its `rivals`. Poses and directions are of the centred clouds in the unit of the
    input, in which points may lie `reach` off; what is `known` limits the motions and how far they go.
    """
    unit, motions = reference.radius, known.motions
    largest = min(_MOVED, _WITHIN_LIMIT * math.radians(known.max_rotation_deg))
    noise, _ = stable.noise(source, reference, _FITTED)
    widths = np.geomspace(max(reach / unit, planes.TUKEY * noise), planes.TUKEY * noise, _NARROWING)
    few, many = (
        source.points[source.rows(count)] * (source.radius / unit) for count in (_FITTED, _COMPARED)
    )
    start = RigidTransform(pose.rotation, pose.translation / unit)

    def fitted(at: RigidTransform) -> RigidTransform:
        return planes.fitted(few, reference.surface, at, widths, motions=motions).pose

    def against(at: RigidTransform) -> Float[np.ndarray, "2 p"]:
        moved = many @ at.rotation.T + at.translation
        return planes.misfit(moved, reference.surface, noise * np.array(_LIMITS))

    best, misfit, better = start, against(start), False
    again = fitted(start)
    its_own = against(again)
    if planes.errors_worse(its_own, misfit).min() < -_BETTER:
        best, misfit, better = again, its_own, True
    others = [RigidTransform(one.rotation, one.translation / unit) for one in rivals]
    others = [fitted(moved) for moved in (*others, *_moved(best, weak, unit, largest))]
    others = [(other, against(other)) for other in others if are_apart(other, best)]
    for other, its_own in others:
        errors = planes.errors_worse(its_own, misfit)
        if errors.min() < -_BETTER and errors.max() < _WORSE:
            best, misfit, better = other, its_own, True
    as_good = tuple(
        RigidTransform(other.rotation, unit * other.translation)
        for other, its_own in others
        if are_apart(other, best) and planes.errors_worse(its_own, misfit).max() < _WORSE
    )
    found = RigidTransform(best.rotation, unit * best.translation)
    return Elsewhere(found if better else None, as_good)


def _moved(
    pose: RigidTransform, weak: tuple[WeakDirection, ...], unit: float, largest: float
) -> list[RigidTransform]:
    """The pose moved both ways along each of the weakest directions, in so large a unit."""
    found = []
    for direction in weak[:_MOST]:
        for way in (largest, -largest):
            if direction.kind == "translation":
                shifted = pose.translation + way * direction.axis
                found.append(RigidTransform(pose.rotation, shifted))
            else:
                turn, pivot = planes.turn(way * direction.axis), direction.point / unit
                shifted = turn @ (pose.translation - pivot) + pivot
                found.append(RigidTransform(turn @ pose.rotation, shifted))
    return found
