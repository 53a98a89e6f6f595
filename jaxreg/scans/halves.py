"""How far a pose moves where only a half of the overlap decides: what residuals do not tell.

Residuals say how far each point lies off a pose that has bent to all of them. They do not say what is
wrong with whole regions: planes between the sides of a plate that is thinner than its points lie
apart, a depth image that is warped, a scan that drifted. The two halves of an overlap are two
pairs of scans of the same surfaces, and what is wrong with one is not wrong with the other: their
poses differ. Where they differ by more than the covariance says, it is widened.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxreg.geometry.rigid import nearest_rotation
from jaxreg.refine.kdtree import IndexedCloud, iterate_all
from jaxreg.refine.robust import Weighting
from jaxreg.scans import candidates
from jaxreg.types import RigidTransform

_LEAST = 64
"""Points of an overlap that is halved."""
_SAID = 4.0
"""Halves that differ by no more than so many times what the covariance says do not widen it: each has
half of the points and of the extent, so that its pose is less certain than that of the whole."""


def differences(
    source: IndexedCloud,
    reference: IndexedCloud,
    pose: RigidTransform,
    *,
    distance: float,
    motions: Float[np.ndarray, "6 f"] | None,
) -> Float[np.ndarray, "s 6"]:
    """Half of the motions between the poses of the two halves of an overlap, about the origin.

    Each is a rotation vector and a translation in the frame of both clouds. The overlap, the points of
    the source within `distance` of the reference, is halved across its longest axis and across the
    next one. There is none if it has too few points.
    """
    moved = source.moved_by(pose)
    near = np.isfinite(reference.nearest(moved, within=distance)[0])
    if near.sum() < 2 * _LEAST:
        return np.zeros((0, 6))
    centred = moved - moved[near].mean(axis=0)
    axes = np.linalg.eigh(np.cov(centred[near].T))[1].T[:0:-1]
    along = axes @ centred.T
    first = along > np.median(along[:, near], axis=1)[:, None]
    counted = np.concatenate([first, ~first])
    poses = RigidTransform(*(np.repeat(part[None], len(counted), 0) for part in pose))
    weighting = Weighting(candidates.REFINE.kernel, None, distance, candidates.REFINE.trim)
    found = iterate_all(
        poses, source, reference, weighting, config=candidates.REFINE, step=candidates.STEP,
        motions=motions, counted=np.pad(counted, ((0, 0), (0, len(source.padded) - len(moved)))),
    )  # fmt: skip
    turns, shifts = nearest_rotation(found.rotation), found.translation
    one, other = slice(None, len(first)), slice(len(first), None)
    between = turns[one] @ turns[other].swapaxes(1, 2)
    shift = shifts[one] - (between @ shifts[other][..., None])[..., 0]
    return np.column_stack([Rotation.from_matrix(between).as_rotvec(), shift]) / 2


def widened(
    covariance: Float[np.ndarray, "6 6"], found: Float[np.ndarray, "s 6"], free: int
) -> Float[np.ndarray, "6 6"]:
    """The covariance, and how far halves differ, where that is more than it says.

    With ``D = mean d d^T`` and ``q = trace(C^+ D) / free``, of so many unknown motions:
    ``C + max(0, 1 - 4 / q) (D + q C) / 2``. Two differences show two of the directions, so
    half of it goes into all.
    """
    if len(found) == 0:
        return covariance
    inverse = np.linalg.pinv(covariance, rcond=1e-14, hermitian=True)
    spread = found.T @ found / len(found)
    ratio = float(np.sum(inverse * spread)) / free
    more = max(0.0, 1 - _SAID / max(ratio, _SAID))
    return covariance + more * (spread + ratio * covariance) / 2
