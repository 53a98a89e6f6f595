"""Generalised ICP, plane to plane (Segal, Haehnel and Thrun, 2009), by Gauss-Newton."""

from functools import partial

import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg._xla import on_any_mesh
from jaxreg.geometry import arguments, eigen3x3
from jaxreg.geometry.neighbors import knn
from jaxreg.geometry.normals import edge_normals, normals, surface_covariances
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs
from jaxreg.refine.cost import Cost, Method, Scene, lower_by_gauss_newton
from jaxreg.refine.solve import set_up, solve
from jaxreg.types import Refinement, RigidTransform


@on_any_mesh
def gicp(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    initial: RigidTransform | None = None,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    source_covariances: Float[Array, "n 3 3"] | None = None,
    reference_covariances: Float[Array, "m 3 3"] | None = None,
    config: RefineConfig = RefineConfig(),
    max_correspondence_distance: Float[Array, ""] | float | None = None,
    kernel_scale: Float[Array, ""] | float | None = None,
) -> Refinement:
    """The pose after a fixed number of Gauss-Newton steps on ``sum_i w_i r_i^T M_i r_i``.

    ``r_i = R x_i + t - y_i`` with ``y_i`` nearest to the moved ``x_i``, and
    ``M_i = 2 e (C_y + R C_x R^T)^-1``, held fixed during a step, where ``e`` is `config.epsilon`:
    for two parallel planes with this epsilon, a residual across them then counts with its length.
    Covariances that are not given are those of planes: 1 along, ``e`` across, from `config.k`
    neighbours; with `config.edges`, of surfaces that end (`edge_normals`). The kernel applies to
    ``sqrt(r^T M r)``. With `config.correspondences_per_point` above 1, a point is also paired with
    neighbours of its nearest point, which averages out the noise of their planes. Everything else
    is as for `icp`.

    Raises:
      ValueError: a shape or an option is wrong, or a cloud whose neighbours are needed has only
        `config.k` points or fewer.
    """
    problem = set_up(
        source, reference, initial=initial, source_mask=source_mask, reference_mask=reference_mask,
        config=config, max_correspondence_distance=max_correspondence_distance,
        kernel_scale=kernel_scale,
    )  # fmt: skip
    scene = problem.scene
    x, y = scene.source, scene.reference
    if source_covariances is not None:
        source_covariances = arguments.rows(
            "source_covariances", source_covariances, (*x.shape, 3), x
        )
    if reference_covariances is not None:
        reference_covariances = arguments.rows(
            "reference_covariances", reference_covariances, (*y.shape, 3), y
        )
    near_source, source_surface = _described(x, source_mask, source_covariances, config)
    near_reference, reference_surface = _described(y, reference_mask, reference_covariances, config)
    scene = scene._replace(source_surface=source_surface, reference_surface=reference_surface)
    several = config.correspondences_per_point > 1
    problem = problem._replace(
        scene=scene, neighbors=(near_source, near_reference) if several else None
    )
    return solve(problem, generalized(config), config=config)


def _described(
    points: Float[Array, "n 3"],
    mask: Bool[Array, "n"] | None,
    covariances: Float[Array, "n 3 3"] | None,
    config: RefineConfig,
) -> tuple[Int[Array, "n k"] | None, Float[Array, "n 3 3"]]:
    """The neighbours that are additional partners, and the covariances, given or computed."""
    if covariances is not None and config.correspondences_per_point == 1:
        return None, covariances
    graph = knn(points, config.k, mask)
    if covariances is None:
        across = normals(points, graph, mask)
        ends = edge_normals(points, graph, across, mask) if config.edges else None
        covariances = surface_covariances(across, config.epsilon, ends)
    return graph[:, : config.correspondences_per_point - 1], covariances


def surface_cost(
    scene: Scene,
    pose: RigidTransform,
    pairs: Pairs,
    residual: Float[Array, "p 3"],
    *,
    epsilon: float,
) -> Cost:
    """The cost of a residual, from both surfaces: ``M_i = 2 e (C_y + R C_x R^T)^-1``."""
    rotation = pose.rotation[None]
    turned = jnp.matmul(rotation, scene.source_surface, precision=Precision.HIGHEST)
    turned = jnp.matmul(turned, rotation.mT, precision=Precision.HIGHEST)
    combined = turned[pairs.source_index] + scene.reference_surface[pairs.reference_index]
    # Padding may have NaN covariances; its pairs do not count.
    identity = jnp.eye(3, dtype=combined.dtype)[None]
    combined = jnp.where(pairs.mask[:, None, None], combined, identity)
    metric = 2 * epsilon * eigen3x3.inverse(combined)
    costs = jnp.matmul(metric, residual[..., None], precision=Precision.HIGHEST)[..., 0]
    return Cost(metric, jnp.sum(residual * costs, axis=-1), pairs.mask)


def generalized(config: RefineConfig) -> Method:
    """The method for surfaces of thickness `config.epsilon`."""
    return Method(partial(surface_cost, epsilon=config.epsilon), lower_by_gauss_newton)
