"""Point-to-plane ICP (Chen and Medioni, 1992) by Gauss-Newton, trimmed and robust."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._xla import on_any_mesh
from jaxreg.geometry import arguments
from jaxreg.geometry.neighbors import knn
from jaxreg.geometry.normals import normals
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs
from jaxreg.refine.cost import Cost, Method, Scene, lower_by_gauss_newton
from jaxreg.refine.solve import set_up, solve
from jaxreg.types import Refinement, RigidTransform


@on_any_mesh
def point_to_plane(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    initial: RigidTransform | None = None,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    reference_normals: Float[Array, "m 3"] | None = None,
    config: RefineConfig = RefineConfig(),
    max_correspondence_distance: Float[Array, ""] | float | None = None,
    kernel_scale: Float[Array, ""] | float | None = None,
) -> Refinement:
    """The pose after a fixed number of Gauss-Newton steps on ``sum_i w_i (n_i . r_i)^2``.

    ``r_i = R x_i + t - y_i``, where ``y_i`` is the reference point nearest to the moved ``x_i`` and
    ``n_i`` its unit normal, of `config.k` neighbours unless `reference_normals` are given (zeros
    where there is none). The kernel applies to the distances to the planes; everything else is as
    for `icp`. A motion that no plane opposes (a cloud that slides along a plane) does not change
    the pose.

    Raises:
      ValueError: a shape or an option is wrong, or the reference has only `config.k` points or fewer.
    """
    problem = set_up(
        source, reference, initial=initial, source_mask=source_mask, reference_mask=reference_mask,
        config=config, max_correspondence_distance=max_correspondence_distance,
        kernel_scale=kernel_scale,
    )  # fmt: skip
    y = problem.scene.reference
    if reference_normals is None:
        reference_normals = normals(y, knn(y, config.k, reference_mask), reference_mask)
    reference_normals = arguments.rows("reference_normals", reference_normals, y.shape, y)
    scene = problem.scene._replace(reference_surface=reference_normals)
    return solve(problem._replace(scene=scene), POINT_TO_PLANE, config=config)


def plane_cost(
    scene: Scene, pose: RigidTransform, pairs: Pairs, residual: Float[Array, "p 3"]
) -> Cost:
    """The cost of a residual is the square of its part across the reference: ``M_i = n_i n_i^T``."""
    normal = scene.reference_surface[pairs.reference_index]
    # A given normal of a padded point may be NaN; its pair does not count.
    mask = pairs.mask & jnp.any(normal != 0, axis=-1)
    normal = jnp.where(mask[:, None], normal, 0)
    across = jnp.sum(normal * residual, axis=-1)
    return Cost(normal[:, :, None] * normal[:, None, :], across**2, mask)


POINT_TO_PLANE = Method(plane_cost, lower_by_gauss_newton)
