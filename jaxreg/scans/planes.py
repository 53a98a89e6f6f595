"""Poses from the planes of a dense cloud, on the host: what small pieces of surface say.

Around every point of the source the nearest points of the reference make a patch with a plane. The
Gauss-Newton steps on the distances from these planes take any set of unknowns: six, the four of
upright scans, the three of the plane (patches are lines there), and the scale as one more.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxreg.geometry import trees
from jaxreg.refine.uncertainty import LEAST_SPREAD
from jaxreg.types import RigidTransform

NEIGHBORS = 12
"""Points of a patch of surface."""
TUKEY = 4.685
"""Where Tukey's kernel ends, in standard deviations, for nearly all that normal errors tell."""
FLOOR = 0.1
"""The noise is taken for at least so many widths of a patch: exact points have none, but poses are
never exact, and curved surfaces are no planes."""
WITHIN = 3.0
"""A point lies over its patch if it is at most this many widths from the middle, along the plane."""
_FEWEST = 20
"""Fewer points over patches say nothing."""
_LONGEST = 0.1
"""The longest step of the logarithm of the scale."""
_PATCH = 30
"""Points that may share an error: those that lie in one cube of this size on average."""
_BOTH_NOISY = 1.9
"""As in `jaxreg.refine.uncertainty`: two scans are noisy, not one."""


class Patches(NamedTuple):
    """Of the surface next to some points: a point on it, its normal, noise and width."""

    centre: Float[np.ndarray, "p 3"]
    normal: Float[np.ndarray, "p 3"]
    noise: Float[np.ndarray, "p"]
    width: Float[np.ndarray, "p"]


class Fitted(NamedTuple):
    """A pose (and scale: ``y = scale R x + t``), its covariance, and the points it rests on.

    `covariance` is of (rotation vector, translation, log scale) about the origin of the reference;
    rows of what was known are zero. `information` and `weight` are those of `PoseUncertainty`,
    `last_step` is the larger of turn (radians) and shift of the last step. `off` are the distances
    from the planes, `over` says where there is one to compare with, and `noise` is the standard
    deviation of those near zero.
    """

    pose: RigidTransform
    scale: float
    covariance: Float[np.ndarray, "7 7"]
    information: Float[np.ndarray, "6 6"]
    weight: float
    last_step: float
    off: Float[np.ndarray, "p"]
    over: Bool[np.ndarray, "p"]
    noise: float


def patches(
    points: Float[np.ndarray, "m 3"],
    tree: trees.Tree,
    at: Float[np.ndarray, "p 3"],
    *,
    count: int = NEIGHBORS,
    flat: bool = False,
) -> Patches:
    """The patches next to points; `flat`: of lines in the plane z = 0."""
    count = min(count, len(points))
    found = points[trees.neighbors(tree, at, count)[1]]
    centre = found.mean(axis=1)
    spread = found - centre[:, None]
    moment = np.einsum("nki,nkj->nij", spread, spread) / count
    if flat:
        # A line in the plane: what is upright is no normal.
        moment[:, 2, 2] = 2 * np.trace(moment, axis1=1, axis2=2) + 1e-300
    variance, axes = np.linalg.eigh(moment)
    noise, width = (np.sqrt(np.maximum(variance[:, i], 0)) for i in (0, 1))
    return Patches(centre, axes[:, :, 0], noise, width)


