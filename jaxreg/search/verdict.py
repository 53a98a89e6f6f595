"""Whether two clouds agree under a pose, and the calibrated chance that the pose is right."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxreg.search.host import Coarse
from jaxreg.types import RigidTransform

TRUSTED = 0.5
"""Probability from which a registration counts as a success."""
_PARALLEL = 0.9
"""Normals within 26 degrees of each other agree."""


class Evidence(NamedTuple):
    """What tells a right pose from a wrong one; plain numbers without unit.

    `overlap` is the share of the points of both clouds within reach of the other cloud, `smaller`
    that of the cloud with the smaller share. `flatness` is the median distance of such points to the
    plane of their partner, in reaches; `parallel` the share of them whose normals agree.
    `constraint` is the smallest mean square change of those distances by a unit motion.
    """

    overlap: float
    smaller: float
    flatness: float
    parallel: float
    constraint: float


def evidence(pose: RigidTransform, source: Coarse, reference: Coarse, reach: float) -> Evidence:
    """The evidence for one pose, from every point of both coarse clouds."""
    rotation, translation = pose
    x, y = source.valid, reference.valid
    x_normals, y_normals = source.normals[: len(x)] @ rotation.T, reference.normals[: len(y)]
    moved, back = x @ rotation.T + translation, (y - translation) @ rotation
    distance, index = reference.tree.query(moved, workers=-1)
    other_distance, other_index = source.tree.query(back, workers=-1)
    near, other_near = distance < reach, other_distance < reach
    shares = near.mean(), other_near.mean()
    across = np.concatenate(
        [
            np.abs(np.sum((moved - y[index]) * y_normals[index], axis=1))[near],
            np.abs(np.sum((y - moved[other_index]) * x_normals[other_index], axis=1))[other_near],
        ]
    )
    cosine = np.concatenate(
        [
            np.abs(np.sum(x_normals * y_normals[index], axis=1))[near],
            np.abs(np.sum(y_normals * x_normals[other_index], axis=1))[other_near],
        ]
    )
    return Evidence(
        overlap=float(np.mean(np.concatenate([near, other_near]))),
        smaller=float(min(shares)),
        flatness=float(np.median(across) / reach) if len(across) else 1.0,
        parallel=float(np.mean(cosine > _PARALLEL)) if len(cosine) else 0.0,
        constraint=_constraint(moved[near], y_normals[index][near]),
    )


def _constraint(points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"]) -> float:
    """Smallest eigenvalue of the mean of ``J^T n n^T J`` about the points' centroid."""
    if len(points) < 6:
        return 0.0
    centred = points - points.mean(axis=0)
    radius = np.sqrt(np.mean(np.sum(centred**2, axis=1)))
    if radius == 0:
        return 0.0
    rows = np.concatenate([np.cross(centred / radius, normals), normals], axis=1)
    return float(np.linalg.eigvalsh(rows.T @ rows / len(rows))[0])


def probability(found: Evidence) -> float:
    """The chance that the pose is right (a logistic regression; the constants' origin is below)."""
    inputs = features(found)
    return float(1 / (1 + np.exp(-np.clip(_INTERCEPT + inputs @ _COEFFICIENTS, -50, 50))))


def features(found: Evidence) -> Float[np.ndarray, "5"]:
    """The inputs of the regression; small constraints are told apart by their logarithm."""
    return np.array(
        [
            found.overlap,
            found.smaller,
            found.flatness,
            found.parallel,
            np.log10(max(found.constraint, 1e-6)),
        ]
    )


_INTERCEPT = -4.0
_COEFFICIENTS = np.array([4.0, 4.0, -6.0, 4.0, 0.0])
"""To be fitted by benchmarks/calibrate_success.py."""
