"""The methods of the ICP family, by name."""

from jaxtyping import Array, Bool, Float

from jaxreg.refine.config import RefineConfig
from jaxreg.refine.cost import Method
from jaxreg.refine.gicp import generalized, gicp
from jaxreg.refine.point_to_plane import POINT_TO_PLANE, point_to_plane
from jaxreg.refine.point_to_point import POINT_TO_POINT, icp
from jaxreg.types import Refinement, RigidTransform


def refine(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    initial: RigidTransform | None = None,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    config: RefineConfig = RefineConfig(),
    max_correspondence_distance: Float[Array, ""] | float | None = None,
    kernel_scale: Float[Array, ""] | float | None = None,
) -> Refinement:
    """`icp`, `point_to_plane` or `gicp`, as `config.method` says.

    Raises:
      ValueError: what the method raises.
    """
    functions = {"icp": icp, "point_to_plane": point_to_plane, "gicp": gicp}
    # An unknown name is refused together with all other options.
    return functions.get(config.method, gicp)(
        source,
        reference,
        initial=initial,
        source_mask=source_mask,
        reference_mask=reference_mask,
        config=config,
        max_correspondence_distance=max_correspondence_distance,
        kernel_scale=kernel_scale,
    )


def method_of(config: RefineConfig) -> Method:
    """Cost and step of `config.method`."""
    methods = {"icp": POINT_TO_POINT, "point_to_plane": POINT_TO_PLANE, "gicp": generalized(config)}
    return methods[config.method]
