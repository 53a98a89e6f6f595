"""An alignment of many scans in words and numbers: for the terminal, the page, and other programs."""

import math
from typing import Any

import numpy as np

from jaxreg.geometry import se3
from jaxreg.io.poses import Edges
from jaxreg.scans.many import Alignment
from jaxreg.scans.relation import Relation
from jaxreg.scans.summary import plain

_EXACT = 1e-6
"""Nothing is known better: one standard deviation in radians, and in reaches."""


def verdict(alignment: Alignment) -> str:
    """How many scans are placed, in how many groups, and how sure the least sure one is."""
    count, groups = len(alignment.translation), alignment.groups
    if not groups:
        return "no two scans hang together"
    if len(groups) > 1:
        sizes = " and ".join(str(len(group)) for group in groups)
        return f"{len(groups)} groups that do not hang together, of {sizes} scans"
    group = next(iter(groups))
    least, placed = min(float(alignment.probability[k]) for k in group), len(group)
    which = f"all {count} scans placed" if placed == count else f"{placed} of {count} scans placed"
    chance = "above 0.99" if least > 0.99 else f"{math.floor(100 * least) / 100:.2f} or more"
    return f"{which} (the probability of each is {chance})"


def figures(alignment: Alignment) -> dict[str, str]:
    """What a reader wants to know of an alignment, as text."""
    used = [pair for pair in alignment.pairs if pair.used]
    sure = [p for p in alignment.pairs if not p.used and p.relation.success]
    found = {"pairs": f"{len(alignment.pairs)} registered, {len(used)} used"}
    if sure:
        found["pairs"] += f", {len(sure)} refused although a success by themselves"
    for step in alignment.steps:
        gain = f"surfaces {step.before:.4g} apart before, {step.after:.4g} after"
        found.setdefault(
            "joint refinement", gain + ("" if step.kept else "; not kept, as it gained nothing")
        )
    deviations = np.sqrt(np.maximum(np.einsum("kii->ki", alignment.covariance), 0))
    if np.isfinite(deviations).any():
        turn = math.degrees(np.nanmax(deviations[:, :3]))
        found["one sigma"] = f"up to {turn:.2g} deg, {np.nanmax(deviations[:, 3:]):.2g}"
    return found


def record(alignment: Alignment, names: list[str]) -> dict[str, Any]:
    """An alignment as plain values for JSON: `poses` is what ``--initial`` reads back."""
    matrices = alignment.transformation
    placed = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    scans = [
        {
            "file": name,
            "placed": bool(placed[k]),
            "group": next((g for g, group in enumerate(alignment.groups) if k in group), None),
            "probability": float(alignment.probability[k]),
            "covariance": plain(alignment.covariance[k]) if placed[k] else None,
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

    A covariance that is not known counts as 1. It is of a motion of the source's frame. What a
    covariance says to be exact, as the motions out of the plane of planar scans, gets a floor.
    """
    used = [pair.relation for pair in alignment.pairs if pair.used]
    matrices = np.array([r.transformation for r in used]).reshape(-1, 4, 4)
    information = np.array(
        [_information(r, alignment.centres[r.reference]) for r in used], np.float64
    ).reshape(-1, 6, 6)
    source, reference = (
        np.array([getattr(r, name) for r in used], np.int64) for name in ("source", "reference")
    )
    return Edges(source, reference, matrices, information)


def _information(relation: Relation, centre: np.ndarray) -> np.ndarray:
    """The information of a motion of the source's frame, from one about the reference's centre."""
    if not np.isfinite(relation.covariance).all():
        return np.eye(6)
    reach = relation.max_correspondence_distance
    floor = _EXACT * np.repeat([1.0, reach if reach > 0 else 1.0], 3)
    information = np.linalg.inv(relation.covariance + np.diag(floor**2))
    # Carried after the inversion: far from the origin the lever arms would drown the rest.
    back = np.eye(6)
    back[3:, :3] = -se3.skew(centre)
    back = back @ se3.adjoint(relation.transform)
    return back.T @ information @ back


def listed(names: list[str], most: int) -> str:
    """Names, the first and the last if there are many."""
    if len(names) <= most:
        return ", ".join(names)
    return ", ".join([*names[: most - 1], f"... ({len(names)} in all)", names[-1]])
