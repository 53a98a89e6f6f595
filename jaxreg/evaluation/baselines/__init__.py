"""Registration without learning, by the libraries that people use, on the same pairs."""

import functools
import math
from collections.abc import Callable

import numpy as np

from jaxreg.types import RigidTransform


def choose(name: str) -> Callable[[np.ndarray, np.ndarray], RigidTransform]:
    """The baseline of a name, such as "open3d_fgr": a function of two clouds (n, 3), (m, 3).

    "open3d_fgr@0.02" sets the `spacing` that its lengths derive from, in the unit of the clouds.

    Raises:
      ValueError: no baseline has this name, the spacing is no positive number, or the library it
        needs is not installed.
    """
    name, _, spacing = name.partition("@")
    # Imported here: config and metrics must not wait seconds for Open3D, nor need it.
    from jaxreg.evaluation.baselines import open3d, small_gicp

    functions = {
        "open3d_icp": open3d.icp,
        "open3d_icp_point_to_plane": open3d.icp_point_to_plane,
        "open3d_icp_coarse_to_fine": open3d.icp_coarse_to_fine,
        "open3d_fgr": open3d.fgr,
        "open3d_fgr_icp": open3d.fgr_icp,
        "open3d_fgr_gicp": open3d.fgr_gicp,
        "open3d_fpfh_ransac": open3d.fpfh_ransac,
        "open3d_ransac_icp": open3d.ransac_icp,
        "open3d_ransac_gicp": open3d.ransac_gicp,
        "small_gicp": small_gicp.gicp,
    }
    if name not in functions:
        raise ValueError(f"no classical baseline '{name}': choose one of {', '.join(functions)}.")
    (small_gicp if name == "small_gicp" else open3d).require()
    return (
        functools.partial(functions[name], spacing=_positive(spacing))
        if spacing
        else functions[name]
    )


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise ValueError(f"the spacing of a baseline must be a positive number, got '{text}'.")
    return value
