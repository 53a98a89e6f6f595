"""A registration in words and figures: for the terminal, for the page, and for other programs."""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxreg.scans.pair import ScanRegistration

_PER_POINT = ("confidence", "correspondences")
_UNKNOWN = "not known: nothing was refined, or no surfaces are within reach"


def verdict_line(result: ScanRegistration) -> str:
    """Success or not, in words, with the probability."""
    chance = f"probability {result.probability:.2f}"
    if result.success:
        return f"success ({chance})"
    return f"not trustworthy ({chance} that the pose is right)"


def figures(result: ScanRegistration) -> dict[str, str]:
    """What a reader wants to know, as text; angles in degrees, lengths in the unit of the input."""
    angle = math.degrees(axis_angle(result.rotation)[1])
    deviations = np.sqrt(np.maximum(np.diag(result.covariance), 0))
    turn, shift = math.degrees(deviations[:3].max()), deviations[3:].max()
    known = bool(np.isfinite(deviations).all())
    return {
        "rotation": f"{angle:.3f} deg",
        "translation": ", ".join(f"{x:.9g}" for x in result.translation),
        "overlap": f"{result.overlap:.2f}",
        "fitness": f"{result.fitness:.2f} within {result.reach:.4g}",
        "inlier rmse": f"{result.inlier_rmse:.4g}",
        "one sigma": f"{turn:.2g} deg, {shift:.2g}" if known else _UNKNOWN,
        "weak directions": "\n".join(result.weak_directions) or ("none" if known else _UNKNOWN),
        "dropped points": str(result.dropped),
        "time": f"{result.seconds:.2f} s",
    }


def record(result: ScanRegistration) -> dict[str, Any]:
    """The result as plain values for JSON, without its rows per point; NaN and infinity are None.

    `mean_confidence` stands for the rows of `confidence`.
    """
    values = {k: v for k, v in result._asdict().items() if k not in _PER_POINT}
    return _plain(values | {"mean_confidence": float(np.mean(result.confidence))})


def _plain(value: Any) -> Any:
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def matrix_text(matrix: Float[np.ndarray, "4 4"]) -> str:
    """Four lines, 12 digits: what ``--initial`` reads back."""
    rows = ("".join(f"{value: .12g}".ljust(20) for value in row).rstrip() for row in matrix)
    return "\n".join(rows)


def axis_angle(rotation: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Unit axis, and angle in [0, pi]; the z axis where nothing turns."""
    from scipy.spatial.transform import Rotation  # start-up of programs that only import this

    vector = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return (vector / angle, angle) if angle > 0 else (np.array([0.0, 0.0, 1.0]), 0.0)
