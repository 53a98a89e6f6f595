"""Which of several aligned poses is right: what speaks for a pose, and what against it.

At low overlap the pose with the smallest residual, or the largest overlap, is often a flip of a
nearly symmetric shape. Two things speak against a flip. Its surfaces meet only roughly: points lie
near the other surface but off its plane, or face another way. And where one cloud ends, the other
has no boundary: a point just beside the *interior* of a sampled surface should have been sampled
there too, whatever cut the clouds. So the score of a pose is

    score = match + WEIGHT_DESCRIPTOR descriptor - PENALTY_INTERIOR interior - PENALTY_GAP gap

of the terms of `ScoreTerms`; among poses whose scores lie less than CLOSE_CALL_MARGIN below the
best one's, the one with the largest ``score + WEIGHT_PLANE plane`` is chosen. The three weights of
the score were fitted to rank 32 poses of pairs of procedural shapes (crops of 70 and 50 %).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry import rigid
from jaxreg.search.nearest import NearestGrid, lookup, nearest_packed
from jaxreg.search.surface import Surface, thinned
from jaxreg.types import RigidTransform

NEAR_WIDTH = 0.05
"""Gaussian width of the distance at which points count as near, in units of the search."""
PLANE_WIDTH = 0.02
"""Gaussian width of the distance from the other surface's plane at which near points match."""
BOUNDARY_OPENNESS = 0.25
"""Openness at which a surface counts as ending (on a straight edge it is about 0.4)."""
DENSE_SPACING = 0.035
"""Mean distance to the nearest point, in units of the search, up to which a cloud counts as dense."""
WEIGHT_DESCRIPTOR = 0.33
"""Weight of a near point around which the surfaces look alike, relative to one that matches."""
PENALTY_INTERIOR = 1.8
"""Weight of two near points in the interior of both surfaces, which should match, not only be
near."""
PENALTY_GAP = 4.1
"""Weight of a point just off the interior of the other surface, which should have points there."""
CLOSE_CALL_MARGIN = 0.03
"""Poses that score less than this below the best one are a close call."""
WEIGHT_PLANE = 0.25
"""In a close call: weight of a point on the other surface's plane to a third of PLANE_WIDTH."""


class ScoreTerms(NamedTuple):
    """Sums over both directions of means over the points: each of these is between 0 and 2.

    `match`: near the other surface, on its plane and facing its way. `descriptor`: near a point
    around which the surface looks alike (may be negative). `interior`: near, both points away from
    any boundary. `gap`: a little off the other surface where that has no boundary. `plane`: near,
    and on the other surface's plane to a third of the width that `match` allows.
    """

    match: Float[Array, "..."]
    descriptor: Float[Array, "..."]
    interior: Float[Array, "..."]
    gap: Float[Array, "..."]
    plane: Float[Array, "..."]


def sparsity_factor(
    source_spacing: Float[Array, ""], reference_spacing: Float[Array, ""]
) -> Float[Array, ""]:
    """How much farther apart than in dense clouds the points of matching surfaces lie: 1 or more."""
    return jnp.maximum(jnp.maximum(source_spacing, reference_spacing) / DENSE_SPACING, 1)


def score_terms(
    pose: RigidTransform,
    source: Surface,
    reference: Surface,
    *,
    sparsity: Float[Array, ""] | float = 1.0,
) -> ScoreTerms:
    """What speaks for and against a pose, with exact nearest points.

    With d the distance to the nearest point of the other cloud, h its part along the normal there,
    c the cosine of the two normals, s that of the local features, w = NEAR_WIDTH and p = PLANE_WIDTH
    times `sparsity`, ``k = exp(-d^2 / 2 w^2)`` and ``i = max(0, 1 - openness / BOUNDARY_OPENNESS)`` of
    the point (i) and of the other (i'): ``match = E[k exp(-h^2 / 2 p^2) c^2]``,
    ``descriptor = E[k s]``, ``interior = E[k i i']``, ``gap = E[i']`` over the points with d between
    1.5 w and 3 w (0 for the others), ``plane = E[k exp(-h^2 / 2 (p / 3)^2)]``.
    """
    moved = move(pose, source)
    forward = nearest_packed(moved.points, reference.points, reference.mask)
    backward = nearest_packed(reference.points, moved.points, source.mask)
    there = _one_way(moved, reference, forward, sparsity)
    return _sum(there, _one_way(reference, moved, backward, sparsity))


