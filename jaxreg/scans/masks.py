"""Which points take part, and how much they count, for callers who know what moved."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxreg.scans.prepare import Prepared


def masks_of(mask: object, counts: tuple[int, int]) -> tuple[Bool[np.ndarray, "n"], ...]:
    """The masks of source and reference: one is of the source, a pair is of both (None: all points).

    Raises:
      ValueError: a mask is not of booleans, one for each row of its cloud.
    """
    pair = mask if isinstance(mask, tuple | list) and len(mask) == 2 else (mask, None)
    return tuple(
        _mask(part, count, name)
        for part, count, name in zip(pair, counts, ("source", "reference"), strict=True)
    )


def _mask(mask: object, count: int, name: str) -> Bool[np.ndarray, "n"]:
    if mask is None:
        return np.ones(count, bool)
    array = np.asarray(mask)
    if array.dtype != bool or array.shape != (count,):
        raise ValueError(
            f"the mask of the {name} is {array.dtype} {array.shape}: give {count} booleans, one for "
            "each of its points (True: the point takes part), or a pair of masks (source, reference)."
        )
    return array


def check_enough(taking_part: Bool[np.ndarray, "n"], name: str) -> None:
    """Raise ValueError unless three points take part, which are neither masked nor dropped."""
    if taking_part.sum() < 3:
        raise ValueError(
            f"mask and weights leave {taking_part.sum()} points of the {name} that are finite and no "
            "strays: a pose needs 3."
        )


def weights_of(weights: object, count: int) -> Float[np.ndarray, "n"]:
    """How much every point of the source counts, of the one that counts most.

    Raises:
      ValueError: not a finite number of 0 or more for each row.
    """
    try:
        array = np.asarray(weights, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape != (count,):
        raise ValueError(
            f"weights must be {count} numbers of 0 or more, one for each point of the source, got "
            f"shape {array.shape}."
        )
    wrong = ~(np.isfinite(array) & (array >= 0))
    if wrong.any():
        row = int(np.argmax(wrong))
        raise ValueError(f"weight {row} is {array[row]}: give finite numbers of 0 or more.")
    return array / (array.max() or 1.0)


def of_points(values: Float[np.ndarray, "n"], cloud: Prepared) -> Float[np.ndarray, "p"]:
    """The mean of the values of the rows that are one of the distinct points, for each of these."""
    count = np.bincount(cloud.row, minlength=len(cloud.points))
    return np.bincount(cloud.row, values[cloud.kept], len(cloud.points)) / np.maximum(count, 1)


def in_box(points: Float[np.ndarray, "n 3"], box: Sequence[float]) -> Bool[np.ndarray, "n"]:
    """Which points lie in a box ``(x0, y0, x1, y1)`` or ``(x0, y0, z0, x1, y1, z1)``.

    Raises:
      ValueError: it is neither, or a first corner lies beyond the second.
    """
    half = len(box) // 2
    if len(box) not in (4, 6) or any(a >= b for a, b in zip(box[:half], box[half:], strict=True)):
        raise ValueError(
            f"a box is x0,y0,x1,y1 or x0,y0,z0,x1,y1,z1 with x0 < x1 and so on, got {tuple(box)}."
        )
    low, high = np.array(box[:half]), np.array(box[half:])
    return np.all((points[:, :half] >= low) & (points[:, :half] <= high), axis=1)
