"""The settings of the search."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """What may be set of global registration (`jaxreg.search`).

    Lengths are in units of the search: a usual shape fills the unit sphere in them. Everything
    that was fitted, and that nobody needs to change, is a constant beside the code that uses it.
    """

    unit: float | None = None
    """The unit of the search, in the unit of the clouds; None: twice the root mean square radius of
    both clouds."""
    radii: tuple[float, ...] = (0.2, 0.4, 0.8)
    """Radii of the moment descriptors, in units of the search."""
    candidates: int = 768
    """Candidate correspondences kept, the clearest first."""
    seeds: int = 512
    """How many of these, the clearest first, give a pose each."""
    screened: int = 64
    """Distinct poses that are aligned coarsely, those of the largest overlap first."""
    aligned: int = 8
    """Distinct poses that are aligned with exact neighbours and ranked."""
