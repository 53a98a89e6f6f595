"""A registration in words and numbers: for the terminal, for the page, and for other programs."""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxreg.scans.result import ScanRegistration

_PER_POINT = ("confidence", "correspondences")
_MENTIONED = 0.05
"""Probability from which another pose is mentioned."""
_UNKNOWN = "not known: nothing was refined, or no surfaces are within reach"


def verdict_line(result: ScanRegistration) -> str:
    """Success or failure, in words, with the probability."""
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
    size = (
        {"scale": f"{result.scale:.6g} +- {result.scale_sigma:.2g}"} if result.scale_sigma else {}
    )
    return {
        "rotation": f"{angle:.3f} deg",
        "translation": ", ".join(f"{x:.9g}" for x in result.translation),
        **size,
        "overlap": f"{result.overlap:.2f}",
        "fitness": f"{result.fitness:.2f} within {result.max_correspondence_distance:.4g}",
        "inlier rmse": f"{result.inlier_rmse:.4g}",
        "one sigma": f"{turn:.2g} deg, {shift:.2g}" if known else _UNKNOWN,
        "weak directions": "\n".join(direction.name for direction in result.weak_directions)
        or ("none" if known else _UNKNOWN),
        "converged": {True: "yes", False: "no", None: "not refined"}[result.converged],
        "alternatives": _alternatives(result),
        "dropped points": str(result.dropped),
    }


def record(result: ScanRegistration) -> dict[str, Any]:
    """The result as plain values for JSON, without its rows per point; NaN and infinity are None.

    `mean_confidence` stands for the rows of `confidence`.
    """
    values = {
        field.name: getattr(result, field.name)
        for field in dataclasses.fields(result)
        if field.name not in _PER_POINT
    }
    weak = [{"name": found.name} | found._asdict() for found in result.weak_directions]
    values |= {"weak_directions": weak, "mean_confidence": float(np.mean(result.confidence))}
    return plain(values)


def _alternatives(result: ScanRegistration) -> str:
    """The other poses that may be right, and how likely each is."""
    listed = [
        f"{other.probability:.2f} turned by "
        f"{math.degrees(axis_angle(other.transform.rotation @ result.rotation.T)[1]):.0f} deg"
        for other in result.alternatives
        if other.probability >= _MENTIONED
    ]
    return "; ".join(listed) or "none that may be right"


def plain(value: Any) -> Any:
    """Records, arrays and numbers as lists, dicts and numbers for JSON; NaN and infinity are None."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, dict):
        return {name: plain(part) for name, part in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def matrix_text(matrix: Float[np.ndarray, "4 4"]) -> str:
    """Four lines, 12 digits: what ``--initial`` reads back."""
    rows = ("".join(f"{value: .12g}".ljust(20) for value in row).rstrip() for row in matrix)
    return "\n".join(rows)


def axis_angle(rotation: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Unit axis, and angle in [0, pi]; the z axis if nothing turns."""
    from scipy.spatial.transform import Rotation  # start-up of programs that only import this

    vector = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return (vector / angle, angle) if angle > 0 else (np.array([0.0, 0.0, 1.0]), 0.0)