class Surface:
    """A cloud as the patches around its points, each made once: steps come back to the same points.

    The patch next to any point is that around the nearest point of the cloud. `count` points make a
    patch; `flat`: of lines in the plane z = 0.
    """

    def __init__(
        self,
        points: Float[np.ndarray, "m 3"],
        tree: trees.Tree,
        *,
        count: int = NEIGHBORS,
        flat: bool = False,
    ) -> None:
        """Makes no patch yet."""
        self.points, self.tree, self.count, self.flat = points, tree, count, flat
        self._made = np.zeros(len(points), bool)
        vectors, numbers = np.empty((2, len(points), 3)), np.empty((2, len(points)))
        self._patches = Patches(*vectors, *numbers)

    def next_to(self, at: Float[np.ndarray, "p 3"]) -> Patches:
        """The patches next to points."""
        nearest = trees.nearest(self.tree, at)[1]
        new = np.unique(nearest[~self._made[nearest]])
        if len(new):
            around = patches(
                self.points, self.tree, self.points[new], count=self.count, flat=self.flat
            )
            for every, some in zip(self._patches, around, strict=True):
                every[new] = some
            self._made[new] = True
        return Patches(*(leaf[nearest] for leaf in self._patches))


def offsets(
    points: Float[np.ndarray, "p 3"], found: Patches
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]]:
    """How far points lie off their patches, and how far from the middle of it along them."""
    residual = points - found.centre
    off = np.sum(residual * found.normal, axis=1)
    return off, np.linalg.norm(residual - off[:, None] * found.normal, axis=1)


def misfit(
    points: Float[np.ndarray, "p 3"], surface: Surface, limits: Float[np.ndarray, "l"]
) -> Float[np.ndarray, "l p"]:
    """How much every point speaks against lying on a surface, from 0 to 1, for each of the limits.

    The squared distance from the plane of its patch in units of the limit, 1 from there on and where
    there is no patch beside it.
    """
    found = surface.next_to(points)
    off, beside = offsets(points, found)
    off = np.where(beside < WITHIN * found.width, off, np.inf)
    return capped(off, limits)


def capped(off: Float[np.ndarray, "p"], limits: Float[np.ndarray, "l"]) -> Float[np.ndarray, "l p"]:
    """Squared distances in units of each limit, 1 from there on."""
    return np.minimum(np.abs(off) / limits[:, None], 1) ** 2


def errors_worse(
    other: Float[np.ndarray, "l p"], one: Float[np.ndarray, "l p"]
) -> Float[np.ndarray, "l"]:
    """The mean difference of two misfits of the same points, in standard errors."""
    difference = other - one
    deviation = difference.std(axis=1) / np.sqrt(difference.shape[1])
    return difference.mean(axis=1) / np.maximum(deviation, 1e-12)


def fitted(
    source: Float[np.ndarray, "p 3"],
    reference: Surface,
    pose: RigidTransform,
    widths: Float[np.ndarray, "i"],
    *,
    motions: Float[np.ndarray, "6 f"],
    scale: float | None = None,
    weights: Float[np.ndarray, "p"] | None = None,
) -> Fitted:
    """The pose after one step for each of `widths`, and the covariance at the last of them.

    Tukey's weight ``(1 - (r / width)^2)^2`` of the distance r from the plane of the patch, 0 beyond.
    `motions` are the unknown ones (rotation vector, translation); a `scale` to start from makes the
    scale an unknown, too. `weights` multiply.
    """
    rotation, shift, size = pose.rotation, pose.translation, 1.0 if scale is None else scale
    basis = np.zeros((7, motions.shape[1] + (scale is not None)))
    basis[:6, : motions.shape[1]] = motions
    if scale is not None:
        basis[6, -1] = 1
    given = np.ones(len(source)) if weights is None else weights
    last_step = np.inf
    for width in widths:
        rows, off, over = _linear(source, reference, rotation, shift, size)
        weight = np.where(over, given * tukey(off / width), 0)
        if np.sum(weight > 0) < _FEWEST:
            break
        system = rows @ basis
        normal = (system * weight[:, None]).T @ system
        step = basis @ np.linalg.lstsq(normal, -system.T @ (weight * off), rcond=1e-10)[0]
        rotation, shift = turn(step[:3]) @ rotation, turn(step[:3]) @ shift + step[3:6]
        last_step = float(max(np.linalg.norm(step[:3]), np.linalg.norm(step[3:6])))
        size *= float(np.exp(np.clip(step[6], -_LONGEST, _LONGEST)))
    rows, off, over = _linear(source, reference, rotation, shift, size)
    last = float(widths[-1]) if len(widths) else np.inf
    weight = np.where(over, given * tukey(off / last), 0)
    moved = size * source @ rotation.T + shift
    covariance = _covariance(rows @ basis, off, weight, given, moved, last)
    return Fitted(
        RigidTransform(rotation, shift),
        size,
        basis @ covariance @ basis.T,
        (rows[:, :6] * weight[:, None]).T @ rows[:, :6],
        float(weight.sum()),
        last_step,
        off,
        over,
        noise_of(off[weight > 0]),
    )


