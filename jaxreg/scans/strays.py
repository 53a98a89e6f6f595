"""Points that lie far from all others: rows of zeros among map coordinates, birds, reflections.

One of them, far enough away, would decide where the centre of a cloud is and how large it is.
"""

import numpy as np
from jaxtyping import Bool, Float

_SHARE = 0.02
"""Strays are at most so many of the points, or one."""
_FAR = 10.0
"""They lie so many times farther from the middle than all that are none. Scanners see a few points
far off, but seldom that far."""
_FEWEST = 20
"""Of fewer points none is a stray: one target may well lie far from two others."""


def strays(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, "n"]:
    """Which of the distinct points of a cloud are strays. All points are finite.

    A place counts once, however many rows have it: what did not come back is often written as zeros.
    """
    if len(points) < _FEWEST:
        return np.zeros(len(points), bool)
    distance = _from_middle(points)
    most = max(1, int(_SHARE * len(points)))
    rest = float(np.partition(distance, len(points) - 1 - most)[len(points) - 1 - most])
    return distance > _FAR * rest


def told(points: Float[np.ndarray, "n 3"], found: Bool[np.ndarray, "n"]) -> str:
    """How many strays there are, and how far they lie off, in a sentence without its end."""
    distance = _from_middle(points)
    far, rest = distance[found], 2 * float(distance[~found].max())
    count = "1 point lies" if len(far) == 1 else f"{len(far):,} points lie"
    span = f"{far.min():.3g}"
    if f"{far.max():.3g}" != span:
        span += f" to {far.max():.3g}"
    return f"{count} {span} from the rest, which is {rest:.3g} across"


def _from_middle(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - np.median(points, axis=0), axis=1)
