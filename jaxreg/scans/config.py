"""The settings of `jaxreg.register`."""

import dataclasses

from jaxreg.refine.config import RefineConfig
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
    """The search and the verdict use at most this many points of a cloud; larger clouds are
    averaged in voxels."""
    refine_points: int = 4096
    """The refinement uses at most this many points of a cloud."""
    learned: bool = False
    """Match points by learned features, computed from the moments: finds 1 to 4 % more pairs at 70
    % overlap, and takes a quarter longer."""
    inlier_spacings: float = 1.5
    """A point counts as overlapping within this many spacings of the other cloud (spacing after
    reduction to `search_points`)."""
    refine_spacings: float = 2.0
    """Largest distance of corresponding points in the refinement, in spacings of its clouds, unless
    `refine.max_correspondence_distance` is set."""
