"""KISS-Matcher (Lim et al., 2025): global registration by pruned feature matches."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxreg.evaluation.baselines import open3d
from jaxreg.evaluation.baselines.library import library
from jaxreg.evaluation.baselines.open3d import SPACING
from jaxreg.geometry.clouds import check_points
from jaxreg.types import RigidTransform


def icp(
    source: Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"], *, spacing=SPACING
) -> RigidTransform:
    """KISS-Matcher with voxels of `spacing`, else its defaults, then Open3D's point-to-plane ICP.

    The matcher returns a pose from features, unrefined; the refinement here is that of
    `open3d_ransac_icp`. It runs on several threads, so the same call may give another pose.

    Raises:
      ValueError: a cloud is not finite, not (n, 3) or has fewer than three points; or KISS-Matcher or
        Open3D is not installed.
    """
    module = require()
    if not spacing > 0:
        raise ValueError(f"spacing = {spacing} must be positive: the distance between points.")
    x, _ = check_points(source, "source")
    y, _ = check_points(reference, "reference")
    matcher = module.KISSMatcher(module.KISSMatcherConfig(spacing))
    found = matcher.estimate(x.astype(np.float32), y.astype(np.float32))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = found.rotation, np.ravel(found.translation)
    return open3d.refined(x, y, pose, spacing=spacing)


def require() -> Any:
    """The module `kiss_matcher`.

    Raises:
      ValueError: it or Open3D is not installed.
    """
    open3d.require()
    return library("kiss_matcher", "KISS-Matcher")
