"""The part that stayed decides: where a share of the points moved, the last stage leaves it out.

After a landslide, or with some trees felled, most of two scans agrees to the noise and the rest lies
off by less than the spacing of the few points that a pose is refined with. There a robust kernel is
wider than the change, and the pose is drawn along. With many points the kernel can be as narrow as
the noise.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxreg.geometry import trees
from jaxreg.scans import planes
from jaxreg.scans.known import Known
from jaxreg.scans.prepare import Prepared
from jaxreg.types import RigidTransform

_FIRST, _SECOND = 4000, 24_000
"""Points of the source while the kernel narrows, and at the end."""
_NARROWING, _STEADY, _ROUNDS = 16, 4, 3
"""Iterations while it narrows, at the end, and how often the latter are made."""
_NEIGHBORS = 6
"""Points of a patch at the end: where the surface is curved, a smaller patch is nearer to it."""
_INNER = 3.0
"""Where Tukey's kernel ends at last, in standard deviations of the noise."""
_AROUND = 16
"""Points around a point that tell whether the surface moved there."""
_STAYED, _MOVED = 1.25, 2.0
"""Where their median distance is so many times that of the noise, it did not, or it did."""
_GAIN = 1.05
"""A pose is taken if so many times as many points agree with it: lie within half a noise level. Within
one or three a pose that was drawn along a little agrees about as well as the right one."""
_MORE = 1.2
"""And the pose of a half, if so many times as many points are within the noise as under that of all."""
_MAJORITY = 0.6
"""A pose that rests on a smaller share than this is no success: what moved, and what stayed?"""
_LEAST = 1e-9


class Settled(NamedTuple):
    """A pose of the centred clouds in the unit of the input, and its covariance about the origin.

    `stayed` is the share of the compared points on which it rests, `gain` how many times as many
    points agree to within the noise as did before, each as much as it counts.
    """

    pose: RigidTransform
    covariance: Float[np.ndarray, "6 6"]
    stayed: float
    gain: float

    @property
    def better(self) -> bool:
        """Whether clearly more points agree than before."""
        return self.gain >= _GAIN

    @property
    def no_worse(self) -> bool:
        """Whether more points agree than before: enough where somebody said how much they count."""
        return self.gain > 1

    @property
    def doubt(self) -> str:
        """A sentence if too little stayed to tell what it is that moved; else empty."""
        if self.stayed >= _MAJORITY:
            return ""
        return (
            f"{1 - self.stayed:.0%} of the points moved or changed, so many that nothing tells which "
            "part stayed: give weights if you know it."
        )


def settled(
    source: Prepared,
    reference: Prepared,
    pose: RigidTransform,
    reach: float,
    *,
    known: Known,
) -> Settled:
    """The pose on which the largest part agrees to the noise, from `pose` on.

    Both are of the centred clouds in the unit of the input, in which points may lie `reach` off.
    """
    unit, motions = reference.radius, known.motions
    finer = planes.Surface(reference.points, reference.tree, count=_NEIGHBORS)
    start = RigidTransform(pose.rotation, pose.translation / unit)
    few, many = source.rows(_FIRST), source.rows(_SECOND)
    first, second = (source.points[rows] * (source.radius / unit) for rows in (few, many))
    given = np.ones(len(source.points)) if known.weights is None else known.weights
    level, least = noise(source, reference)
    widths = np.geomspace(max(reach / unit, planes.TUKEY * level), planes.TUKEY * level, _NARROWING)
    found = _narrowed(first, given[few], reference, start, widths, level, motions)
    around = trees.neighbors(trees.Tree(second), second, min(_AROUND, len(second)))[1]
    narrow = np.geomspace(planes.TUKEY, _INNER, _STEADY)
    stays = given[many]
    for _ in range(_ROUNDS):
        found = planes.fitted(second, finer, found.pose, np.zeros(0), motions=motions)
        level = max(_core(found.off[found.over & (given[many] > 0)]), least)
        stays = given[many] * _stayed(found.off, around, level)
        found = planes.fitted(
            second, finer, found.pose, level * narrow, weights=stays, motions=motions
        )
    wider = planes.fitted(
        second, finer, found.pose, 1.5 * level * narrow[-1:], weights=stays, motions=motions
    )
    before = planes.fitted(second, finer, start, np.zeros(0), motions=motions)
    agree, agreed = (
        np.sum(given[many] * (one.over & (np.abs(one.off) < level / 2))) for one in (found, before)
    )
    # What moved and yet lies within the kernel is no noise: it draws more on a wider one.
    drawn = _difference(wider.pose, found.pose)
    covariance = found.covariance[:6, :6] + np.outer(drawn, drawn)
    units = np.repeat([1.0, unit], 3)
    return Settled(
        RigidTransform(found.pose.rotation, found.pose.translation * unit),
        covariance * np.outer(units, units),
        float(np.mean(stays[found.over] > 0.5)) if found.over.any() else 0.0,
        float(agree / max(agreed, _LEAST)),
    )


