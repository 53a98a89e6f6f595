"""The settings of `jaxreg.register`."""

import dataclasses

from jaxreg.refine.config import RefineConfig
from jaxreg.search.config import SearchConfig


@dataclasses.dataclass(frozen=True)
class RegisterConfig:
    """Registration of two scans on the host (`jaxreg.register`)."""

    search: SearchConfig = SearchConfig()
    """The search for a pose, where no start is given."""
    refine: RefineConfig | None = RefineConfig(
        iterations=10,
        kernel_annealing=8.0,
        both_directions=True,
        k=16,
        epsilon=0.01,
        edges=True,
    )
    """The refinement of what the search finds, or of the start; None leaves it as it is."""
    search_points: int = 1024
    """Most points of a cloud in the search and in the verdict; larger clouds are averaged in voxels."""
    refine_points: int = 4096
    """Most points of a cloud in the refinement."""
    learned: bool = False
    """Match points by learned features in place of the moments that these read: finds 1 to 4 % more
    pairs at 70 % overlap, and takes a quarter longer."""
    inlier_spacings: float = 1.5
    """A point agrees with the other cloud within this many spacings of it, those of the clouds reduced
    to `search_points`."""
    refine_spacings: float = 2.0
    """Largest distance of corresponding points in the refinement, in spacings of the clouds it has,
    where `refine.max_correspondence_distance` says nothing else."""
