"""The settings of `jaxreg.register`."""

import dataclasses
import math

from jaxreg.geometry import arguments
from jaxreg.refine.config import RefineConfig, check_options
from jaxreg.search.config import SearchConfig


@dataclasses.dataclass(frozen=True)
class RegisterConfig:
    """Settings of `jaxreg.register`, for two scans on the host."""

    search: SearchConfig = SearchConfig()
    """The search for a pose, used if no start is given."""
    wide: SearchConfig | None = SearchConfig(
        candidates=1024, seeds=1024, screened=512, aligned=32, judged=True
    )
    """A second search, with learned features, if the first leaves doubts; None: there is none."""
    refine: RefineConfig | None = RefineConfig(
        iterations=5,
        kernel_annealing=8.0,
        both_directions=True,
        k=16,
        epsilon=0.01,
        edges=True,
        tolerance=5e-5,
    )
    """The refinement of the pose that the search finds, or of the start; None leaves it as it is. A
    pose that still moves at the end is refined on until it stands still."""
    search_points: int = 1024
    """The search, and the overlap that is told, use at most this many points of a cloud; larger clouds
    are averaged in voxels."""
    refine_points: int = 4096
    """The refinement and the verdict use at most this many points of a cloud."""
    learned: bool = False
    """Match points by learned features, computed from the moments: finds a few more crops, and takes
    half as long again or more (RESULTS.md)."""
    inlier_spacings: float = 1.5
    """A point counts as overlapping within this many spacings of the other cloud (spacing after
    reduction to `search_points`)."""
    refine_spacings: float = 2.0
    """Largest distance of corresponding points in the refinement, in spacings of its clouds, unless
    `refine.max_correspondence_distance` is set."""
    halves: bool = True
    """Refine halves of the overlap, too, and widen the covariance where their poses differ by more than
    it says (docs/notes/0064). False: it is that of the residuals alone, and a call is 35 ms faster."""


_LEAST = {"search_points": 16, "refine_points": 16}
"""The smallest allowed value of these settings; the others must be positive."""


def checked(config: RegisterConfig | None) -> RegisterConfig:
    """The settings, the defaults for None.

    Raises:
      ValueError: they are of another class, or one is out of range.
    """
    if config is None:
        return RegisterConfig()
    arguments.settings("config", config, RegisterConfig)
    for name in ("search_points", "refine_points", "inlier_spacings", "refine_spacings"):
        value, least = getattr(config, name), _LEAST.get(name, 0)
        if not (least <= value < math.inf and value > 0):
            bound = f"at least {least}" if least else "positive"
            raise ValueError(f"config.{name} must be {bound} and finite, got {value}.")
    if config.refine is not None:
        check_options(config.refine)  # an error for any clouds, also where none is refined
    return config