def _narrowed(
    points: Float[np.ndarray, "p 3"],
    given: Float[np.ndarray, "p"],
    reference: Prepared,
    start: RigidTransform,
    widths: Float[np.ndarray, "i"],
    level: float,
    motions: Float[np.ndarray, "6 f"],
) -> planes.Fitted:
    """The pose fitted with a kernel that narrows: to all points, or to a half if more agree there.

    Where a whole side moved, as the snow on one, all points fit best under a pose that tilts between
    the sides, at every width. The points are halved across their two longest axes.
    """
    inner = points - points.mean(axis=0)
    along = inner @ np.linalg.eigh(inner.T @ inner)[1][:, :0:-1]
    first = (along > np.median(along, axis=0)).T
    fits = [
        planes.fitted(points, reference.surface, start, widths, motions=motions, weights=weights)
        for weights in (given, *(given * half for half in (*first, *~first)))
    ]
    agree = [np.sum(given * (fit.over & (np.abs(fit.off) < level))) for fit in fits]
    best = int(np.argmax(agree))
    return fits[best] if agree[best] > _MORE * agree[0] else fits[0]


def noise(source: Prepared, reference: Prepared, count: int = _FIRST) -> tuple[float, float]:
    """The median thickness of pieces of surface and its floor, in radii of the reference."""
    levels, widths = [], []
    for cloud in (source, reference):
        found = cloud.surface.next_to(cloud.points[cloud.rows(count)])
        levels.append(np.median(found.noise) * cloud.radius / reference.radius)
        widths.append(np.median(found.width) * cloud.radius / reference.radius)
    least = max(planes.FLOOR * float(max(widths)), _LEAST)
    return max(float(np.hypot(*levels)), least), least


def _stayed(
    off: Float[np.ndarray, "p"], around: Int[np.ndarray, "p k"], noise: float
) -> Float[np.ndarray, "p"]:
    """1 where the surface around a point lies where it was, 0 where it moved.

    Of points that moved some lie on the other surface by chance; those around them do not.
    """
    typical = np.median(np.abs(off)[around], axis=1) / (0.6745 * noise)
    return planes.tukey(np.maximum(typical - _STAYED, 0) / (_MOVED - _STAYED))


def _core(off: Float[np.ndarray, "p"]) -> float:
    """The standard deviation of normal errors with this lower quartile of the distance from zero."""
    return float(np.quantile(np.abs(off), 0.25)) / 0.3186 if len(off) else 0.0


def _difference(one: RigidTransform, other: RigidTransform) -> Float[np.ndarray, "6"]:
    """The small motion (rotation vector, translation) about the origin from one pose to another."""
    change = other.rotation @ one.rotation.T
    skew = (change - change.T) / 2
    vector = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    return np.concatenate([vector, other.translation - change @ one.translation])
