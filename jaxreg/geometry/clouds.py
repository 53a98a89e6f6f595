"""What users give: the one check of a cloud, of its normals and of a pose; padding to few sizes."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from jaxreg.geometry.rigid import nearest_rotation
from jaxreg.types import RigidTransform

_LARGEST = 1e100
"""Coordinates beyond would overflow when squared."""


_FEWEST = 3
"""Two points leave a rotation about the line between them."""


def check_points(
    points: object, name: str, *, nonfinite: Literal["raise", "drop"] = "raise"
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """`points` as float64 (n, 3), and which rows are finite.

    Raises:
      ValueError: not a numeric array of shape (n, 3), fewer than three (finite) points, a
        coordinate beyond 1e100, or, unless `nonfinite` is "drop", one that is NaN or infinite.
    """
    if nonfinite not in ("raise", "drop"):
        raise ValueError(f"nonfinite must be 'raise' or 'drop', got {nonfinite!r}.")
    array = _as_floats(points, name)
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(
            f"{name} has shape {array.shape}, not (n, 3): give one point a row, x y z, "
            "as in points[:, :3]."
        )
    finite = np.asarray(np.isfinite(array).all(axis=1))
    if nonfinite == "raise" and not finite.all():
        row = int(np.argmin(finite))
        raise ValueError(
            f"{name}: point {row} is {array[row].tolist()} and {np.sum(~finite)} of {len(array)} "
            "points are not finite: remove them, or pass nonfinite='drop'."
        )
    if finite.sum() < _FEWEST:
        raise ValueError(
            f"{name} has {finite.sum()} finite points: a pose needs at least {_FEWEST}."
        )
    largest = np.abs(np.where(finite[:, None], array, 0)).max(axis=1)
    huge = np.asarray(finite & (largest > _LARGEST))
    if huge.any():
        row = int(np.argmax(huge))
        raise ValueError(
            f"{name}: point {row} is {array[row].tolist()}, beyond {_LARGEST:g}: use a larger unit."
        )
    return array, finite


def _as_floats(points: object, name: str) -> np.ndarray:
    try:
        array = np.asarray(points)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{name} is not an array ({error}): give an array of shape (n, 3)."
        ) from None
    if array.dtype.kind not in "fiu":
        raise ValueError(
            f"{name} has dtype {array.dtype}: give real numbers, as in "
            "numpy.asarray(points, numpy.float64)."
        )
    return array.astype(np.float64)


def check_normals(
    normals: object, kept: Bool[np.ndarray, "n"], name: str
) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a cloud with one row for each of its own; a zero normal stays zero.

    Raises:
      ValueError: not numeric, not of the shape of the cloud, or not finite where the cloud is.
    """
    array = _as_floats(normals, f"the normals of {name}")
    if array.shape != (len(kept), 3):
        raise ValueError(
            f"the normals of {name} have shape {array.shape}: give one for each of its "
            f"{len(kept)} points, ({len(kept)}, 3)."
        )
    finite = np.isfinite(array).all(axis=1) | ~kept
    if not finite.all():
        raise ValueError(
            f"normal {int(np.argmin(finite))} of {name} is not finite: give zeros where no normal "
            "is known."
        )
    length = np.linalg.norm(array, axis=1, keepdims=True)
    return array / np.where(length > 0, length, 1)


def check_pose(pose: object, name: str) -> RigidTransform:
    """A 4x4 matrix or a `RigidTransform` as a transform in float64 whose rotation is orthogonal.

    Raises:
      ValueError: it is neither, or not finite, or not rigid.
    """
    if isinstance(pose, RigidTransform):
        rotation, translation = (np.asarray(part, np.float64) for part in pose)
    else:
        rotation, translation = _parts_of_matrix(pose, name)
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise ValueError(f"{name} holds NaN or infinity: give a finite transform.")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"{name} is not a rigid transform (its 3x3 part must be a rotation: orthogonal, "
            "det +1): remove scale, shear and mirroring."
        )
    return RigidTransform(nearest_rotation(rotation), translation)


def _parts_of_matrix(pose: object, name: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        matrix = np.asarray(pose, np.float64)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} is not an array of numbers: give a 4x4 matrix [[R, t], [0, 1]]."
        ) from None
    if matrix.shape != (4, 4):
        raise ValueError(f"{name} must be a 4x4 matrix [[R, t], [0, 1]], got {matrix.shape}.")
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError(
            f"the last row of {name} is {matrix[3].tolist()}: give a matrix [[R, t], [0, 1]] "
            "(this one may be transposed)."
        )
    return matrix[:3, :3], matrix[:3, 3]


def padded(
    points: Float[np.ndarray, "n d"], size: int
) -> tuple[Float[np.ndarray, "size d"], Bool[np.ndarray, "size"]]:
    """`points` as float32 filled up with zeros to `size` rows, and the mask of the valid ones."""
    rows = np.zeros((size, points.shape[1]), np.float32)
    rows[: len(points)] = points
    return rows, np.arange(size) < len(points)


def padded_size(count: int, *, smallest: int) -> int:
    """The smallest of ``smallest * 2^k`` that holds `count`: every size compiles its own programs."""
    size = smallest
    while size < count:
        size *= 2
    return size
