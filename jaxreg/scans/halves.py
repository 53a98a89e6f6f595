"""How far a pose moves with the sample of the surfaces: halves of both clouds, refined apart.

The residuals of one sample tell how far each point lies off, not what this sample did to all planes
at once: where a thin plate is sampled more coarsely than it is thick, the planes of a whole region
lie between its sides. Two halves of the points are two samples of the same surfaces, and under
them the pose differs. Only where it differs by more than the covariance says is that widened.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxreg.refine.config import RefineConfig
from jaxreg.refine.kdtree import iterate
from jaxreg.refine.robust import Weighting
from jaxreg.scans.prepare import Level
from jaxreg.types import RigidTransform

LEAST, MOST = 64, 1024
"""Points of a cloud that is halved. Of larger ones the planes are known well enough: sampling moves a
pose by less than noise does. Halves of smaller ones have no planes."""
_SHARE = 0.3
"""Of the spread of halves that is taken for that of the whole: halves are sampled more coarsely, and
differ by more than their number alone would make them."""
_SAID = 1.5
"""Halves that differ by no more than so many times what the covariance says do not widen it."""


def differences(
    levels: tuple[Level, Level],
    scales: tuple[float, float],
    pose: RigidTransform,
    *,
    halvings: int,
    distance: float,
    config: RefineConfig,
    motions: Float[np.ndarray, "6 f"] | None,
) -> Float[np.ndarray, "s 6"]:
    """Half of the motions between the poses of two halves, about the origin of the frame.

    Each is a rotation vector and a translation. `scales` place the levels in the frame; `distance` is
    the largest between corresponding points of whole clouds. The same clouds give the same halves.
    """
    weighting = Weighting(config.kernel, None, float(distance), config.trim)
    found = []
    for number in range(halvings):
        sources, references = (
            [half._replace(scale=scale) for half in level.halved(number)]
            for level, scale in zip(levels, scales, strict=True)
        )
        one, other = (
            iterate(pose, source, reference, weighting, config=config, motions=motions)[0]
            for source, reference in zip(sources, references, strict=True)
        )
        turn = one.rotation @ other.rotation.T
        shift = one.translation - turn @ other.translation
        found.append(np.concatenate([Rotation.from_matrix(turn).as_rotvec(), shift]) / 2)
    return np.array(found)


def widened(
    covariance: Float[np.ndarray, "6 6"], found: Float[np.ndarray, "s 6"], free: int
) -> Float[np.ndarray, "6 6"]:
    """The covariance, and a share of how far halves differ, where that is more than it says.

    With ``D = mean d d^T`` and ``q = trace(C^+ D) / free``, of so many unknown motions:
    ``C + share max(0, 1 - said / q) (D + q C) / 2``. Few halves show few of the directions, so half
    of it goes into all.
    """
    inverse = np.linalg.pinv(covariance, rcond=1e-14, hermitian=True)
    spread = found.T @ found / len(found)
    ratio = float(np.sum(inverse * spread)) / free
    more = _SHARE * max(0.0, 1 - _SAID / max(ratio, _SAID))
    return covariance + more * (spread + ratio * covariance) / 2
