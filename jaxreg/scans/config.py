"""The settings of `jaxreg.register`."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class RegisterConfig:
    """Registration of two scans on the host (`jaxreg.register`)."""

    search_points: int = 1024
    """Most points of a cloud in the search for a pose; larger clouds are averaged in voxels."""
    learned: bool = False
    """Match points by learned features in place of the moments that these read: more true matches,
    and a few crops more of a hundred, for a quarter more of the time."""
    limited_deg: float = 80.0
    """Largest rotation between two clouds that `rotation = "limited"` looks for."""
    reach: float = 1.5
    """A point agrees with the other cloud when it is within this many spacings of it (those of the
    clouds reduced to `search_points`)."""
    refine_points: int = 4096
    """Most points of a cloud in the refinement."""
    refine_iterations: int = 10
    """Most iterations of the refinement."""
    refine_anneal: float = 8.0
    """How many times wider its kernel is in the first iteration than in the last."""
    refine_neighbors: int = 16
    """Neighbours of a point that its normal is computed from."""
    refine_thickness: float = 0.01
    """Variance across a surface, in units of the variance along it."""
    refine_reach: float = 2.0
    """Largest distance of its pairs, in spacings of the clouds that it has."""
    refine_edges: bool = True
    """Surfaces end, and where both do their edges must meet."""
