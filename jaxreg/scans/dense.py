"""What all points show that the few that a pose is found and judged with do not.

A part and its mirror image, or the same part five per cent larger, agree almost everywhere. Only at
full density is the noise smaller than what they differ by. Where points lie off the other surface
by many times the noise, the two usual causes are tried: does the mirrored source fit better, or the
source at another size?
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxreg.scans.prepare import Prepared
from jaxreg.types import RigidTransform

_GLANCE, _SAMPLE = 500, 4000
"""Points of the source that are compared: at first, and where these are suspicious."""
_NEIGHBORS = 12
"""Points of a patch of surface."""
_OFF = 8.0
"""A point this many noise levels from the other surface is off it."""
_STEP = 0.1
"""The noise is at least so many spacings: exact points have none, but their poses are never exact."""
_ENOUGH, _SUSPECT = 0.6, 0.03
"""If so many points can be compared and so many of them are off, the causes are looked for: right poses
of scans that overlap so far have fewer."""
_BETTER = 0.4
"""Another cause fits better if it leaves this share of the points that are off."""
_SIZES = 0.005
"""The smallest change of size, as a share, that is told."""
_ITERATIONS = 30


class Agreement(NamedTuple):
    """How many points of a source lie over the other surface, and how many of these off it.

    `compared` is the share of the points over a patch of the other surface, `off` the share of those
    that lie many noise levels from it.
    """

    compared: float
    off: float

    @property
    def suspicious(self) -> bool:
        """Whether one should ask why."""
        return self.compared >= _ENOUGH and self.off >= _SUSPECT

    def explains(self, other: "Agreement") -> bool:
        """Whether this is a far better fit than the other."""
        return self.compared >= 0.9 * other.compared and self.off <= _BETTER * other.off


class _Patches(NamedTuple):
    """Of the surface next to some points: a point on it, its normal, noise and width."""

    centre: Float[np.ndarray, "p 3"]
    normal: Float[np.ndarray, "p 3"]
    noise: Float[np.ndarray, "p"]
    width: Float[np.ndarray, "p"]


def agreement(
    source: Prepared,
    reference: Prepared,
    pose: RigidTransform,
    scale: float = 1.0,
    count: int = _SAMPLE,
) -> Agreement:
    """How well `source`, times `scale` about its centre and then moved by `pose`, fits `reference`.

    `count` of its points are compared. The pose maps the centred source to the centred reference, both
    in the unit of the input.
    """
    some, noise = _sampled(source, count)
    moved = scale * some @ pose.rotation.T + pose.translation
    patches = _patches(reference, moved)
    off, beside = _offsets(moved, patches)
    noise = np.hypot(scale * noise, patches.noise)
    noise = np.maximum(noise, _STEP * np.median(patches.width))
    over = _over(off, beside, patches, noise)
    if not over.any():
        return Agreement(0.0, 0.0)
    return Agreement(float(over.mean()), float(np.mean(np.abs(off[over]) > _OFF * noise[over])))


def at_a_glance(source: Prepared, reference: Prepared, pose: RigidTransform) -> Agreement:
    """`agreement` of few points, and of many only if these leave doubts; most pairs need no more."""
    few = agreement(source, reference, pose, count=_GLANCE)
    doubtful = few.compared >= 0.9 * _ENOUGH and few.off >= 0.4 * _SUSPECT
    return agreement(source, reference, pose) if doubtful else few


def at_another_size(
    source: Prepared, reference: Prepared, pose: RigidTransform, reach: float
) -> tuple[float, Agreement]:
    """The scale at which the source fits best, from `pose` on, and how well it fits there.

    Gauss-Newton on distances from planes, with a kernel that narrows from `reach`; seven unknowns.
    """
    some, noise = _sampled(source, _SAMPLE)
    rotation, shift, scale = pose.rotation, pose.translation, 1.0
    narrowest = 3 * np.median(noise) + _STEP * reach
    for width in np.geomspace(reach, min(narrowest, reach), _ITERATIONS):
        turned = scale * some @ rotation.T
        patches = _patches(reference, turned + shift)
        off, beside = _offsets(turned + shift, patches)
        near = (beside < 3 * patches.width) & (np.abs(off) < 3 * width)
        if near.sum() < 20:
            break
        normal, weight = patches.normal[near], width**2 / (width**2 + off[near] ** 2)
        rows = np.column_stack(
            [np.cross(turned[near], normal), normal, np.sum(turned[near] * normal, axis=1)]
        )
        step = np.linalg.lstsq(weight[:, None] * rows, -weight * off[near], rcond=1e-9)[0]
        rotation, shift = _turn(step[:3]) @ rotation, shift + step[3:6]
        scale *= float(np.exp(np.clip(step[6], -0.1, 0.1)))
    return scale, agreement(source, reference, RigidTransform(rotation, shift), scale)


def size_text(scale: float, now: Agreement, then: Agreement) -> str:
    """A sentence on the size at which the source fits; empty if it is its own."""
    if abs(np.log(scale)) < _SIZES or not then.explains(now):
        return ""
    return f"The source fits at {scale:.3f} of its size."


def _sampled(cloud: Prepared, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the cloud about its centre in the unit of the input, and the noise there."""
    rows = np.linspace(0, len(cloud.points) - 1, min(count, len(cloud.points))).astype(int)
    points = cloud.points[rows]
    noise = _patches_of(cloud, points).noise
    return points * cloud.radius, noise * cloud.radius


def _patches(cloud: Prepared, at: np.ndarray) -> _Patches:
    """The patches of a cloud next to some points, all in the unit of the input."""
    centre, normal, noise, width = _patches_of(cloud, at / cloud.radius)
    return _Patches(centre * cloud.radius, normal, noise * cloud.radius, width * cloud.radius)


def _patches_of(cloud: Prepared, at: np.ndarray) -> _Patches:
    k = min(_NEIGHBORS, len(cloud.points))
    found = cloud.points[cloud.tree.query(at, k=list(range(1, k + 1)), workers=-1)[1]]
    centre = found.mean(axis=1)
    spread = found - centre[:, None]
    variance, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread) / k)
    noise, width = np.sqrt(np.maximum(variance[:, 0], 0)), np.sqrt(np.maximum(variance[:, 1], 0))
    return _Patches(centre, axes[:, :, 0], noise, width)


def _offsets(points: np.ndarray, patches: _Patches) -> tuple[np.ndarray, np.ndarray]:
    """How far points lie off their patches, and how far from the middle of it along them."""
    residual = points - patches.centre
    off = np.sum(residual * patches.normal, axis=1)
    return off, np.linalg.norm(residual - off[:, None] * patches.normal, axis=1)


def _over(
    off: np.ndarray, beside: np.ndarray, patches: _Patches, noise: np.ndarray
) -> Bool[np.ndarray, "p"]:
    """Which points lie over their patch, and not so far off that it may be another surface."""
    typical = np.median(patches.width)
    return (beside < 3 * patches.width) & (np.abs(off) < np.maximum(100 * noise, 10 * typical))


def _turn(vector: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation  # only scans that are suspicious need it

    return Rotation.from_rotvec(vector).as_matrix()