def tukey(relative: Float[np.ndarray, "p"]) -> Float[np.ndarray, "p"]:
    """``(1 - u^2)^2``, 0 beyond 1."""
    return np.maximum(1 - relative**2, 0) ** 2


def noise_of(off: Float[np.ndarray, "p"]) -> float:
    """The standard deviation of normal errors with this median distance from zero."""
    return 1.4826 * float(np.median(np.abs(off))) if len(off) else 0.0


def turn(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation matrix of a rotation vector (radians)."""
    from scipy.spatial.transform import Rotation  # most registrations do without

    return Rotation.from_rotvec(vector).as_matrix()


def _linear(source, reference: Surface, rotation, shift, size):
    """Derivatives of the distances by rotation vector, translation and log scale; distances; over."""
    turned = size * source @ rotation.T
    found = reference.next_to(turned + shift)
    off, beside = offsets(turned + shift, found)
    normal = found.normal
    rows = np.column_stack(
        [np.cross(turned + shift, normal), normal, np.sum(turned * normal, axis=1)]
    )
    return rows, off, beside < WITHIN * found.width


def _raised_to(
    matrix: Float[np.ndarray, "f f"], unit: Float[np.ndarray, "f f"], least: float
) -> Float[np.ndarray, "f f"]:
    """The matrix with every eigenvalue relative to `unit` at least so large."""
    values, vectors = np.linalg.eigh(unit)
    root = vectors * np.sqrt(np.maximum(values, 1e-12 * max(values[-1], 1e-300)))
    inverse = np.linalg.inv(root)
    inner, axes = np.linalg.eigh(inverse @ matrix @ inverse.T)
    half = root @ (axes * np.sqrt(np.maximum(inner, least)))
    return half @ half.T


def _covariance(rows, off, weight, given, moved, width) -> np.ndarray:
    """``B^-1 (sum_k g_k g_k^T) B^-1``, with the errors of the points of a patch k taken as one."""
    inside = weight > 0
    count = np.sum(inside)
    if count < _FEWEST:
        return np.full((rows.shape[1], rows.shape[1]), np.nan)
    relative = np.where(inside, off / width, 1)
    curvature = np.where(inside, (1 - relative**2) * (1 - 5 * relative**2), 0) * given
    # Where residuals near the rim of the kernel abound, they would make it negative.
    mean = max(np.sum(curvature) / np.sum(given[inside]), 0.1)
    plain = (rows * np.where(inside, given, 0)[:, None]).T @ rows
    bread = np.linalg.pinv(plain * mean, rcond=1e-12, hermitian=True)
    slopes = rows * (weight * off)[:, None]
    edge = np.sqrt(np.mean(np.sum((moved - moved.mean(axis=0)) ** 2, axis=1)))
    edge = max(edge * np.sqrt(12 * _PATCH / count), 1e-300)
    cells = np.unique(np.floor(moved[inside] / edge), axis=0, return_inverse=True)[1].ravel()
    sums = np.stack([np.bincount(cells, weights=column) for column in slopes[inside].T], axis=1)
    filled = len(sums)
    meat = sums.T @ sums * filled / max(filled - rows.shape[1], 1)
    least = float(np.sum((weight * off) ** 2) / np.sum(given[inside]))
    meat = _raised_to(meat, plain, LEAST_SPREAD * least)
    return _BOTH_NOISY * bread @ meat @ bread
