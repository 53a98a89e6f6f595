"""The settings of a refinement, and their check."""

import dataclasses
import math
from typing import Literal, get_args

import numpy as np

from jaxreg.geometry import arguments

Method = Literal["icp", "point_to_plane", "gicp"]
Kernel = Literal["none", "huber", "cauchy", "geman_mcclure", "gaussian"]
Gradient = Literal["unrolled", "implicit"]


@dataclasses.dataclass(frozen=True)
class RefineConfig:
    """Settings of `icp`, `point_to_plane`, `gicp` and `refine`.

    Hashable: give it to `jax.jit` as a static argument. The functions also take as arrays what
    changes from call to call: the largest distance and the width of the kernel.
    """

    method: Method = "gicp"
    """The method of `refine`: point to point, point to plane, or generalised (plane to plane). The
    functions `icp`, `point_to_plane` and `gicp` ignore it."""
    iterations: int = 30
    """Number of iterations, each with new correspondences."""
    max_correspondence_distance: float = math.inf
    """Pairs that are farther apart than this (unit of the clouds) do not count."""
    trim: float = 1.0
    """Share of the closest pairs that count."""
    kernel: Kernel = "geman_mcclure"
    """Robust weight of the pairs; "none" is plain least squares."""
    kernel_annealing: float = 10.0
    """How many times wider the kernel is in the first iteration than in the last (graduated
    non-convexity)."""
    both_directions: bool = False
    """Also pair every reference point with its nearest source point."""
    k: int = 10
    """How many neighbours of a point its normal is computed from."""
    epsilon: float = 1e-3
    """Variance across a surface, in units of the variance along it (generalised ICP)."""
    correspondences_per_point: int = 1
    """Partners of a point: the nearest and its neighbours. Several planes locate a noisy surface
    better than one does (generalised ICP)."""
    edges: bool = False
    """Also match the edges where open surfaces end (generalised ICP)."""
    tolerance: float = 1e-5
    """Converged when the last step turned by less (radians) and moved by less (radii of the
    clouds). A kernel that narrows until the end moves the pose until the end: if you need a fixed
    point, as for "implicit", let it start narrow (`kernel_annealing` 1) and take more
    iterations."""
    gradient: Gradient = "unrolled"
    """How to differentiate the pose; its value is the same.

    "unrolled" goes back through every iteration: exact for the iterations that were made, whether
    they converged or not, and for second derivatives; memory grows with their number. "implicit"
    applies the implicit function theorem at the pose found: memory and time of one iteration, and
    the gradient of the *solution*, correct if the iterations converged. Use it inside training and
    with many iterations. A motion that the pairs leave free keeps the derivative of the start.
    Second derivatives of "implicit" are not those of the solution."""

    def __post_init__(self) -> None:
        """Make plain numbers of NumPy's, whose dtype would enter into float32 computations."""
        for name, value in vars(self).items():
            if isinstance(value, np.generic):
                object.__setattr__(self, name, value.item())


def check_options(config: RefineConfig) -> None:
    """Raise ValueError, with the value and what to choose instead, if a setting is out of range."""
    arguments.settings("config", config, RefineConfig)
    for name in ("iterations", "k", "correspondences_per_point"):
        arguments.count(name, getattr(config, name))
    for name, choices in (("method", Method), ("kernel", Kernel), ("gradient", Gradient)):
        if getattr(config, name) not in get_args(choices):
            raise ValueError(
                f"{name} '{getattr(config, name)}' does not exist: choose "
                f"{', '.join(get_args(choices))}."
            )
    most = config.k + 1
    for name, sensible, remedy in (
        ("iterations", config.iterations >= 1, "choose at least 1"),
        ("max_correspondence_distance", config.max_correspondence_distance > 0,
         "choose a positive distance, or infinity for no limit"),
        ("trim", 0 < config.trim <= 1, "choose a share of the pairs, 0 < trim <= 1"),
        ("kernel_annealing", config.kernel_annealing >= 1,
         "choose 1 or more: the first kernel must not be narrower than the last"),
        ("k", config.k >= 2, "choose at least 2: a plane needs a point and two neighbours"),
        ("epsilon", 0 < config.epsilon <= 1, "choose 0 < epsilon <= 1"),
        ("correspondences_per_point", 1 <= config.correspondences_per_point <= most,
         f"choose 1 to k + 1 = {most}, because the others are neighbours of the first"),
        ("tolerance", config.tolerance >= 0, "choose 0 or more"),
    ):  # fmt: skip
        if not sensible:
            raise ValueError(f"{name} = {getattr(config, name)}: {remedy}.")
