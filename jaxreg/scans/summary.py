"""A registration in words and numbers: for the terminal, for the page, and for other programs."""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxreg.graph import se3
from jaxreg.io.poses import Edges
from jaxreg.scans.many import Alignment
from jaxreg.scans.relation import Relation
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
    return _plain(values)


def alignment_verdict(alignment: Alignment) -> str:
    """How many scans are placed, in how many groups, and how sure the least sure one is."""
    count, groups = len(alignment.translation), alignment.groups
    if not groups:
        return "no two scans hang together"
    if len(groups) > 1:
        sizes = " and ".join(str(len(group)) for group in groups)
        return f"{len(groups)} groups that do not hang together, of {sizes} scans"
    least = min(float(alignment.probability[k]) for k in groups[0])
    placed = len(groups[0])
    which = f"all {count} scans placed" if placed == count else f"{placed} of {count} scans placed"
    chance = "above 0.99" if least > 0.99 else f"{math.floor(100 * least) / 100:.2f} or more"
    return f"{which} (the probability of each is {chance})"


def alignment_figures(alignment: Alignment) -> dict[str, str]:
    """What a reader wants to know of an alignment, as text."""
    used = [pair for pair in alignment.pairs if pair.used]
    sure = [p for p in alignment.pairs if not p.used and p.relation.success]
    figures = {"pairs": f"{len(alignment.pairs)} registered, {len(used)} used"}
    if sure:
        figures["pairs"] += f", {len(sure)} refused although a success by themselves"
    for step in alignment.steps:
        gain = f"surfaces {step.before:.4g} apart before, {step.after:.4g} after"
        figures.setdefault("joint refinement", gain + ("" if step.kept else "; undone"))
    deviations = np.sqrt(np.maximum(np.einsum("kii->ki", alignment.covariance), 0))
    if np.isfinite(deviations).any():
        turn = math.degrees(np.nanmax(deviations[:, :3]))
        figures["one sigma"] = f"up to {turn:.2g} deg, {np.nanmax(deviations[:, 3:]):.2g}"
    return figures


def alignment_record(alignment: Alignment, names: list[str]) -> dict[str, Any]:
    """An alignment as plain values for JSON: `poses` is what ``--initial`` reads back."""
    matrices = alignment.transformation
    placed = np.isfinite(matrices).all(axis=(1, 2))
    scans = [
        {
            "file": name,
            "placed": bool(placed[k]),
            "group": next((g for g, group in enumerate(alignment.groups) if k in group), None),
            "probability": float(alignment.probability[k]),
            "covariance": _plain(alignment.covariance[k]) if placed[k] else None,
            "reason": alignment.reasons[k],
        }
        for k, name in enumerate(names)
    ]
    pairs = [
        {
            "source": names[p.relation.source],
            "reference": names[p.relation.reference],
            "used": p.used,
            "probability": p.probability,
            "probability_alone": p.relation.probability,
            "overlap": p.relation.overlap,
            "how": p.relation.how,
            "transformation": p.relation.transformation.tolist(),
            "reason": p.reason,
        }
        for p in alignment.pairs
    ]
    poses = zip(names, matrices, placed, strict=True)
    return {
        "success": alignment.success,
        "poses": {name: m.tolist() if there else None for name, m, there in poses},
        "groups": [[names[k] for k in group] for group in alignment.groups],
        "scans": scans,
        "pairs": pairs,
        "joint_refinement": [step._asdict() for step in alignment.steps],
    }


def edges(alignment: Alignment) -> Edges:
    """The used pairs as edges of a pose graph, with their information, for g2o.

    A covariance that is not known counts as 1. It is of a motion of the source's frame.
    """
    used = [pair.relation for pair in alignment.pairs if pair.used]
    matrices = np.array([r.transformation for r in used]).reshape(-1, 4, 4)
    information = np.array(
        [_information(r, alignment.centres[r.reference]) for r in used], np.float64
    ).reshape(-1, 6, 6)
    ends = ([getattr(r, name) for r in used] for name in ("source", "reference"))
    return Edges(*(np.array(end, np.int64) for end in ends), matrices, information)


def _information(relation: Relation, centre: np.ndarray) -> np.ndarray:
    """The inverse covariance of a motion of the source's frame, from one about the reference's centre."""
    if not np.isfinite(relation.covariance).all():
        return np.eye(6)
    away = np.eye(6)
    away[3:, :3] = se3.skew(centre)
    carried = se3.adjoint(se3.inverted(relation.transform)) @ away
    return np.linalg.inv(carried @ relation.covariance @ carried.T)


def listed(names: list[str], most: int) -> str:
    """Names, the first and the last if there are many."""
    if len(names) <= most:
        return ", ".join(names)
    return ", ".join([*names[: most - 1], f"... ({len(names)} in all)", names[-1]])


def _alternatives(result: ScanRegistration) -> str:
    """The other poses that may be right, and how likely each is."""
    listed = [
        f"{other.probability:.2f} turned by "
        f"{math.degrees(axis_angle(other.transform.rotation @ result.rotation.T)[1]):.0f} deg"
        for other in result.alternatives
        if other.probability >= _MENTIONED
    ]
    return "; ".join(listed) or "none that may be right"


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
    """Unit axis, and angle in [0, pi]; the z axis if nothing turns."""
    from scipy.spatial.transform import Rotation  # start-up of programs that only import this

    vector = Rotation.from_matrix(rotation).as_rotvec()
    angle = float(np.linalg.norm(vector))
    return (vector / angle, angle) if angle > 0 else (np.array([0.0, 0.0, 1.0]), 0.0)
