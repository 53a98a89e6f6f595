"""The settings of a refinement."""

import dataclasses
import math
from typing import Literal


@dataclasses.dataclass(frozen=True)
class RefineConfig:
    """Refinement of a pose by the ICP family."""

    method: Literal["icp", "point_to_plane", "gicp"] = "gicp"
    """Point to point, point to plane, or generalised (plane to plane)."""
    iterations: int = 30
    """Iterations, each with fresh correspondences."""
    max_distance: float = math.inf
    """Pairs farther apart than this (unit of the clouds) do not count."""
    trim: float = 1.0
    """Share of the closest pairs that count."""
    kernel: Literal["none", "huber", "cauchy", "geman_mcclure", "gaussian"] = "geman_mcclure"
    """Robust weight of the pairs. (The function `icp` alone is plain unless told.)"""
    anneal: float = 10.0
    """How many times wider the kernel is in the first iteration than in the last."""
    both_directions: bool = False
    """Also pair every reference point with its nearest source point."""
    neighbors: int = 10
    """Neighbours of a point that its normal is computed from."""
    thickness: float = 1e-3
    """Variance across a surface, in units of the variance along it (generalised ICP)."""
    edges: bool = False
    """Surfaces end: their edges must meet, too (generalised ICP)."""
    weak_threshold: float = 0.01
    """A motion is weak when it changes the distances to the surfaces by a smaller mean square than
    this, for a motion of one (1/3 for surfaces that face all ways)."""
    dense_limit: int = 1024
    """Largest cloud, in points, whose pairs are found by brute force; above, by a tree on the host."""
    tolerance: float = 1e-5
    """The host stops when a step turns by less (radians) and moves by less (in radii of the cloud)."""
