"""The one check of what users give (a cloud, its normals, a pose), and padding to a few sizes."""

import contextlib
import os
from collections.abc import Sequence
from typing import Literal

import numpy as np
from jax.core import Tracer
from jaxtyping import Bool, Float

from jaxreg.geometry import foreign
from jaxreg.geometry.rigid import nearest_rotation
from jaxreg.types import RigidTransform

_LARGEST = 1e100
"""Larger coordinates would overflow when squared."""


_FEWEST = 3
"""Two points leave the rotation about the line between them free."""


def check_points(
    points: object,
    name: str,
    *,
    nonfinite: Literal["raise", "drop"] = "raise",
    planar: bool = False,
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "n"]]:
    """`points` as float64 (n, 3), and which rows are finite.

    Also the points of an object that has some (Open3D, PyVista, trimesh), and the columns x, y, z of a
    structured array or a table. Masked rows count as not finite, and are never refused. If clouds may
    be `planar`, (n, 2) is (n, 3) with z = 0.

    Raises:
      ValueError: not a numeric array of shape (n, 3), fewer than three (finite) points, a
        coordinate beyond 1e100, or, unless `nonfinite` is "drop", one that is NaN or infinite.
    """
    if nonfinite not in ("raise", "drop"):
        raise ValueError(f"nonfinite must be 'raise' or 'drop', got {nonfinite!r}.")
    given = foreign.points_of(points, name)
    array = _as_floats(given, name)
    if planar and array.ndim == 2 and array.shape[1] == 2:
        array = np.column_stack([array, np.zeros(len(array))])
        if isinstance(given, np.ma.MaskedArray):
            given = np.ma.array(array, mask=np.ma.getmaskarray(given)[:, [0, 1, 1]])
    if array.ndim != 2 or array.shape[1] != 3:
        raise ValueError(f"{name} has shape {array.shape}, {_reshaped(given, array.shape)}.")
    array, masked = foreign.unmasked(given, array)
    x, y, z = np.isfinite(array).T  # three columns at a time are quicker than rows of three
    finite = x & y & z
    broken = ~finite & ~masked
    if nonfinite == "raise" and broken.any():
        row = int(np.argmax(broken))
        raise ValueError(
            f"{name}: {np.sum(broken)} of {len(array)} points are not finite, the first is "
            f"point {row}, {array[row].tolist()}: remove them, or pass nonfinite='drop'."
        )
    if finite.sum() < _FEWEST:
        raise ValueError(
            f"{name} has {finite.sum()} finite points: a pose needs at least {_FEWEST}."
        )
    if np.abs(array).max(initial=0, where=finite[:, None]) > _LARGEST:
        row = int(np.argmax(finite & (np.abs(array) > _LARGEST).any(axis=1)))
        raise ValueError(
            f"{name}: point {row} is {array[row].tolist()}, beyond {_LARGEST:g}: use a larger unit."
        )
    return array, finite


def _reshaped(points: object, shape: tuple[int, ...]) -> str:
    """What is not (n, 3), and what makes it so."""
    table = ".to_numpy()" if hasattr(points, "to_numpy") else ""
    if len(shape) == 2 and shape[0] in (3, 4) and shape[1] > shape[0]:
        part = f"points{table}.T" + ("" if shape[0] == 3 else "[:, :3]")
        return f"one point per column, not (n, 3): give it transposed, as in {part}"
    if len(shape) == 2 and shape[1] == 2:
        return (
            "not (n, 3): add a column, as in numpy.column_stack([points, numpy.zeros(len(points))])"
        )
    if len(shape) == 2 and shape[1] > 3:
        return f"not (n, 3): give one point per row, x y z, as in points{table}[:, :3]"
    if len(shape) > 2 and shape[-1] == 3:
        return "not (n, 3): give one point per row, as in points.reshape(-1, 3)"
    if len(shape) > 2 and shape[-1] > 3:
        return "not (n, 3): give one point per row, as in points[..., :3].reshape(-1, 3)"
    return "not (n, 3): give one point per row, x y z"


def _as_floats(points: object, name: str) -> np.ndarray:
    if isinstance(points, str | os.PathLike):
        raise ValueError(
            f"{name} is {str(points)!r}: give its points, as jaxreg.read_cloud({str(points)!r}) reads."
        )
    if isinstance(points, Tracer):
        raise ValueError(
            f"{name} is traced, but this function runs on the host: under jit, grad or vmap use "
            "jaxreg.register_global, or jaxreg.gicp from a start."
        )
    try:
        array = np.asarray(points)
    except Exception as error:  # noqa: BLE001 - tensors raise what their libraries choose
        raise ValueError(
            f"{name} is not an array ({error}): give an array of shape (n, 3)."
        ) from None
    if array.dtype.kind == "O" and array.ndim == 2:
        with contextlib.suppress(ValueError, TypeError):
            array = array.astype(np.float64)
    if array.dtype.kind == "O" and array.ndim == 0:
        raise ValueError(
            f"{name} is a {type(points).__name__}, without an attribute .points to read: give an array "
            "of shape (n, 3)."
        )
    if array.dtype.kind not in "fiu":
        raise ValueError(
            f"{name} has dtype {array.dtype}: give real numbers, for example "
            "numpy.asarray(points, numpy.float64)."
        )
    return array.astype(np.float64)


def check_normals(
    normals: object, kept: Bool[np.ndarray, "n"], name: str
) -> Float[np.ndarray, "n 3"]:
    """Unit normals of a cloud, one row per row of the cloud; a zero normal stays zero.

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
    """A pose of `pose_parts` as a float64 transform with an orthogonal rotation.

    Raises:
      ValueError: it is none, or not finite, or not rigid.
    """
    rotation, translation = pose_parts(pose, name)
    if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        raise ValueError(f"{name} contains NaN or infinity: give a finite transform.")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise ValueError(
            f"{name} is not a rigid transform (its 3x3 part must be orthogonal with "
            "determinant +1): remove scale, shear and mirroring."
        )
    return RigidTransform(nearest_rotation(rotation), translation)


def pose_parts(pose: object, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3,) of a 4x4 matrix, a `RigidTransform` or a result, unchecked.

    Raises:
      ValueError: it is none of these, or of many poses.
    """
    if not (hasattr(pose, "rotation") and hasattr(pose, "translation")):
        return _parts_of_matrix(pose, name)
    rotation, translation = (np.asarray(x, np.float64) for x in (pose.rotation, pose.translation))  # pyright: ignore[reportAttributeAccessIssue]
    if rotation.shape != (3, 3) or translation.shape != (3,):
        raise ValueError(
            f"{name} has a rotation of shape {rotation.shape} and a translation of shape "
            f"{translation.shape}: give one pose, (3, 3) and (3,)."
        )
    return rotation, translation


def _parts_of_matrix(pose: object, name: str) -> tuple[np.ndarray, np.ndarray]:
    try:
        matrix = np.asarray(pose, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is not numeric: give a 4x4 matrix [[R, t], [0, 1]].") from None
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


def sizes_of_pair(sizes: Sequence[int]) -> list[int]:
    """The larger of the padded sizes of two clouds for both, unless it is far larger.

    So few programs are compiled, and none takes much longer than it must.
    """
    return list(sizes) if max(sizes) > 2 * min(sizes) else 2 * [max(sizes)]


def padded_size(count: int, *, smallest: int) -> int:
    """The smallest ``smallest * 2^k`` of at least `count`: every size compiles its own programs."""
    size = smallest
    while size < count:
        size *= 2
    return size
