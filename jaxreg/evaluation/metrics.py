"""Errors of estimated transforms, in float64 on the host, from transforms and never from a model.

Rotations are measured as given: nothing is projected onto SO(3) first, so an estimate that is
orthonormal only to float32 pays for it.
"""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxreg.geometry.rigid import rotation_angle_deg
from jaxreg.types import RigidTransform

_ORTHONORMAL = 1e-3
"""Largest entry of |R^T R - I| that still passes for a rotation that lost digits in float32."""


class PairErrors(NamedTuple):
    """Errors of every pair; degrees, and the unit of the clouds.

    `euler_deg` holds the differences of the extrinsic 'zyx' Euler angles (not wrapped at 180, as
    published), `rre_deg` the angle of ``R_pred R_gt^T``, `rre_deg_float32_acos` the same as the
    literature prints it, `translation` is ``t_pred - t_gt`` and `rte` its length.
    """

    euler_deg: Float[np.ndarray, "n 3"]
    rre_deg: Float[np.ndarray, "n"]
    rre_deg_float32_acos: Float[np.ndarray, "n"]
    translation: Float[np.ndarray, "n 3"]
    rte: Float[np.ndarray, "n"]


def evaluate_transforms(predicted: RigidTransform, truth: RigidTransform) -> dict[str, int | float]:
    """Every metric over n pairs, from stacked transforms ((n, 3, 3), (n, 3)) of any array type.

    The keys are those of `summarize`; the errors of single pairs come from `pair_errors`.

    Raises:
      ValueError: as `pair_errors`.
    """
    return summarize(pair_errors(predicted, truth))


def pair_errors(predicted: RigidTransform, truth: RigidTransform) -> PairErrors:
    """The errors of every pair, from stacked transforms ((n, 3, 3), (n, 3)) of any array type.

    Raises:
      ValueError: the shapes differ or are not those of stacked transforms, there is no pair, or a
        pair (the message names the first) is not finite or its matrix is not a rotation.
    """
    predicted, truth = _checked(predicted, "predicted"), _checked(truth, "true")
    if len(predicted.rotation) != len(truth.rotation):
        raise ValueError(
            f"{len(predicted.rotation)} predicted transforms for {len(truth.rotation)} true ones: "
            "give one for each pair, in the same order."
        )
    difference = predicted.translation - truth.translation
    return PairErrors(
        euler_deg=euler_zyx_deg(predicted.rotation) - euler_zyx_deg(truth.rotation),
        rre_deg=rotation_angle_deg(predicted.rotation, truth.rotation),
        rre_deg_float32_acos=rotation_angle_deg_float32_acos(predicted.rotation, truth.rotation),
        translation=difference,
        rte=np.linalg.norm(difference, axis=-1),
    )


def summarize(errors: PairErrors) -> dict[str, int | float]:
    """Means, medians, recall and the worst pair.

    * `mae_r_deg`, `rmse_r_deg`, `mae_t`, `rmse_t`: mean absolute and root mean square difference
      over the Euler angles and over the coordinates (the anisotropic metrics of DCP).
    * `mie_r_deg`, `mie_t`: mean angle and mean length (the isotropic metrics of RPMNet; the frame
      that the published MIE(t) rotates into, ``R_gt^T (t_pred - t_gt)``, changes no length).
    * `mie_r_deg_float32_acos`: the published form of MIE(R), meaningless below 0.02 degrees.
    * `recall_1deg`: share of pairs within 1 degree and 0.01; `recall_5deg`: 5 degrees and 0.1.
    * `worst_pair`, `worst_rre_deg`, `worst_rte`: the pair with the largest angle.
    """
    worst = int(np.argmax(errors.rre_deg))
    return {
        "pairs": len(errors.rre_deg),
        "mae_r_deg": float(np.mean(np.abs(errors.euler_deg))),
        "mae_t": float(np.mean(np.abs(errors.translation))),
        "mie_r_deg": float(np.mean(errors.rre_deg)),
        "mie_r_deg_float32_acos": float(np.mean(errors.rre_deg_float32_acos)),
        "mie_t": float(np.mean(errors.rte)),
        "rmse_r_deg": float(np.sqrt(np.mean(errors.euler_deg**2))),
        "rmse_t": float(np.sqrt(np.mean(errors.translation**2))),
        "median_rre_deg": float(np.median(errors.rre_deg)),
        "median_rte": float(np.median(errors.rte)),
        "recall_1deg": float(np.mean((errors.rre_deg < 1) & (errors.rte < 0.01))),
        "recall_5deg": float(np.mean((errors.rre_deg < 5) & (errors.rte < 0.1))),
        "worst_pair": worst,
        "worst_rre_deg": float(errors.rre_deg[worst]),
        "worst_rte": float(errors.rte[worst]),
    }


def euler_zyx_deg(rotation: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Extrinsic 'zyx' Euler angles in degrees: ``R = Rx(c) Ry(b) Rz(a)`` gives ``(a, b, c)``."""
    with warnings.catch_warnings():
        # At b = 90 degrees only a + c or a - c exists; scipy then sets one of them to zero.
        warnings.filterwarnings("ignore", message="Gimbal lock", category=UserWarning)
        return Rotation.from_matrix(rotation).as_euler("zyx", degrees=True)


def rotation_angle_deg_float32_acos(
    rotation: Float[np.ndarray, "n 3 3"], other: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n"]:
    """Angle between rotations in degrees as published, ``arccos((trace(R2^T R1) - 1) / 2)``.

    Kept for comparison only. The float32 cosines nearest to 1 are 6e-8 apart, so no result between
    0 and 0.02 degrees is possible, and a rotation orthonormal to 1e-6 prints up to 0.1.
    """
    relative = np.swapaxes(other.astype(np.float32), -1, -2) @ rotation.astype(np.float32)
    cosine = (np.trace(relative, axis1=-2, axis2=-1) - np.float32(1)) / np.float32(2)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _checked(transform: RigidTransform, name: str) -> RigidTransform:
    rotation = np.asarray(transform.rotation, np.float64)
    translation = np.asarray(transform.translation, np.float64)
    n = len(rotation) if rotation.ndim else 0
    if n == 0 or rotation.shape != (n, 3, 3) or translation.shape != (n, 3):
        raise ValueError(
            f"{name} transforms must be stacked, rotations (n, 3, 3) and translations (n, 3) with "
            f"n >= 1, got {rotation.shape} and {translation.shape}."
        )
    finite = np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(translation).all(axis=1)
    if not finite.all():
        raise ValueError(
            f"the {name} transform of pair {int(np.argmin(finite))} is not finite: give the "
            "identity where a method failed, so the failure counts."
        )
    gram = np.swapaxes(rotation, 1, 2) @ rotation
    defect = np.abs(gram - np.eye(3)).max(axis=(1, 2))
    proper = (defect < _ORTHONORMAL) & (np.linalg.det(rotation) > 0)
    if not proper.all():
        pair = int(np.argmin(proper))
        raise ValueError(
            f"the {name} rotation of pair {pair} is not a rotation: |R^T R - I| = {defect[pair]:.2g}, "
            f"det R = {np.linalg.det(rotation[pair]):.3g}; project it onto SO(3) first."
        )
    return RigidTransform(rotation, translation)
