"""A cloud as it is given: its one check, and its padding to one of few sizes."""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

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
    finite = np.isfinite(array).all(axis=1)
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
    huge = finite & (np.abs(np.where(finite[:, None], array, 0)) > _LARGEST).any(axis=1)
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
        raise ValueError(f"{name} is no array ({error}): give an array of shape (n, 3).") from None
    if array.dtype.kind not in "fiu":
        raise ValueError(
            f"{name} has dtype {array.dtype}: give real numbers, as in "
            "numpy.asarray(points, numpy.float64)."
        )
    return array.astype(np.float64)


def padded(
    points: Float[np.ndarray, "n 3"], size: int
) -> tuple[Float[np.ndarray, "size 3"], Bool[np.ndarray, "size"]]:
    """`points` as float32 filled up to `size` rows, and the mask of the valid ones."""
    rows = np.zeros((size, 3), np.float32)
    rows[: len(points)] = points
    return rows, np.arange(size) < len(points)


def bucket(count: int, *, smallest: int, largest: int) -> int:
    """The smallest size ``smallest * 2^k`` that holds `count`; at most `largest`."""
    size = smallest
    while size < count:
        size *= 2
    return min(size, largest)
