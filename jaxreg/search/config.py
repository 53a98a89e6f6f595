"""The settings of the search."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Global registration of clouds that share no point (`jaxreg.search`).

    Lengths are in units in which a usual shape fills the unit sphere, angles in radians.
    """

    unit: float = 0.0
    """That unit, in the unit of the clouds. 0: twice the clouds' root mean square radius."""
    radii: tuple[float, ...] = (0.2, 0.4, 0.8)
    """Radii of the moment descriptors."""
    normal_radius: float = 0.15
    """Radius of the Gaussian neighbourhood of a normal."""
    matches: int = 3
    """Most similar points of every point that become candidates, in both directions."""
    candidates: int = 768
    """Candidates kept, the clearest first."""
    seeds: int = 512
    """Of these the first ones, which give a pose each."""
    partners: int = 12
    """Other candidates that a pose is computed from."""
    tolerance: float = 0.08
    """Change of a distance at which two candidates stop being compatible."""
    normal_tolerance: float = 0.3
    """The same for the cosines of normals and lines."""
    grid_cells: int = 24
    """Cells of the nearest-point grid along each axis."""
    screen_width: float = 0.06
    """Width of the Gaussian overlap that all poses are screened by."""
    screened: int = 64
    """Distinct poses that are aligned coarsely."""
    distinct_angle: float = 0.26
    """Poses are distinct when they turn by more than this from each other,"""
    distinct_distance: float = 0.15
    """or move the centroid of the source farther apart than this."""
    aligned: int = 8
    """Poses that are aligned and ranked with all their neighbours afterwards,"""
    aligned_angle: float = 0.1
    """distinct by this angle"""
    aligned_distance: float = 0.05
    """or this distance."""
    coarse_step: int = 2
    """Every so-manieth point is screened and refined coarsely."""
    coarse_widths: tuple[float, ...] = (0.15, 0.12, 0.09, 0.07, 0.05)
    """Gaussian width of every coarse iteration."""
    coarse_thickness: float = 0.1
    """Weight of the distance along a surface, against that across it, in these."""
    fine_widths: tuple[float, ...] = (0.1, 0.07, 0.05, 0.05)
    """Gaussian width of every fine iteration."""
    thickness: float = 0.01
    """Variance across a surface, in units of the variance along it."""
    final_iterations: int = 15
    """Iterations of generalised ICP on the best pose,"""
    final_reach: float = 0.06
    """the largest distance of its pairs,"""
    final_partners: int = 2
    """the points that every point is paired with,"""
    final_anneal: float = 8.0
    """how many times wider its kernel is in the first iteration than in the last,"""
    final_neighbors: int = 16
    """and the neighbours of a point that its normal is computed from."""
    match_width: float = 0.05
    """Width of the distance at which points count as near, in the ranking."""
    plane_width: float = 0.02
    """Width of the distance from the other surface's plane at which they match."""
    dense_spacing: float = 0.035
    """Mean distance to the nearest point above which both of these widths, and the reach of the last
    refinement, grow in proportion."""
    rim_radius: float = 0.3
    """Radius at which a surface is seen to be open."""
    rim: float = 0.25
    """Openness at which a surface counts as ending."""
    alike: float = 0.33
    """Worth of a near point around which the surfaces look alike, in points that match. This and the
    two below were fitted to rank 32 poses of pairs of procedural shapes (crops of 70 and 50 %)."""
    within: float = 1.8
    """Cost of a near point away from all rims: it should match, not only be near."""
    beside: float = 4.1
    """Cost of a point that lies beside the inside of the other surface."""
    doubt: float = 0.03
    """Poses whose plausibility is less than this below the best one's are a close call,"""
    flush: float = 0.25
    """in which a point that lies flush with the other surface is worth this much more."""
