"""Refinement of poses inside the search: coarse with a grid, fine with exact neighbours.

Both weight a pair by a Gaussian of its *distance*, whose width narrows over the iterations, so
points without a counterpart stop pulling although no overlap was ever estimated.
"""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from jaxreg.geometry import eigen3x3, rigid
from jaxreg.geometry.normals import surface_covariances
from jaxreg.refine.gauss_newton import gauss_newton_step
from jaxreg.search.nearest import NearestGrid, lookup, nearest_packed
from jaxreg.search.surface import Surface
from jaxreg.types import RigidTransform

COARSE_WIDTHS = (0.15, 0.12, 0.09, 0.07, 0.05)
"""Gaussian width of every coarse iteration, in units of the search."""
COARSE_EPSILON = 0.1
"""Weight of the distance along a surface, relative to that across it: large, because few poses are
near."""
FINE_WIDTHS = (0.1, 0.07, 0.05, 0.05)
"""Gaussian width of every fine iteration, in units of the search."""
FINE_EPSILON = 0.01
"""GICP's epsilon: variance across a surface, in units of the variance along it."""


def align_coarse(
    pose: RigidTransform,
    source: Surface,
    reference: Surface,
    grid: NearestGrid,
    *,
    motions: Float[Array, "6 f"] | None = None,
    widths: tuple[float, ...] = COARSE_WIDTHS,
    epsilon: float = COARSE_EPSILON,
) -> RigidTransform:
    """One Gauss-Newton step for each of `widths`; neighbours from the grid, source to reference.

    The metric ``n n^T + epsilon I`` is that of point to plane, with a hold where planes would slide.
    `motions`: as of `gauss_newton_step`.
    """
    outer = reference.normals[:, :, None] * reference.normals[:, None, :]
    metric = outer + epsilon * jnp.eye(3, dtype=outer.dtype)[None]

    def step(pose: RigidTransform, width: Array):
        moved = rigid.apply(pose, source.points)
        nearest = lookup(grid, moved)
        target = reference.points[nearest]
        weight = jnp.where(source.mask, _closeness(moved - target, width), 0)
        weighted = weight[:, None, None] * metric[nearest]
        return gauss_newton_step(pose, moved, target, weighted, motions), None

    return jax.lax.scan(step, pose, jnp.asarray(widths, source.points.dtype))[0]


def align_fine(
    pose: RigidTransform,
    source: Surface,
    reference: Surface,
    *,
    motions: Float[Array, "6 f"] | None = None,
    widths: tuple[float, ...] = FINE_WIDTHS,
    epsilon: float = FINE_EPSILON,
) -> RigidTransform:
    """Generalised ICP in both directions, one Gauss-Newton step for each of `widths`.

    Minimises ``sum w r^T (C_y + R C_x R^T)^-1 r`` with the covariances of planes, 1 along and
    `epsilon` across, and ``w = exp(-|r|^2 / (2 width^2))``, over every source point with its
    nearest reference point and every reference point with its nearest source point.

    Differentiable in the points and normals; which point is nearest is a constant.
    """
    covariances = surface_covariances(source.normals, epsilon)
    others = surface_covariances(reference.normals, epsilon)
    rows, columns = (jnp.arange(len(s.mask), dtype=jnp.int32) for s in (source, reference))
    # Both masks apply in both directions: with an empty cloud there is no pair at all.
    usable = jnp.any(source.mask) & jnp.any(reference.mask)
    valid = jnp.concatenate([source.mask, reference.mask]) & usable

    def step(pose: RigidTransform, width: Array):
        moved = rigid.apply(pose, source.points)
        forward = nearest_packed(moved, reference.points, reference.mask)
        backward = nearest_packed(reference.points, moved, source.mask)
        i, j = jnp.concatenate([rows, backward]), jnp.concatenate([forward, columns])
        turned = jnp.matmul(pose.rotation, covariances, precision=Precision.HIGHEST)
        turned = jnp.matmul(turned, pose.rotation.T, precision=Precision.HIGHEST)
        metric = 2 * epsilon * eigen3x3.inverse(turned[i] + others[j])
        residual = moved[i] - reference.points[j]
        weight = jnp.where(valid, _closeness(residual, width), 0)
        weighted = weight[:, None, None] * metric
        return gauss_newton_step(pose, moved[i], reference.points[j], weighted, motions), None

    return jax.lax.scan(step, pose, jnp.asarray(widths, source.points.dtype))[0]


def _closeness(residual: Float[Array, "n 3"], width: Array) -> Float[Array, "n"]:
    return jnp.exp(-jnp.sum(residual**2, axis=-1) / (2 * width**2))