def score_terms_by_grid(
    pose: RigidTransform,
    source: Surface,
    reference: Surface,
    grids: tuple[NearestGrid, NearestGrid],
    *,
    step: int,
    sparsity: Float[Array, ""] | float = 1.0,
) -> ScoreTerms:
    """About `score_terms`, of every `step`-th point and with the nearest points of the two grids.

    It reads a table where `score_terms` searches, so it is much faster: enough to drop poses that
    are far from the best. `grids` are those of the source and of the reference.
    """
    moved = move(pose, thinned(source, step))
    back = move(rigid.inverse(pose), thinned(reference, step))
    there = _one_way(moved, reference, lookup(grids[1], moved.points), sparsity)
    return _sum(there, _one_way(back, source, lookup(grids[0], back.points), sparsity))


def move(pose: RigidTransform, surface: Surface) -> Surface:
    """The surface under a pose: points moved, normals turned."""
    return surface._replace(
        points=rigid.apply(pose, surface.points),
        normals=jnp.matmul(surface.normals, pose.rotation.T, precision=Precision.HIGHEST),
    )


def score_of(terms: ScoreTerms) -> Float[Array, "..."]:
    """The score of a pose, larger is better: see the head of this file."""
    against = PENALTY_INTERIOR * terms.interior + PENALTY_GAP * terms.gap
    return terms.match + WEIGHT_DESCRIPTOR * terms.descriptor - against


def break_ties(
    score: Float[Array, "s"], plane: Float[Array, "s"], allowed: Bool[Array, "s"] | None = None
) -> Float[Array, "s"]:
    """The scores, changed in a close call by how much better the planes agree than in the best pose.

    Sides of an object that differ by a small part score alike. Added to all scores instead of only
    in close calls, the term gains less. Poses that are not `allowed` take no part.
    """
    if allowed is None:
        allowed = jnp.ones(score.shape[0], bool)
    best = jnp.argmax(jnp.where(allowed, score, -jnp.inf))
    change = WEIGHT_PLANE * (plane - plane[best])
    close = allowed & (score > score[best] - CLOSE_CALL_MARGIN)
    return jnp.where(close, score + change, score)


def _one_way(
    moved: Surface,
    other: Surface,
    nearest: Int[Array, "n"],
    sparsity: Float[Array, ""] | float,
) -> ScoreTerms:
    width, plane_width = NEAR_WIDTH * sparsity, PLANE_WIDTH * sparsity
    residual = moved.points - other.points[nearest]
    normal = other.normals[nearest]
    squared = jnp.sum(residual**2, axis=-1)
    height = jnp.sum(residual * normal, axis=-1)
    facing = jnp.sum(moved.normals * normal, axis=-1) ** 2
    near = jnp.exp(-squared / (2 * width**2))
    inside, others_inside = (
        jnp.maximum(0, 1 - openness / BOUNDARY_OPENNESS)
        for openness in (moved.openness, other.openness[nearest])
    )
    off = (squared > (1.5 * width) ** 2) & (squared < (3 * width) ** 2)
    of_points = ScoreTerms(
        match=near * jnp.exp(-(height**2) / (2 * plane_width**2)) * facing,
        descriptor=near * jnp.sum(moved.local * other.local[nearest], axis=-1),
        interior=near * inside * others_inside,
        gap=jnp.where(off, others_inside, 0),
        plane=near * jnp.exp(-(height**2) / (2 * (plane_width / 3) ** 2)),
    )
    count = jnp.maximum(jnp.sum(moved.mask), 1).astype(near.dtype)
    return jax.tree.map(lambda x: jnp.sum(jnp.where(moved.mask, x, 0)) / count, of_points)


def _sum(one: ScoreTerms, other: ScoreTerms) -> ScoreTerms:
    return jax.tree.map(jnp.add, one, other)
