"""Registration without learning, by widely used libraries, on the same pairs."""

import functools
import importlib
import math
from collections.abc import Callable

import numpy as np

from jaxreg.types import RigidTransform

_OPEN3D = {
    "open3d_icp": ("icp", {}),
    "open3d_icp_point_to_plane": ("icp", {"to_plane": True}),
    "open3d_icp_coarse_to_fine": ("icp", {"fine": True}),
    "open3d_fgr": ("from_features", {"coarse": "fgr", "refinement": "none"}),
    "open3d_fgr_icp": ("from_features", {"coarse": "fgr", "refinement": "icp"}),
    "open3d_fgr_icp_default": ("from_features", {"coarse": "fgr_default", "refinement": "icp"}),
    "open3d_fgr_gicp": ("from_features", {"coarse": "fgr", "refinement": "gicp"}),
    "open3d_fpfh_ransac": ("from_features", {"coarse": "ransac", "refinement": "none"}),
    "open3d_ransac_icp": ("from_features", {"coarse": "ransac", "refinement": "icp"}),
    "open3d_ransac_gicp": ("from_features", {"coarse": "ransac", "refinement": "gicp"}),
}
_FUNCTIONS = {name: ("open3d", *rest) for name, rest in _OPEN3D.items()} | {
    "small_gicp": ("small_gicp", "gicp", {}),
    "kiss_matcher_icp": ("kiss_matcher", "icp", {}),
}
"""Module, function and options for every name."""
NAMES = tuple(_FUNCTIONS)
"""The names that `choose` takes, alone or with a spacing."""


def choose(name: str) -> Callable[[np.ndarray, np.ndarray], RigidTransform]:
    """The baseline by its name, such as "open3d_fgr": a function of two clouds (n, 3), (m, 3).

    "open3d_fgr@0.02" sets the `spacing` that its lengths derive from, in the unit of the clouds.

    Raises:
      ValueError: no baseline has this name, the spacing is not a positive number, or the library it
        needs is not installed.
    """
    name, at, spacing = name.partition("@")
    if name not in _FUNCTIONS:
        raise ValueError(f"no classical baseline '{name}': choose one of {', '.join(NAMES)}.")
    module_name, function_name, options = _FUNCTIONS[name]
    if at:
        options = options | {"spacing": _positive(spacing)}
    # Imported here: config and metrics must not need Open3D, nor wait seconds for it.
    module = importlib.import_module(f"{__name__}.{module_name}")
    module.require()
    return functools.partial(getattr(module, function_name), **options)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < math.inf:
        raise ValueError(f"the spacing of a baseline must be a positive number, got '{text}'.")
    return value
