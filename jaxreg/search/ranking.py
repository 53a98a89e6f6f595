"""Which of several refined poses is right: what agrees, and what speaks against.

At low overlap the pose with the smallest residual, or the largest overlap, is often a flip of a
nearly symmetric shape. Two things speak against a flip. Its surfaces meet only roughly: points lie
near the other surface but off its plane, or face another way. And where one cloud ends, the other
has no rim: a point just beside the *inside* of a sampled surface should have been sampled there
too, whatever cut the clouds.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float, Int

from jaxreg.geometry import rigid
from jaxreg.search.nearest import NearestGrid, lookup, nearest_packed
from jaxreg.search.surface import Surface, thinned
from jaxreg.types import RigidTransform


class Evidence(NamedTuple):
    """Sums over both directions of means over the points: each of these is between 0 and 2.

    `match`: close to the other surface, on its plane and facing its way. `alike`: close to a point
    around which the surface looks alike (may be negative). `within`: close, both points away from
    any rim. `beside`: a little off the other surface where that has no rim. `flush`: close, and on the
    other surface's plane to a third of the width that `match` allows.
    """

    match: Float[Array, ""]
    alike: Float[Array, ""]
    within: Float[Array, ""]
    beside: Float[Array, ""]
    flush: Float[Array, ""]


def evidence(
    pose: RigidTransform,
    source: Surface,
    reference: Surface,
    *,
    width: Float[Array, ""] | float,
    plane_width: Float[Array, ""] | float,
    rim: float,
) -> Evidence:
    """The evidence for and against a pose.

    With d the distance to the nearest point of the other cloud, h its part along the normal there,
    c the cosine of the two normals, s that of the local features, ``k = exp(-d^2 / 2 width^2)`` and
    ``i = max(0, 1 - openness / rim)`` of the point (i) and of the other (i'): ``match =
    E[k exp(-h^2 / 2 plane_width^2) c^2]``, ``alike = E[k s]``, ``within = E[k i i']``, ``beside =
    E[i']`` over the points with d between 1.5 and 3 `width` (0 for the others), ``flush =
    E[k exp(-h^2 / 2 (plane_width / 3)^2)]``.
    """
    moved = move(pose, source)
    forward = nearest_packed(moved.points, reference.points, reference.mask)
    backward = nearest_packed(reference.points, moved.points, source.mask)
    there = _one_way(moved, reference, forward, width, plane_width, rim)
    back = _one_way(reference, moved, backward, width, plane_width, rim)
    return Evidence(*(a + b for a, b in zip(there, back, strict=True)))


def evidence_by_grid(
    pose: RigidTransform,
    source: Surface,
    reference: Surface,
    source_grid: NearestGrid,
    reference_grid: NearestGrid,
    *,
    step: int,
    width: Float[Array, ""] | float,
    plane_width: Float[Array, ""] | float,
    rim: float,
) -> Evidence:
    """About `evidence`, of every `step`-th point and with the nearest points of the grids.

    A look-up in place of a search, so much faster: enough to drop poses that are far from the best.
    """
    moved = move(pose, thinned(source, step))
    back = move(rigid.inverse(pose), thinned(reference, step))
    forward = lookup(reference_grid, moved.points)
    backward = lookup(source_grid, back.points)
    there = _one_way(moved, reference, forward, width, plane_width, rim)
    back = _one_way(back, source, backward, width, plane_width, rim)
    return Evidence(*(a + b for a, b in zip(there, back, strict=True)))


def move(pose: RigidTransform, surface: Surface) -> Surface:
    """The surface under a pose: points moved, normals turned."""
    return surface._replace(
        points=rigid.apply(pose, surface.points),
        normals=jnp.matmul(surface.normals, pose.rotation.T, precision=Precision.HIGHEST),
    )


def plausibility(
    evidence: Evidence, *, alike: float, within: float, beside: float
) -> Float[Array, "..."]:
    """``match + alike * alike - within * within - beside * beside``: the larger, the better."""
    against = within * evidence.within + beside * evidence.beside
    return evidence.match + alike * evidence.alike - against


def settle(
    score: Float[Array, "s"], flush: Float[Array, "s"], *, doubt: float, worth: float
) -> Float[Array, "s"]:
    """The scores, those less than `doubt` below the best changed by how much more flush they lie.

    Added is ``worth * (flush - that of the best)``. Sides of an object that differ by a small part
    score alike. On all pairs the term gains less (RESULTS.md, *Close calls*).
    """
    best = jnp.argmax(score)
    change = worth * (flush - flush[best])
    return jnp.where(score > score[best] - doubt, score + change, score)


@jax.jit  # Traced once for both directions.
def _one_way(
    moved: Surface,
    other: Surface,
    nearest: Int[Array, "n"],
    width: Float[Array, ""] | float,
    plane_width: Float[Array, ""] | float,
    rim: Float[Array, ""] | float,
) -> tuple[Array, ...]:
    residual = moved.points - other.points[nearest]
    normal = other.normals[nearest]
    squared = jnp.sum(residual**2, axis=-1)
    height = jnp.sum(residual * normal, axis=-1)
    facing = jnp.sum(moved.normals * normal, axis=-1) ** 2
    close = jnp.exp(-squared / (2 * width**2))
    match = close * jnp.exp(-(height**2) / (2 * plane_width**2)) * facing
    flush = close * jnp.exp(-(height**2) / (2 * (plane_width / 3) ** 2))
    alike = close * jnp.sum(moved.local * other.local[nearest], axis=-1)
    inside, others_inside = (
        jnp.maximum(0, 1 - openness / rim) for openness in (moved.openness, other.openness[nearest])
    )
    off = (squared > (1.5 * width) ** 2) & (squared < (3 * width) ** 2)
    beside = jnp.where(off, others_inside, 0)
    count = jnp.maximum(jnp.sum(moved.mask), 1).astype(close.dtype)
    return tuple(
        jnp.sum(jnp.where(moved.mask, value, 0)) / count
        for value in (match, alike, close * inside * others_inside, beside, flush)
    )
