"""Registration without a start, from two clouds to a pose: describe, match, hypothesise, align, rank.

Pure functions of one pair: compose them with `jax.jit`, `jax.vmap` and `jax.grad`.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import frame, rigid
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.gicp import gicp
from jaxreg.search.alignment import FINE_EPSILON, align_coarse, align_fine
from jaxreg.search.candidates import MATCHES, select_candidates
from jaxreg.search.compatibility import compatibility
from jaxreg.search.config import SearchConfig
from jaxreg.search.description import Compared, Described, check_cloud, compare, describe
from jaxreg.search.hypotheses import (
    CONSENSUS_SIZE,
    Separation,
    best_of,
    pick_distinct,
    pose_hypotheses,
    screen,
)
from jaxreg.search.learned import Network
from jaxreg.search.nearest import NearestGrid, nearest_packed
from jaxreg.search.ranking import (
    NEAR_WIDTH,
    break_ties,
    score_of,
    score_terms,
    score_terms_by_grid,
    sparsity_factor,
)
from jaxreg.search.surface import Surface, thinned
from jaxreg.types import GlobalRegistration, RigidTransform

_DEFAULT = SearchConfig()
_RMS_OF_UNIT_SPHERE = 0.5
"""Root mean square radius of a usual shape that touches the unit sphere (ModelNet40: 0.4 to 0.6)."""
_COARSE_STEP = 2
"""Screening and alignment inside the search take every second point: ranking sees all of them."""
_SCREENED_APART = Separation(angle=0.26, distance=0.15)
"""Poses nearer than this are drawn to one pose by the coarse alignment."""
_ALIGNED_APART = Separation(angle=0.1, distance=0.05)
"""Poses nearer than this are drawn to one pose by the fine alignment."""
_FINAL_REACH = 0.06
"""Largest distance of the pairs of the last refinement, in units of the search, for dense clouds."""


_FINAL = RefineConfig(
    iterations=15,
    kernel_annealing=8.0,
    both_directions=True,
    k=16,
    epsilon=FINE_EPSILON,
    correspondences_per_point=2,
    edges=True,
)
"""The last refinement, of the best pose alone."""


class Search(NamedTuple):
    """The aligned poses (leading axis), the best first, with their scores (`ranking`).

    Poses that turn by more than the search may are not `allowed`, and come last.
    """

    poses: RigidTransform
    score: Float[Array, "s"]
    allowed: Bool[Array, "s"]


class _Problem(NamedTuple):
    """Two clouds that are to be laid on each other, and what all stages need to know of them."""

    source: Surface
    reference: Surface
    grids: tuple[NearestGrid, NearestGrid]
    sparsity: Float[Array, ""]
    max_angle: Float[Array, ""] | float


def register_global(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    network: Network | None = None,
    similarity: Float[Array, "n m"] | None = None,
    max_angle: Float[Array, ""] | float = math.pi,
    config: SearchConfig = _DEFAULT,
) -> GlobalRegistration:
    """The pose of the source in the frame of the reference, from any start.

    Points are matched by their moments, without learning; or, given a `network`
    (`jaxreg.search.load_features`), by what it makes of these; or by a `similarity` of your own, the
    cosines in [-1, 1] of any features.

    `correspondences[i]` is the reference point nearest to source point i under the pose;
    `confidence[i]` is ``exp(-d^2 / 2 w^2)`` of its distance d, with w `ranking.NEAR_WIDTH` units of
    the search. The pose is differentiable in both clouds through the last refinement alone: the
    search is discrete.

    `max_angle` (radians) bounds how far the clouds may be turned, which settles symmetric shapes; where
    the search finds no pose within it, the best of all is returned. `score` is that of `ranking`, of
    the pose before the last refinement.

    Raises:
      ValueError: a cloud is not (n, 3) of floats or has fewer than four rows, a mask or the similarity
        has another shape, `max_angle` is not in (0, pi], or `network` was trained for other radii.
    """
    where, x, y = enter(source, reference, source_mask, reference_mask, unit=config.unit)
    described = (
        describe(x, source_mask, unit=1.0, config=config),
        describe(y, reference_mask, unit=1.0, config=config),
    )
    found = search_described(
        *described, network=network, similarity=similarity, max_angle=max_angle, config=config
    )
    start = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf[0]), found.poses)
    sparsity = sparsity_factor(*(cloud.spacing for cloud in described))
    pose = gicp(
        x,
        y,
        initial=start,
        source_mask=source_mask,
        reference_mask=reference_mask,
        config=dataclasses.replace(_FINAL, k=min(_FINAL.k, min(len(x), len(y)) - 1)),
        max_correspondence_distance=_FINAL_REACH * sparsity,
    ).transform
    return _registration(
        where, pose, (x, y), (described[0].mask, described[1].mask), found.score[0]
    )


def search_poses(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    network: Network | None = None,
    similarity: Float[Array, "n m"] | None = None,
    also: RigidTransform | None = None,
    max_angle: Float[Array, ""] | float = math.pi,
    config: SearchConfig = _DEFAULT,
) -> Search:
    """The poses of the search before the last refinement; arguments and errors as `register_global`.

    `also` is a pose that is tried beside those found. Poses that turn by more than `max_angle`
    (radians) are not allowed.
    """
    where, x, y = enter(source, reference, source_mask, reference_mask, unit=config.unit)
    if also is not None:
        _check_transform(also)
        also = frame.transform_in(where, also)
    found = search_described(
        describe(x, source_mask, unit=1.0, config=config),
        describe(y, reference_mask, unit=1.0, config=config),
        network=network,
        similarity=similarity,
        also=also,
        max_angle=max_angle,
        config=config,
    )
    return found._replace(poses=jax.vmap(lambda p: frame.transform_out(where, p))(found.poses))


def search_described(
    source: Described,
    reference: Described,
    *,
    network: Network | None = None,
    similarity: Float[Array, "n m"] | None = None,
    also: RigidTransform | None = None,
    max_angle: Float[Array, ""] | float = math.pi,
    config: SearchConfig = _DEFAULT,
) -> Search:
    """`search_poses` of clouds that were described before, both in one unit.

    The poses map the points of `source` to those of `reference` as they stand in these records: about
    their own origins, in units of the search. So does `also`.

    Raises:
      ValueError: as `search_poses`.
    """
    _check_search(source, reference, similarity, also, max_angle)
    compared = compare(source, reference, network=network)
    if similarity is not None:
        compared = compared._replace(similarity=similarity)
    problem = _Problem(
        compared.source,
        compared.reference,
        (source.grid, reference.grid),
        sparsity_factor(source.spacing, reference.spacing),
        max_angle,
    )
    poses = _screened(_hypotheses(compared, config), also, problem, config)
    poses = _shortlisted(_coarsely_aligned(poses, problem), problem, config)
    return _ranked(_finely_aligned(poses, problem), problem)


def enter(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    *,
    unit: float | None = None,
) -> tuple[frame.Frame, Float[Array, "n 3"], Float[Array, "m 3"]]:
    """Both clouds about their centroids in units of the search, and the frame that leads back.

    `unit` is `SearchConfig.unit`. Errors as `register_global`.
    """
    check_cloud("source", source, source_mask)
    check_cloud("reference", reference, reference_mask)
    where, x, y = frame.enter(source, reference, source_mask, reference_mask)
    factor = _RMS_OF_UNIT_SPHERE if unit is None else where.length / unit
    return where._replace(length=where.length / factor), x * factor, y * factor


def _check_search(source: Described, reference: Described, similarity, also, max_angle) -> None:
    n, m = len(source.mask), len(reference.mask)
    if min(n, m) <= MATCHES:
        raise ValueError(
            f"the clouds have {n} and {m} rows, and the search needs {MATCHES + 1}: give more points, "
            "or pad smaller clouds and give masks."
        )
    if similarity is not None and similarity.shape != (n, m):
        raise ValueError(
            f"similarity must have shape {(n, m)}, a row for every source point and a column for every "
            f"reference point, got {similarity.shape}."
        )
    if also is not None:
        _check_transform(also)
    if not isinstance(max_angle, jax.core.Tracer) and not 0 < max_angle <= math.pi + 1e-6:
        raise ValueError(
            f"max_angle = {max_angle}: give an angle in (0, pi], in radians (np.radians(degrees))."
        )


def _check_transform(also: RigidTransform) -> None:
    if (also.rotation.shape, also.translation.shape) != ((3, 3), (3,)):
        raise ValueError(
            f"also must be one transform with a rotation (3, 3) and a translation (3,), got "
            f"{also.rotation.shape} and {also.translation.shape}."
        )


def _hypotheses(compared: Compared, config: SearchConfig) -> RigidTransform:
    source, reference, similarity = jax.lax.stop_gradient(compared)
    candidates = select_candidates(similarity, source.mask, reference.mask, keep=config.candidates)
    i, j = candidates.source_index, candidates.reference_index
    first = compatibility(
        source.points[i],
        reference.points[j],
        source.normals[i],
        reference.normals[j],
        candidates.mask,
    )
    return pose_hypotheses(
        source.points[i],
        reference.points[j],
        first,
        seeds=min(config.seeds, len(i)),
        consensus_size=min(CONSENSUS_SIZE, len(i) - 1),
    )


def _screened(
    poses: RigidTransform, also: RigidTransform | None, problem: _Problem, config: SearchConfig
) -> RigidTransform:
    """The distinct best hypotheses by their overlap in both directions, `also` the first of them."""
    if also is not None:
        poses = jax.tree.map(lambda one, all: jnp.concatenate([one[None], all]), also, poses)
    source, reference, grids, _, max_angle = problem
    score = screen(poses, thinned(source, _COARSE_STEP), reference, grids[1])
    back = jax.vmap(rigid.inverse)(poses)
    score = score + screen(back, thinned(reference, _COARSE_STEP), source, grids[0])
    allowed = _turns_less(poses, max_angle)
    if also is not None:
        score, allowed = score.at[0].set(jnp.inf), allowed.at[0].set(True)
    count = min(config.screened, len(score))
    chosen = pick_distinct(poses, score, allowed, count=count, apart=_SCREENED_APART)
    return best_of(poses, chosen)


def _coarsely_aligned(poses: RigidTransform, problem: _Problem) -> RigidTransform:
    few = thinned(problem.source, _COARSE_STEP)
    return jax.vmap(lambda pose: align_coarse(pose, few, problem.reference, problem.grids[1]))(
        poses
    )


def _shortlisted(poses: RigidTransform, problem: _Problem, config: SearchConfig) -> RigidTransform:
    """The distinct poses that score best at a glance: the fine alignment is what takes time."""
    source, reference, grids, sparsity, max_angle = problem

    def at_a_glance(pose: RigidTransform):
        return score_of(
            score_terms_by_grid(
                pose, source, reference, grids, step=_COARSE_STEP, sparsity=sparsity
            )
        )

    score, allowed = jax.vmap(at_a_glance)(poses), _turns_less(poses, max_angle)
    count = min(config.aligned, len(score))
    return best_of(poses, pick_distinct(poses, score, allowed, count=count, apart=_ALIGNED_APART))


def _finely_aligned(poses: RigidTransform, problem: _Problem) -> RigidTransform:
    few, fewer = (thinned(s, _COARSE_STEP) for s in (problem.source, problem.reference))
    return jax.lax.map(lambda pose: align_fine(pose, few, fewer), poses)


def _ranked(poses: RigidTransform, problem: _Problem) -> Search:
    """The poses, the allowed ones first, then by their score, with ties broken."""
    source, reference, _, sparsity, max_angle = problem
    terms = jax.lax.map(lambda pose: score_terms(pose, source, reference, sparsity=sparsity), poses)
    # Again, since alignment may have turned a pose out of the bounds of the search.
    allowed = _turns_less(poses, max_angle)
    score = break_ties(score_of(terms), terms.plane, allowed)
    order = jnp.lexsort((-score, ~allowed))
    return Search(best_of(poses, order), score[order], allowed[order])


def _turns_less(poses: RigidTransform, angle: Array | float) -> Bool[Array, "s"]:
    trace = jnp.sum(jnp.diagonal(poses.rotation, axis1=1, axis2=2), axis=1)
    return trace >= 1 + 2 * jnp.cos(jnp.minimum(angle, math.pi)) - 1e-5


def _registration(
    where: frame.Frame,
    pose: RigidTransform,
    clouds: tuple[Array, Array],
    masks: tuple[Array, Array],
    score: Array,
) -> GlobalRegistration:
    """The result in the frame and unit of the input; the identity where a cloud has no point."""
    (source, reference), (source_mask, reference_mask) = clouds, masks
    valid = jnp.any(source_mask) & jnp.any(reference_mask)
    identity = rigid.identity(source.dtype)
    pose = jax.tree.map(lambda p, i: jnp.where(valid, p, i), pose, identity)
    moved = rigid.apply(pose, source)
    nearest = nearest_packed(moved, reference, reference_mask)
    squared = jnp.sum((moved - reference[nearest]) ** 2, axis=-1)
    trust = jnp.where(source_mask & valid, jnp.exp(-squared / (2 * NEAR_WIDTH**2)), 0)
    correspondences = reference[nearest] * where.length + where.reference_centre[None, :]
    pose = frame.transform_out(where, pose)
    pose = jax.tree.map(lambda p, i: jnp.where(valid, p, i), pose, identity)
    matrix = rigid.to_matrix(pose)
    return GlobalRegistration(*pose, matrix, trust, correspondences, score, valid)
