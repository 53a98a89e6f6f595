"""Which of several refined poses is right: what agrees, and what speaks against.

At low overlap the pose with the smallest residual, or the largest overlap, is often a flip of a
nearly symmetric shape. Two things speak against a flip. Its surfaces meet only roughly: points lie
near the other surface but off its plane, or face another way. And where one cloud ends, the other
has no rim: a point just beside the *inside* of a sampled surface should have been sampled there
too, whatever cut the clouds.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float

from jaxreg import rigid
from jaxreg.dense.nearest import nearest_packed
from jaxreg.dense.surface import Surface
from jaxreg.types import RigidTransform


class Evidence(NamedTuple):
    """Sums over both directions of shares in [0, 1]: each of these is between 0 and 2.

    `near`: points close to the other surface. `match`: of these, those on its plane and facing its
    way. `beside`: points a little off the other surface where that is not open.
    """

    near: Float[Array, ""]
    match: Float[Array, ""]
    beside: Float[Array, ""]


def evidence(
    pose: RigidTransform,
    source: Surface,
    reference: Surface,
    *,
    width: float,
    plane_width: float,
    rim: float,
) -> Evidence:
    """The evidence for and against a pose.

    With d the distance to the nearest point of the other cloud, h its part along the normal there
    and c the cosine of the two normals: ``near = E[exp(-d^2 / 2 width^2)]``, ``match`` the same
    times ``exp(-h^2 / 2 plane_width^2) c^2``, ``beside = E[max(0, 1 - openness / rim)]`` over the
    points with d between 2 and 6 `width` (0 for the others).
    """
    moved = source._replace(
        points=rigid.apply(pose, source.points),
        normals=jnp.matmul(source.normals, pose.rotation.T, precision=Precision.HIGHEST),
    )
    there = _one_way(moved, reference, width, plane_width, rim)
    back = _one_way(reference, moved, width, plane_width, rim)
    return Evidence(*(a + b for a, b in zip(there, back, strict=True)))


def plausibility(evidence: Evidence, *, contradiction: float, beside: float) -> Float[Array, "..."]:
    """``match - contradiction (near - match) - beside * beside``: the larger, the more plausible."""
    against = contradiction * (evidence.near - evidence.match) + beside * evidence.beside
    return evidence.match - against


def _one_way(
    moved: Surface, other: Surface, width: float, plane_width: float, rim: float
) -> tuple[Array, Array, Array]:
    nearest = nearest_packed(moved.points, other.points, other.mask)
    residual = moved.points - other.points[nearest]
    normal = other.normals[nearest]
    squared = jnp.sum(residual**2, axis=-1)
    height = jnp.sum(residual * normal, axis=-1)
    facing = jnp.sum(moved.normals * normal, axis=-1) ** 2
    close = jnp.exp(-squared / (2 * width**2))
    match = close * jnp.exp(-(height**2) / (2 * plane_width**2)) * facing
    off = (squared > (2 * width) ** 2) & (squared < (6 * width) ** 2)
    inside = jnp.where(off, jnp.maximum(0, 1 - other.openness[nearest] / rim), 0)
    count = jnp.maximum(jnp.sum(moved.mask), 1).astype(close.dtype)
    close, match, inside = (
        jnp.sum(jnp.where(moved.mask, value, 0)) / count for value in (close, match, inside)
    )
    return close, match, inside
