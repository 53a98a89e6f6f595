"""Iterative closest point, point to point (Besl and McKay, 1992), trimmed and robust."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import frame, rigid
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs, closest_pairs
from jaxreg.refine.robust import Kernel, Weighting, check_options, pair_weights, widenings
from jaxreg.types import RigidTransform

_DEFAULT = RefineConfig()


def icp(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    initial: RigidTransform | None = None,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    iterations: int = _DEFAULT.iterations,
    max_distance: Float[Array, ""] | float = _DEFAULT.max_distance,
    trim: float = _DEFAULT.trim,
    kernel: Kernel = "none",
    scale: Float[Array, ""] | float | None = None,
    anneal: float = _DEFAULT.anneal,
    both_directions: bool = False,
) -> RigidTransform:
    """The pose after a fixed number of closest-point iterations from `initial` (the identity).

    Every iteration pairs each moved source point with its nearest reference point and solves
    ``min sum_i w_i |R x_i + t - y_i|^2`` in closed form. ``w_i`` is 1, or the weight of `kernel` at
    the pair's distance over the width `scale` (None: taken from the distances themselves), which
    starts `anneal` times wider; 0 beyond `max_distance` and outside the share `trim` of closest
    pairs. `max_distance` and `scale` have the unit of the clouds. Where no pair is left, the pose
    stays what it was, so that no overlap gives `initial`.

    Differentiable in both clouds through every iteration; which point is nearest is a constant of
    the derivative, which is exact wherever the pairs do not change.

    Raises:
      ValueError: a shape, the number of iterations, `trim`, `anneal` or `kernel` is wrong.
    """
    check_options(iterations=iterations, trim=trim, anneal=anneal)
    where, x, y = frame.enter(source, reference, source_mask, reference_mask)
    weighting = Weighting(kernel, scale, max_distance, trim).in_units_of(where.length)

    def step(pose: RigidTransform, widening: Array):
        pairs = closest_pairs(
            rigid.apply(pose, x), y, source_mask, reference_mask, both_directions=both_directions
        )
        return point_to_point_step(pose, x, y, pairs, weighting, widening), None

    start = frame.transform_in(where, initial)
    pose, _ = jax.lax.scan(step, start, widenings(iterations, anneal, x.dtype))
    return frame.transform_out(where, pose)


def point_to_point_step(
    pose: RigidTransform,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    pairs: Pairs,
    weighting: Weighting,
    widening: Float[Array, ""] | float = 1.0,
) -> RigidTransform:
    """The best pose for given pairs, weighted by their distances under the present one."""
    x, y = source[pairs.source_index], reference[pairs.reference_index]
    squared = jnp.sum((rigid.apply(pose, x) - y) ** 2, axis=-1)
    weights = pair_weights(squared, squared, pairs.mask, weighting, widening)
    solved = weighted_procrustes(x, y, weights)
    found = jnp.any(weights > 0)
    return jax.tree.map(lambda new, old: jnp.where(found, new, old), solved, pose)
