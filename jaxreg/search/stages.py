"""The stages of the search, from two described clouds to ranked poses.

Many poses go into each stage and few come out, at growing cost: hypotheses from matches, screened
by their overlap, aligned coarsely, chosen by a cheap score, aligned finely, ranked by the score.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import export
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import arguments, rigid
from jaxreg.geometry.neighbors import knn
from jaxreg.judge.evidence import read_evidence
from jaxreg.judge.odds import log_odds
from jaxreg.judge.surface import NEIGHBORS, Examined, examine
from jaxreg.search.alignment import align_coarse, align_fine
from jaxreg.search.candidates import MATCHES, select_candidates
from jaxreg.search.compatibility import compatibility
from jaxreg.search.config import SearchConfig
from jaxreg.search.description import Compared, Described, compare
from jaxreg.search.hypotheses import (
    CONSENSUS_SIZE,
    Separation,
    best_of,
    pick_distinct,
    pose_hypotheses,
    screen,
)
from jaxreg.search.learned import Network
from jaxreg.search.nearest import NearestGrid, lookup, nearest_packed
from jaxreg.search.ranking import (
    break_ties,
    score_of,
    score_terms,
    score_terms_by_grid,
    sparsity_factor,
)
from jaxreg.search.surface import Surface, thinned
from jaxreg.types import RigidTransform

_DEFAULT = SearchConfig()
_COARSE_STEP = 2
"""Screening and alignment inside the search take every second point: ranking sees all of them."""
_SCREENED_APART = Separation(angle=0.26, distance=0.15)
"""Poses nearer than this are drawn to one pose by the coarse alignment."""
_ALIGNED_APART = Separation(angle=0.1, distance=0.05)
"""Poses nearer than this are drawn to one pose by the fine alignment."""


class Search(NamedTuple):
    """The aligned poses (leading axis), the best first, with their scores.

    These are of `ranking`, or log odds (`jaxreg.judge`) if the search is `judged`.

    Poses that turn by more than the search permits are not `allowed`, and come last.
    """

    poses: RigidTransform
    score: Float[Array, "s"]
    allowed: Bool[Array, "s"]


export.register_namedtuple_serialization(Search, serialized_name="jaxreg.Search")


class _Problem(NamedTuple):
    """Two clouds to align, and what all stages need to know about them.

    `examined` is None unless the poses are judged.
    """

    source: Surface
    reference: Surface
    grids: tuple[NearestGrid, NearestGrid]
    examined: tuple[Examined, Examined] | None
    sparsity: Float[Array, ""]
    max_angle: Float[Array, ""] | float
    motions: Float[Array, "6 f"] | None


def search_described(
    source: Described,
    reference: Described,
    *,
    network: Network | None = None,
    similarity: Float[Array, "n m"] | None = None,
    also: RigidTransform | None = None,
    max_angle: Float[Array, ""] | float = math.pi,
    up: Float[Array, "3"] | None = None,
    config: SearchConfig = _DEFAULT,
) -> Search:
    """`search_poses` of clouds that were described before, both in one unit.

    The poses map the points of `source` to those of `reference` as they are in these records: about
    their own origins, in units of the search. So does `also`. With `up`, a unit vector that points
    upwards in both clouds, the poses turn about it alone.

    Raises:
      ValueError: what `search_poses` raises.
    """
    arguments.settings("config", config, SearchConfig)
    _check_search(source, reference, similarity, also, max_angle)
    compared = compare(source, reference, network=network)
    if similarity is not None:
        compared = compared._replace(similarity=similarity)
    problem = _Problem(
        compared.source,
        compared.reference,
        (source.grid, reference.grid),
        (_examined(source), _examined(reference)) if config.judged else None,
        sparsity_factor(source.spacing, reference.spacing),
        max_angle,
        None if up is None else _upright_motions(up),
    )
    poses = _screened(_hypotheses(compared, up, config), also, problem, config)
    poses = _shortlisted(_coarsely_aligned(poses, problem), problem, config)
    return _ranked(_finely_aligned(poses, problem), problem)


def _upright_motions(up: Float[Array, "3"]) -> Float[Array, "6 4"]:
    zero = jnp.zeros_like(up)
    turn = jnp.concatenate([up, zero])[:, None]
    shifts = jnp.concatenate([jnp.zeros((3, 3), up.dtype), jnp.eye(3, dtype=up.dtype)])
    return jnp.concatenate([turn, shifts], axis=1)


def _examined(cloud: Described) -> Examined:
    neighbors = cloud.neighbors
    if neighbors is None:
        neighbors = knn(cloud.points, min(NEIGHBORS, len(cloud.points) - 1), cloud.mask)
    return examine(cloud.points, cloud.normals, neighbors, cloud.mask)


def _check_search(source: Described, reference: Described, similarity, also, max_angle) -> None:
    n, m = len(source.mask), len(reference.mask)
    if min(n, m) <= MATCHES:
        raise ValueError(
            f"the clouds have {n} and {m} rows, but the search needs {MATCHES + 1}: give more points, "
            "or pad smaller clouds and give masks."
        )
    if similarity is not None:
        arguments.rows("similarity", similarity, (n, m), source.points)
    if also is not None:
        arguments.transform("also", also)
    arguments.scalar("max_angle", max_angle, source.points.dtype, positive=False)
    if not isinstance(max_angle, Tracer) and not 0 < max_angle <= math.pi + 1e-6:
        raise ValueError(
            f"max_angle = {max_angle}: give an angle in (0, pi], in radians (np.radians(degrees))."
        )


def _hypotheses(
    compared: Compared, up: Float[Array, "3"] | None, config: SearchConfig
) -> RigidTransform:
    source, reference, similarity = jax.lax.stop_gradient(compared)
    candidates = select_candidates(similarity, source.mask, reference.mask, keep=config.candidates)
    i, j = candidates.source_index, candidates.reference_index
    first = compatibility(
        source.points[i],
        reference.points[j],
        source.normals[i],
        reference.normals[j],
        candidates.mask,
        up=up,
    )
    return pose_hypotheses(
        source.points[i],
        reference.points[j],
        first,
        seeds=min(config.seeds, len(i)),
        consensus_size=min(CONSENSUS_SIZE, len(i) - 1),
        up=up,
    )


def _screened(
    poses: RigidTransform, also: RigidTransform | None, problem: _Problem, config: SearchConfig
) -> RigidTransform:
    """The distinct best hypotheses by their overlap in both directions, `also` the first of them."""
    if also is not None:
        poses = jax.tree.map(lambda one, all: jnp.concatenate([one[None], all]), also, poses)
    source, reference, grids, *_, max_angle, _ = problem
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
    return jax.vmap(
        lambda pose: align_coarse(
            pose, few, problem.reference, problem.grids[1], motions=problem.motions
        )
    )(poses)


def _shortlisted(poses: RigidTransform, problem: _Problem, config: SearchConfig) -> RigidTransform:
    """The distinct poses that score best at a glance: the fine alignment is what takes time."""
    at_a_glance = _score_at_a_glance if problem.examined is None else _odds_at_a_glance
    score = jax.vmap(lambda pose: at_a_glance(pose, problem))(poses)
    allowed = _turns_less(poses, problem.max_angle)
    count = min(config.aligned, len(score))
    return best_of(poses, pick_distinct(poses, score, allowed, count=count, apart=_ALIGNED_APART))


def _score_at_a_glance(pose: RigidTransform, problem: _Problem) -> Float[Array, ""]:
    source, reference, grids, _, sparsity, *_ = problem
    terms = score_terms_by_grid(
        pose, source, reference, grids, step=_COARSE_STEP, sparsity=sparsity
    )
    return score_of(terms)


def _odds_at_a_glance(pose: RigidTransform, problem: _Problem) -> Float[Array, ""]:
    assert problem.examined is not None
    source, reference = problem.examined
    few, fewer = (cloud.points[::_COARSE_STEP] for cloud in (source, reference))
    there = lookup(problem.grids[1], rigid.apply(pose, few))
    back = lookup(problem.grids[0], rigid.apply(rigid.inverse(pose), fewer))
    return log_odds(read_evidence(pose, source, reference, there, back, step=_COARSE_STEP))


def _finely_aligned(poses: RigidTransform, problem: _Problem) -> RigidTransform:
    few, fewer = (thinned(s, _COARSE_STEP) for s in (problem.source, problem.reference))
    return jax.lax.map(lambda pose: align_fine(pose, few, fewer, motions=problem.motions), poses)


def _ranked(poses: RigidTransform, problem: _Problem) -> Search:
    """The poses, the allowed ones first, then by what speaks for them."""
    # Again, because alignment may have turned a pose out of the bounds of the search.
    allowed = _turns_less(poses, problem.max_angle)
    if problem.examined is None:
        score = _scored(poses, problem, allowed)
    else:
        score = _judged(poses, *problem.examined)
    order = jnp.lexsort((-score, ~allowed))
    return Search(best_of(poses, order), score[order], allowed[order])


def _scored(
    poses: RigidTransform, problem: _Problem, allowed: Bool[Array, "s"]
) -> Float[Array, "s"]:
    """The scores of `ranking`, with ties broken."""

    def terms_of(pose: RigidTransform):
        return score_terms(pose, problem.source, problem.reference, sparsity=problem.sparsity)

    terms = jax.lax.map(terms_of, poses)
    return break_ties(score_of(terms), terms.plane, allowed)


def _judged(poses: RigidTransform, source: Examined, reference: Examined) -> Float[Array, "s"]:
    """The log odds of `jaxreg.judge`."""

    def judged(pose: RigidTransform):
        moved = rigid.apply(pose, source.points)
        there = nearest_packed(moved, reference.points, reference.mask)
        back = nearest_packed(reference.points, moved, source.mask)
        return log_odds(read_evidence(pose, source, reference, there, back))

    return jax.lax.map(judged, poses)


def _turns_less(poses: RigidTransform, angle: Array | float) -> Bool[Array, "s"]:
    trace = jnp.sum(jnp.diagonal(poses.rotation, axis1=1, axis2=2), axis=1)
    return trace >= 1 + 2 * jnp.cos(jnp.minimum(angle, math.pi)) - 1e-5
