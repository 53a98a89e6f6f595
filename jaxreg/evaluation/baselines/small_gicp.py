"""Generalised ICP of small_gicp (Koide, 2024): the fastest local method on a CPU."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxreg.evaluation.baselines.library import library
from jaxreg.evaluation.baselines.open3d import SPACING
from jaxreg.geometry.clouds import check_points
from jaxreg.types import RigidTransform

_ITERATIONS, _TOLERANCE = 100, 1e-6
"""The library's own tolerances, 0.1 degrees and 1 mm, are those of a vehicle."""


def gicp(
    source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"], *, spacing=SPACING
) -> RigidTransform:
    """Generalised ICP from the identity, with pairs within 10 times, then 0.6 times `spacing`.

    Clouds are thinned to 0.2 times `spacing`. Single-threaded, so the same call gives the same
    transform.

    Raises:
      ValueError: a cloud is not finite, not (n, 3) or has fewer than three points; or small_gicp is
        not installed.
    """
    module = require()
    if not spacing > 0:
        raise ValueError(f"spacing = {spacing} must be positive: the distance between points.")
    target, tree = _prepared(module, reference, "reference", spacing)
    moving, _ = _prepared(module, source, "source", spacing)
    pose = np.eye(4)
    for distance in (10 * spacing, 0.6 * spacing):
        pose = module.align(
            target,
            moving,
            tree,
            pose,
            max_correspondence_distance=distance,
            max_iterations=_ITERATIONS,
            rotation_epsilon=_TOLERANCE,
            translation_epsilon=_TOLERANCE,
        ).T_target_source
    return RigidTransform(pose[:3, :3].copy(), pose[:3, 3].copy())


def _prepared(module: Any, points: np.ndarray, name: str, spacing: float) -> tuple[Any, Any]:
    points, _ = check_points(points, name)
    return module.preprocess_points(points, downsampling_resolution=0.2 * spacing)


def require() -> Any:
    """The module `small_gicp`.

    Raises:
      ValueError: it is not installed.
    """
    return library("small_gicp", "small_gicp")
