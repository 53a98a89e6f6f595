"""The settings of the search."""

import dataclasses
import math

from jaxreg.refine.config import RefineConfig

_COUNTS = ("candidates", "seeds", "screened", "aligned")


@dataclasses.dataclass(frozen=True)
class SearchConfig:
    """Settings of registration without a start (`jaxreg.search`).

    Lengths are in units of the search, in which a usual shape fills the unit sphere. Fitted values,
    which nobody needs to change, are constants next to the code that uses them.

    Raises:
      ValueError: a value is not positive.
    """

    unit: float | None = None
    """The unit of the search, in the unit of the clouds; None: twice the root mean square radius of
    both clouds."""
    radii: tuple[float, ...] = (0.2, 0.4, 0.8)
    """Radii of the moment descriptors, in units of the search."""
    candidates: int = 768
    """Candidate correspondences kept, the clearest first."""
    seeds: int = 512
    """How many of these, the clearest first, each give a pose."""
    screened: int = 64
    """Distinct poses that are aligned coarsely, those with the largest overlap first."""
    aligned: int = 8
    """Distinct poses that are aligned with exact neighbours and ranked."""
    judged: bool = False
    """Rank poses by the judge (`jaxreg.judge`) in place of the score of `jaxreg.search.ranking`. It
    finds more pairs of low overlap among many poses; of clouds of 1024 points with noise or crops it
    loses a few pairs of a hundred."""
    final: RefineConfig = RefineConfig(
        iterations=15,
        max_correspondence_distance=0.06,
        kernel_annealing=8.0,
        both_directions=True,
        k=16,
        epsilon=0.01,
        correspondences_per_point=2,
        edges=True,
    )
    """Refinement of the best pose by `register_global`, in units of the search. Its largest distance
    grows as the points of sparse clouds lie farther apart; a cloud of fewer points has a smaller k."""

    def __post_init__(self) -> None:
        """Raise ValueError if a value is out of range."""
        if not self.radii:
            raise ValueError("radii is empty: give one radius or more, in units of the search.")
        values = {name: getattr(self, name) for name in _COUNTS}
        if self.unit is not None:
            values["unit"] = self.unit
        for name, value in [*values.items(), *(("radii", radius) for radius in self.radii)]:
            if not 0 < value < math.inf:
                raise ValueError(f"{name} = {value}: choose a positive, finite value.")


@dataclasses.dataclass(frozen=True)
class FeatureConfig:
    """What the inputs of a feature network depend on, in units of the search.

    It is in the card of the weights, which do not work with other inputs.
    """

    radii: tuple[float, ...]
    """Radii of the moments."""
    normal_radius: float
    """Radius of the neighbourhood of a normal."""
    openness_radius: float
    """Radius at which a surface is seen to be open."""
