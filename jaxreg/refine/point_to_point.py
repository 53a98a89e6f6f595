"""Iterative closest point, point to point (Besl and McKay, 1992), trimmed and robust."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._xla import on_any_mesh
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs
from jaxreg.refine.cost import Cost, Matched, Method, Scene
from jaxreg.refine.solve import set_up, solve
from jaxreg.types import Refinement, RigidTransform


@on_any_mesh
def icp(
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
    """The pose after a fixed number of closest-point iterations from `initial` (the identity).

    Every iteration pairs each moved source point with its nearest reference point and solves
    ``min sum_i w_i |R x_i + t - y_i|^2`` in closed form. ``w_i`` is 1, or the weight of the kernel
    at the pair's distance over its width; 0 beyond the largest distance and outside the trimmed
    share. If no pair is left, the pose stays as it is, so no overlap gives `initial`. Of a matrix in
    `initial` that is no rotation (a mirror, zeros) the nearest rotation is taken.

    `max_correspondence_distance` and `kernel_scale`, the width of the kernel (None: taken from the
    distances themselves), have the unit of the clouds, may be traced arrays, and override `config`.

    Differentiable in both clouds and in `kernel_scale` as `config.gradient` says; which point is
    nearest is a constant of the derivative, so it is exact as long as the pairs do not change.

    Raises:
      ValueError: a shape or an option is wrong.
    """
    problem = set_up(
        source, reference, initial=initial, source_mask=source_mask, reference_mask=reference_mask,
        config=config, max_correspondence_distance=max_correspondence_distance,
        kernel_scale=kernel_scale,
    )  # fmt: skip
    return solve(problem, POINT_TO_POINT, config=config)


def point_cost(
    scene: Scene, pose: RigidTransform, pairs: Pairs, residual: Float[Array, "p 3"]
) -> Cost:
    """The cost of a residual is its squared length: ``M_i = I``."""
    metric = jnp.broadcast_to(jnp.eye(3, dtype=residual.dtype), (*residual.shape, 3))
    return Cost(metric, jnp.sum(residual**2, axis=-1), pairs.mask)


def procrustes_step(pose: RigidTransform, matched: Matched) -> RigidTransform:
    """The best pose for weighted pairs of points; without any pair the pose stays as it is."""
    solved = weighted_procrustes(matched.source, matched.target, matched.weights)
    found = jnp.any(matched.weights > 0)
    return jax.tree.map(lambda new, old: jnp.where(found, new, old), solved, pose)


POINT_TO_POINT = Method(point_cost, procrustes_step)
