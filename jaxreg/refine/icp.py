"""Iterative closest point, point to point (Besl and McKay, 1992), trimmed and robust."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg import rigid
from jaxreg.config import RefineConfig
from jaxreg.procrustes import weighted_procrustes
from jaxreg.refine import frame
from jaxreg.refine.pairing import Kernel, Pairs, closest_pairs, pair_weights
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
    max_distance: float = _DEFAULT.max_distance,
    trim: float = _DEFAULT.trim,
    kernel: Kernel = "none",
    scale: float | None = None,
    both_directions: bool = False,
) -> RigidTransform:
    """The pose after a fixed number of closest-point iterations from `initial` (the identity).

    Every iteration pairs each moved source point with its nearest reference point and solves
    ``min sum_i w_i |R x_i + t - y_i|^2`` in closed form. ``w_i`` is 1, or the weight of `kernel` at
    the pair's distance over `scale` (None: from the distances themselves); 0 beyond `max_distance`
    and outside the share `trim` of closest pairs. `max_distance` and `scale` have the unit of the
    clouds. Where no pair is left, the pose stays what it was, so that no overlap gives `initial`.

    Differentiable in both clouds through every iteration; which point is nearest is a constant of
    the derivative, which is exact wherever the pairs do not change.

    Raises:
      ValueError: a shape, the number of iterations, `trim` or `kernel` is wrong.
    """
    check_clouds(source, reference)
    check_solve(iterations, trim)
    where, x, y = frame.enter(source, reference, source_mask, reference_mask)

    def step(pose: RigidTransform, _):
        moved = rigid.apply(pose, x)
        pairs = closest_pairs(
            moved, y, source_mask, reference_mask, both_directions=both_directions
        )
        pose = point_to_point_step(
            pose,
            x,
            y,
            pairs,
            max_distance=max_distance / where.length,
            trim=trim,
            kernel=kernel,
            scale=None if scale is None else scale / where.length,
        )
        return pose, None

    start = frame.transform_in(where, initial)
    pose, _ = jax.lax.scan(step, start, length=iterations)
    return frame.transform_out(where, pose)


def point_to_point_step(
    pose: RigidTransform,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    pairs: Pairs,
    *,
    max_distance: Float[Array, ""] | float,
    trim: float,
    kernel: Kernel,
    scale: Float[Array, ""] | float | None,
) -> RigidTransform:
    """The best pose for given pairs, weighted by their distances under the present one."""
    x, y = source[pairs.source_index], reference[pairs.reference_index]
    difference = rigid.apply(pose, x) - y
    weights = pair_weights(
        jnp.sum(difference * difference, axis=-1),
        pairs.mask,
        max_distance=max_distance,
        trim=trim,
        kernel=kernel,
        scale=scale,
    )
    solved = weighted_procrustes(x, y, weights)
    found = jnp.any(weights > 0)
    return jax.tree.map(lambda new, old: jnp.where(found, new, old), solved, pose)


def check_clouds(source: Array, reference: Array) -> None:
    """Raises ValueError unless both clouds are ``(n, 3)`` with at least one row."""
    for name, points in (("source", source), ("reference", reference)):
        if points.ndim != 2 or points.shape[1] != 3 or points.shape[0] == 0:
            raise ValueError(
                f"{name} must have shape (n, 3) with n >= 1, got {points.shape}: give one cloud, "
                "and use jax.vmap for a batch."
            )


def check_solve(iterations: int, trim: float) -> None:
    """Raises ValueError unless ``iterations >= 1`` and ``0 < trim <= 1``."""
    if iterations < 1:
        raise ValueError(f"iterations = {iterations}: choose at least 1.")
    if not 0 < trim <= 1:
        raise ValueError(f"trim = {trim} is no share of the pairs: choose 0 < trim <= 1.")
