"""A cloud as the stages of the search see it, with the shape of the surface around every point."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float


class Surface(NamedTuple):
    """Points of a surface with unit normals of arbitrary sign; rows with `mask` False are padding.

    `openness` is near 0 inside the sampled surface and large at its boundary. `local` are features of
    length 1 that say what the surface looks like nearby.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    openness: Float[Array, "n"]
    local: Float[Array, "n d"]
    mask: Bool[Array, "n"]


def thinned(surface: Surface, step: int) -> Surface:
    """Every `step`-th point."""
    return Surface(*(field[::step] for field in surface))
