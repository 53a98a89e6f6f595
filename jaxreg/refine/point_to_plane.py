"""Point-to-plane ICP (Chen and Medioni, 1992) by Gauss-Newton, trimmed and robust."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import frame, rigid
from jaxreg.geometry.neighbors import knn
from jaxreg.geometry.normals import normals
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs, closest_pairs
from jaxreg.refine.gauss_newton import gauss_newton_step
from jaxreg.refine.robust import Kernel, Weighting, check_options, pair_weights, widenings
from jaxreg.types import RigidTransform

_DEFAULT = RefineConfig()


def point_to_plane(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    reference_normals: Float[Array, "m 3"] | None = None,
    initial: RigidTransform | None = None,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    iterations: int = _DEFAULT.iterations,
    max_distance: Float[Array, ""] | float = _DEFAULT.max_distance,
    trim: float = _DEFAULT.trim,
    kernel: Kernel = _DEFAULT.kernel,
    scale: Float[Array, ""] | float | None = None,
    anneal: float = _DEFAULT.anneal,
    both_directions: bool = _DEFAULT.both_directions,
    neighbors: int = _DEFAULT.neighbors,
) -> RigidTransform:
    """The pose after a fixed number of Gauss-Newton steps on ``sum_i w_i (n_i . r_i)^2``.

    ``r_i = R x_i + t - y_i``, where ``y_i`` is the reference point nearest to the moved ``x_i`` and
    ``n_i`` its normal, of `neighbors` neighbours unless `reference_normals` are given (zero where
    there is none). `kernel` weighs the distances to the planes; everything else is as for
    `icp`. A motion that no plane opposes (a cloud that slides along a plane) is
    left out of the pose's change.

    Raises:
      ValueError: a shape or an option is wrong, or the reference has not more than `neighbors`
        points.
    """
    check_options(iterations=iterations, trim=trim, anneal=anneal)
    where, x, y = frame.enter(source, reference, source_mask, reference_mask)
    weighting = Weighting(kernel, scale, max_distance, trim).in_units_of(where.length)
    if reference_normals is None:
        reference_normals = normals(y, knn(y, neighbors, reference_mask), reference_mask)

    def step(pose: RigidTransform, widening: Array):
        pairs = closest_pairs(
            rigid.apply(pose, x), y, source_mask, reference_mask, both_directions=both_directions
        )
        return point_to_plane_step(pose, x, y, reference_normals, pairs, weighting, widening), None

    start = frame.transform_in(where, initial)
    pose, _ = jax.lax.scan(step, start, widenings(iterations, anneal, x.dtype))
    return frame.transform_out(where, pose)


def point_to_plane_step(
    pose: RigidTransform,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    reference_normals: Float[Array, "m 3"],
    pairs: Pairs,
    weighting: Weighting,
    widening: Float[Array, ""] | float = 1.0,
) -> RigidTransform:
    """One Gauss-Newton step on given pairs; no pair leaves the pose as it is."""
    moved, target = rigid.apply(pose, source[pairs.source_index]), reference[pairs.reference_index]
    metric = plane_metric(moved, target, reference_normals, pairs, weighting, widening)
    return gauss_newton_step(pose, moved, target, metric)


def plane_metric(
    moved: Float[Array, "p 3"],
    target: Float[Array, "p 3"],
    reference_normals: Float[Array, "m 3"],
    pairs: Pairs,
    weighting: Weighting,
    widening: Float[Array, ""] | float = 1.0,
) -> Float[Array, "p 3 3"]:
    """``w_i n_i n_i^T`` of every pair."""
    normal = reference_normals[pairs.reference_index]
    # Where padding has been given a normal it may be NaN; its pair counts for nothing.
    mask = pairs.mask & jnp.any(normal != 0, axis=-1)
    normal = jnp.where(mask[:, None], normal, 0)
    residual = moved - target
    along = jnp.sum(normal * residual, axis=-1)
    distance = jnp.sum(residual**2, axis=-1)
    weights = pair_weights(distance, along**2, mask, weighting, widening)
    return weights[:, None, None] * normal[:, :, None] * normal[:, None, :]
