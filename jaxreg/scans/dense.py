"""What all points show that the few that a pose is found and judged with do not.

A part and its mirror image, or the same part five per cent larger, agree almost everywhere. Only at
full density is the noise smaller than what they differ by. Where points lie off the other surface
by many times the noise, the usual causes are tried: does the source fit better at another size,
stretched or sheared, or mirrored? Where a large share of all points lies off without such a cause, the
surfaces are of different shapes.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxreg.geometry import se3
from jaxreg.scans import planes, stable
from jaxreg.scans.prepare import Prepared
from jaxreg.types import RigidTransform

_GLANCE, _SAMPLE = 500, 4000
"""Points of the source that are compared: at first, and where these are suspicious."""
OFF = 8.0
"""A point this many noise levels from the other surface is off it."""
_LEAST = 0.02
"""The noise is at least so many widths of a patch where the typical distance is looked at."""
_ENOUGH, _SUSPECT = 0.8, 0.03
"""If so many points can be compared and so many of them are off, the causes are looked for, which
takes up to a second. Of right poses of real scans (docs/notes/0045) those that overlap less often have
as many off, where the scans end or depth is bent; those that overlap so far have not."""
_SPREAD = 1.15
"""Of normal errors half are below 0.67; right poses of real scans have 0.6 to 1.1, one of 19 1.2."""
_ROUGH = 0.8
"""Where all of the source lies over the other surface it is 0.63 to 0.76, and more if parts moved."""
_BETTER = 0.4
"""Another cause fits better if it leaves this share of the points that are off."""
_NEARER = 0.6
"""Or, where nothing fitted to the noise, this share of the distances."""
_SIZES = 0.005
"""The smallest change of size, as a share, that is told; twice that between two directions."""
_MOST = 0.25
"""And the largest difference: a thin part fits anywhere where it may be pressed flat."""
_DIFFERENT = 0.2
"""Another shape, whatever the cause, if nearly all points can be compared and so many are off."""
_SLIGHTLY = 0.02
"""A difference of size that is told where only the fit says so: parts of one drawing differ by less."""
_HINT = 0.5
"""A first step that says so much of it is reason enough to fit the size."""
_SHOWN, _SIZED = 500, 2000
"""Points of the first step, and of the fit."""
_STARTS = 0.96, 1.0, 1.04
"""Sizes to fit from: under a pose that has settled between the two surfaces, 1 is a minimum, too."""
_NARROWING = 8
_LIMIT, _FIRST_WIDTH = 8.0, 40.0
"""Noise levels from which a point counts in full against a size, and where the first kernel ends."""
_CLEARLY, _BESIDE_BIAS = 5.0, 0.4
"""Standard errors by which the fit at another size is better, and how large the difference of size is
beside what both ways err by together (docs/notes/0065)."""
_ITERATIONS = 30
MIRRORED = "The mirrored source fits better."
_WIDEST = 3.0
"""Where the kernel ends, in the distances that it is to judge."""
_STIFF = 1e-6
"""Against changes that the surfaces do not show, as a share of all that they show."""


class Agreement(NamedTuple):
    """How many points of a source lie over the other surface, and how many of these off it.

    `compared` is the share of the points over a patch of the other surface, `off` the share of those
    that lie many noise levels from it, `spread` their median distance from it in noise levels.
    """

    compared: float
    off: float
    spread: float

    @property
    def comparable(self) -> bool:
        """Whether nearly all points lie over the other surface."""
        return self.compared >= _ENOUGH

    @property
    def suspicious(self) -> bool:
        """Whether one should ask why."""
        return self.comparable and self.off >= _SUSPECT

    @property
    def drawn(self) -> bool:
        """Whether nothing fits to the noise, as where a part that moved drew the pose along."""
        return self.comparable and self.spread >= _SPREAD

    @property
    def rough(self) -> bool:
        """Whether a part may have moved by hardly more than the surface is rough."""
        return self.compared >= 0.9 and self.spread >= _ROUGH

    @property
    def different(self) -> bool:
        """Whether so many points lie off that these are surfaces of different shapes."""
        return self.compared >= 0.9 and self.off >= _DIFFERENT

    def explains(self, other: "Agreement") -> bool:
        """Whether this is a far better fit than the other, to the noise or nearer to it."""
        to_the_noise = self.spread <= max(other.spread, _SPREAD)
        fewer_off = self.off <= _BETTER * other.off
        return self.compared >= 0.9 * other.compared and fewer_off and to_the_noise

    def brings_nearer(self, other: "Agreement") -> bool:
        """Whether nothing fitted to the noise before, and this fits much nearer to it."""
        return other.drawn and self.off <= other.off and self.spread <= _NEARER * other.spread


def agreement(
    source: Prepared,
    reference: Prepared,
    pose: RigidTransform,
    change: Float[np.ndarray, "3 3"] | None = None,
    count: int = _SAMPLE,
) -> Agreement:
    """How well `source`, changed about its centre and then moved by `pose`, fits `reference`.

    `change` is a matrix, none by default; `count` of the points are compared. The pose maps the centred
    source to the centred reference, both in the unit of the input.
    """
    some, noise = _sampled(source, count)
    change = np.eye(3) if change is None else change
    moved = some @ change.T @ pose.rotation.T + pose.translation
    patches = _patches(reference, moved)
    off, beside = planes.offsets(moved, patches)
    noise = np.hypot(np.cbrt(np.linalg.det(change)) * noise, patches.noise)
    typical = float(np.median(patches.width))
    floored = np.maximum(noise, planes.FLOOR * typical)
    over = _over(off, beside, patches, floored)
    if not over.any():
        return Agreement(0.0, 0.0, 0.0)
    off, noise, floored = np.abs(off[over]), noise[over], floored[over]
    spread = float(np.median(off / np.maximum(noise, _LEAST * typical)))
    return Agreement(float(over.mean()), float(np.mean(off > OFF * floored)), spread)


def at_a_glance(source: Prepared, reference: Prepared, pose: RigidTransform) -> Agreement:
    """`agreement` of few points, and of many only if these leave doubts; most pairs need no more."""
    few = agreement(source, reference, pose, count=_GLANCE)
    doubtful = few.off >= 0.4 * _SUSPECT or few.spread >= 0.95 * _SPREAD
    doubtful = doubtful and few.compared >= 0.9 * _ENOUGH
    return agreement(source, reference, pose) if doubtful else few


def at_another_size(
    source: Prepared, reference: Prepared, pose: RigidTransform, reach: float
) -> tuple[float, Agreement]:
    """The scale at which the source fits best, from `pose` on, and how well it fits there.

    `reach` is the largest distance of corresponding points at first.
    Gauss-Newton on distances from planes, with a kernel that narrows to the noise; seven unknowns.
    """
    some, noise = _sampled(source, _SAMPLE)
    unit = reference.radius
    found = planes.fitted(
        some / unit,
        reference.surface,
        RigidTransform(pose.rotation, pose.translation / unit),
        _WIDEST / unit * _widths(noise, reach),
        motions=np.eye(6),
        scale=1.0,
    )
    pose = RigidTransform(found.pose.rotation, unit * found.pose.translation)
    return found.scale, agreement(source, reference, pose, found.scale * np.eye(3))


def slight_size(
    source: Prepared, reference: Prepared, pose: RigidTransform, reach: float
) -> float | None:
    """The scale at which the source fits better, where that is a few per cent; else None.

    The pose of a part and one that is a little larger settles where both agree about as well
    everywhere, so that few points are off by much, and of 1,000 points none. A fit of seven unknowns
    tells, from several sizes and both ways: the plane through points of a thin or curved part lies
    inside it, which makes the moving cloud too small, and the two errors cancel.
    `reach` is the largest distance of corresponding points.
    """
    ways = ((source, reference, pose), (reference, source, se3.inverted(pose)))
    first, back = (_step_of_size(*way) for way in ways)
    if min(first.over.mean(), back.over.mean()) < _ENOUGH:
        # What one of them shows beyond the other draws the fit of its points.
        return None
    if abs(math.log(first.scale / back.scale)) / 2 < _HINT * _SLIGHTLY:
        return None
    (scale, better), (inverse, back_better) = (_sized(*way, reach) for way in ways)
    size, bias = math.log(scale / inverse) / 2, math.log(scale * inverse) / 2
    if abs(size) < max(_SLIGHTLY, _BESIDE_BIAS * abs(bias)) or max(better, back_better) < _CLEARLY:
        return None
    return math.exp(size)


def stretched(
    source: Prepared, reference: Prepared, pose: RigidTransform, reach: float
) -> tuple[Float[np.ndarray, "3"], Agreement]:
    """The sizes along three axes at which the source fits best, from `pose` on, and how well it fits.

    The distances from planes are linear in the twelve numbers of ``A x + t``; the axes and sizes are
    those of the stretch in ``A = R S`` (polar decomposition), so that shear is a stretch as well.
    """
    some, noise = _sampled(source, _SAMPLE)
    unit, radius = reference.radius, source.radius / reference.radius
    some = some / unit
    matrix, shift = pose.rotation, pose.translation / unit
    for width in _widths(noise, reach) / unit:
        moved = some @ matrix.T + shift
        patches = reference.surface.next_to(moved)
        off, beside = planes.offsets(moved, patches)
        over = beside < planes.WITHIN * patches.width
        weight = np.where(over, planes.tukey(off / (_WIDEST * width)), 0)
        by_matrix = patches.normal[:, :, None] * (some / radius)[:, None, :]
        rows = np.column_stack([by_matrix.reshape(-1, 9), patches.normal])
        normal = (rows * weight[:, None]).T @ rows
        # What the surfaces leave free stays as it is.
        normal += _STIFF * np.trace(normal) * np.eye(12)
        step = np.linalg.solve(normal, -rows.T @ (weight * off))
        matrix, shift = matrix + step[:9].reshape(3, 3) / radius, shift + step[9:]
    left, sizes, right = np.linalg.svd(matrix)
    pose = RigidTransform(left @ right, unit * shift)
    return sizes, agreement(source, reference, pose, right.T @ np.diag(sizes) @ right)


def at_size_text(scale: float) -> str:
    """A sentence on the size at which the source fits."""
    return f"The source fits at {scale:.3f} of its size."


def size_text(scale: float, now: Agreement, then: Agreement) -> str:
    """A sentence on the size at which the source fits; empty if it is its own."""
    better = then.explains(now) or then.brings_nearer(now)
    if abs(np.log(scale)) < _SIZES or not better:
        return ""
    return at_size_text(scale)


def stretch_text(sizes: Float[np.ndarray, "3"], now: Agreement, then: Agreement) -> str:
    """A sentence on the sizes along three axes; empty if they are one, explain little or are absurd."""
    stretch = np.log(sizes.max() / sizes.min())
    if not 2 * _SIZES <= stretch <= _MOST or not then.explains(now):
        return ""
    return (
        "The source is of another shape: it fits stretched, at "
        f"{sizes.min():.3f} to {sizes.max():.3f} of its size."
    )


def different_text(now: Agreement) -> str:
    """A sentence where a large share of the points lies off; else empty."""
    if not now.different:
        return ""
    return (
        f"{now.off:.0%} of the points lie over the other surface and off it by more than "
        f"{OFF:.0f} times the noise: it is of another shape."
    )


def _in_radii(
    moving: Prepared, fixed: Prepared, pose: RigidTransform, count: int
) -> tuple[Float[np.ndarray, "p 3"], RigidTransform, float]:
    """Points of a cloud, a pose of centred clouds, and the noise, in radii of the fixed cloud."""
    some = moving.points[moving.rows(count)] * (moving.radius / fixed.radius)
    shift = pose.translation / fixed.radius
    return some, RigidTransform(pose.rotation, shift), stable.noise(moving, fixed, _SHOWN)[0]


def _step_of_size(moving: Prepared, fixed: Prepared, pose: RigidTransform) -> planes.Fitted:
    """The pose and scale after one Gauss-Newton step of seven unknowns."""
    some, pose, noise = _in_radii(moving, fixed, pose, _SHOWN)
    width = np.array([_FIRST_WIDTH * noise])
    return planes.fitted(some, fixed.surface, pose, width, motions=np.eye(6), scale=1.0)


def _sized(
    moving: Prepared, fixed: Prepared, pose: RigidTransform, reach: float
) -> tuple[float, float]:
    """The scale at which a cloud fits best, and by how many standard errors it is better there."""
    some, pose, noise = _in_radii(moving, fixed, pose, _SIZED)
    widths = np.geomspace(max(reach / fixed.radius, _LIMIT * noise), 5 * noise, _NARROWING)
    fitted = functools.partial(planes.fitted, some, fixed.surface, pose, motions=np.eye(6))
    now = fitted(np.zeros(0))
    scale, better = 1.0, -np.inf
    for start in _STARTS:
        found = fitted(widths, scale=start)
        # A smaller cloud has fewer points beyond where the other ends, which says nothing of its size.
        both = now.over & found.over
        then, before = (
            planes.capped(one.off[both], np.array([_LIMIT * noise])) for one in (found, now)
        )
        errors = -float(planes.errors_worse(then, before)[0]) if both.any() else -np.inf
        if errors > better:
            scale, better = found.scale, errors
    return scale, better


def _widths(noise: Float[np.ndarray, "p"], reach: float) -> Float[np.ndarray, "i"]:
    """The distances that a kernel is to judge while it narrows from `reach` to the noise."""
    narrowest = min(3 * float(np.median(noise)) + planes.FLOOR * reach, reach)
    return np.geomspace(reach, narrowest, _ITERATIONS)


def _sampled(cloud: Prepared, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the cloud about its centre in the unit of the input, and the noise there."""
    points = cloud.points[cloud.rows(count)]
    noise = planes.patches(cloud.points, cloud.tree, points).noise
    return points * cloud.radius, noise * cloud.radius


def _patches(cloud: Prepared, at: np.ndarray) -> planes.Patches:
    """The patches of a cloud next to some points, all in the unit of the input."""
    found = planes.patches(cloud.points, cloud.tree, at / cloud.radius)
    centre, normal, noise, width = found
    return planes.Patches(centre * cloud.radius, normal, noise * cloud.radius, width * cloud.radius)


def _over(
    off: np.ndarray, beside: np.ndarray, patches: planes.Patches, noise: np.ndarray
) -> Bool[np.ndarray, "p"]:
    """Which points lie over their patch, and not so far off that it may be another surface."""
    typical = np.median(patches.width)
    near = np.abs(off) < np.maximum(100 * noise, 10 * typical)
    return (beside < planes.WITHIN * patches.width) & near
