"""The dense path from two clouds to a pose; jit, vmap and grad it."""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import frame, rigid
from jaxreg.geometry.neighbors import squared_distances
from jaxreg.geometry.numerics import safe_sqrt
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.gicp import gicp
from jaxreg.search.alignment import align_coarse, align_fine
from jaxreg.search.candidates import select_candidates
from jaxreg.search.compatibility import compatibility
from jaxreg.search.config import SearchConfig
from jaxreg.search.descriptors import Descriptors, moment_descriptors, openness, standardized
from jaxreg.search.hypotheses import best_of, pick_distinct, pose_hypotheses, screen
from jaxreg.search.learned import Network, learned_features
from jaxreg.search.nearest import NearestGrid, nearest_grid, nearest_packed
from jaxreg.search.ranking import Evidence, evidence, evidence_by_grid, plausibility, settle
from jaxreg.search.surface import Surface, thinned
from jaxreg.types import Registration, RigidTransform

_DEFAULT = SearchConfig()
_RMS_OF_UNIT_SPHERE = 0.5
"""Root mean square radius of a usual shape that touches the unit sphere (ModelNet40: 0.4 to 0.6)."""


class Search(NamedTuple):
    """The aligned poses (leading axis), best first, in the original frame, and their plausibility.

    In close calls it is that of `verification.settle`.
    """

    poses: RigidTransform
    score: Float[Array, "s"]


def register_global(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    network: Network | None = None,
    similarity: Float[Array, "n m"] | None = None,
    config: SearchConfig = _DEFAULT,
) -> Registration:
    """The pose of the source in the frame of the reference, from any start.

    Points are matched by their moments, without learning; or, given a `network`
    (`jaxreg.search.load_network`), by what it makes of these; or by a `similarity` of your own, the
    cosines in [-1, 1] of any features.

    `correspondences[i]` is the reference point nearest to source point i under the pose;
    `confidence[i]` is ``exp(-d^2 / 2 w^2)`` of its distance d, with w `config.match_width`. The pose
    is differentiable in both clouds through the last refinement alone: the search is discrete.

    Raises:
      ValueError: a cloud is not (n, 3), or has fewer points than `config.matches` + 1.
    """
    where, x, y = enter(source, reference, source_mask, reference_mask, config)
    found = _search(x, y, source_mask, reference_mask, network, similarity, config)
    start = jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf[0]), found.poses)
    widening = _widening(x, y, source_mask, reference_mask, config)
    pose = gicp(
        x,
        y,
        initial=start,
        source_mask=source_mask,
        reference_mask=reference_mask,
        config=RefineConfig(
            iterations=config.final_iterations,
            kernel_annealing=config.final_anneal,
            both_directions=True,
            k=min(config.final_neighbors, min(len(x), len(y)) - 1),
            epsilon=config.thickness,
            correspondences_per_point=config.final_partners,
            edges=True,
        ),
        max_correspondence_distance=config.final_reach * jax.lax.stop_gradient(widening),
    ).transform
    return _registration(where, pose, x, y, source_mask, reference_mask, config)


def search_poses(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    network: Network | None = None,
    similarity: Float[Array, "n m"] | None = None,
    also: RigidTransform | None = None,
    largest_angle: Float[Array, ""] | float = math.pi,
    config: SearchConfig = _DEFAULT,
) -> Search:
    """The poses of the search before the last refinement; arguments and errors as `register_global`.

    `also` is a pose that is tried beside those found. Poses that turn by more than `largest_angle`
    (radians) come last, with a score 10 lower.
    """
    where, x, y = enter(source, reference, source_mask, reference_mask, config)
    also = None if also is None else frame.transform_in(where, also)
    found = _search(
        x, y, source_mask, reference_mask, network, similarity, config, also, largest_angle
    )
    return found._replace(poses=jax.vmap(lambda p: frame.transform_out(where, p))(found.poses))


def enter(source, reference, source_mask, reference_mask, config: SearchConfig):
    """Both clouds centred, in units of which a usual shape fills the unit sphere."""
    where, x, y = frame.enter(source, reference, source_mask, reference_mask)
    factor = _RMS_OF_UNIT_SPHERE if config.unit == 0 else where.length / config.unit
    where = where._replace(length=where.length / factor)
    return where, x * factor, y * factor


def surfaces(x, y, source_mask, reference_mask, config: SearchConfig, network=None):
    """Both clouds with normals, rims and local features, and the cosines of all their features.

    These are the moments, or what `network` makes of them.
    """
    masks = [
        jnp.ones(points.shape[0], bool) if mask is None else mask
        for points, mask in ((x, source_mask), (y, reference_mask))
    ]
    described, rims = zip(
        *(_described(points, mask, config) for points, mask in zip((x, y), masks, strict=True)),
        strict=True,
    )
    features = [cloud.features for cloud in described]
    local = standardized(*(f[:, : f.shape[1] // len(config.radii)] for f in features), *masks)
    source, reference = (
        Surface(points, cloud.normals, rim, nearby, mask)
        for points, cloud, rim, nearby, mask in zip(
            (x, y), described, rims, local, masks, strict=True
        )
    )
    one, other = standardized(*features, *masks)
    if network is not None:
        one, other = (
            learned_features(network, moments, s.openness, s.points, s.normals, s.mask)
            for moments, s in ((one, source), (other, reference))
        )
    return source, reference, jnp.matmul(one, other.T)


@functools.partial(jax.jit, static_argnames="config")  # Traced once for two clouds of one size.
def _described(points: Array, mask: Array, config: SearchConfig) -> tuple[Descriptors, Array]:
    """Descriptors of a cloud, and how open it is around every point."""
    cloud = moment_descriptors(points, mask, radii=config.radii, normal_radius=config.normal_radius)
    return cloud, openness(points, cloud.normals, mask, radius=config.rim_radius)


def _search(
    x,
    y,
    source_mask,
    reference_mask,
    network,
    similarity,
    config: SearchConfig,
    also=None,
    largest_angle=math.pi,
) -> Search:
    x, y, similarity = jax.lax.stop_gradient((x, y, similarity))
    source, reference, found = surfaces(x, y, source_mask, reference_mask, config, network)
    poses = _hypotheses(source, reference, found if similarity is None else similarity, config)
    grids = [
        nearest_grid(s.points, s.mask, cells=config.grid_cells, margin=config.screen_width)
        for s in (reference, source)
    ]
    poses = _screened(poses, also, source, reference, grids, largest_angle, config)
    few, fewer = (thinned(s, config.coarse_step) for s in (source, reference))
    coarse = lambda pose: align_coarse(  # noqa: E731
        pose,
        few,
        reference,
        grids[0],
        config.coarse_widths,
        thickness=config.coarse_thickness,
    )
    fine = lambda pose: align_fine(  # noqa: E731
        pose, few, fewer, config.fine_widths, thickness=config.thickness
    )
    widening = _widening(x, y, source_mask, reference_mask, config)
    poses = jax.vmap(coarse)(poses)
    poses = _shortlist(poses, source, reference, grids, widening, largest_angle, config)
    poses = jax.lax.map(fine, poses)
    return _ranked(poses, source, reference, widening, largest_angle, config)


def _hypotheses(source: Surface, reference: Surface, similarity: Array, config: SearchConfig):
    candidates = select_candidates(
        similarity,
        source.mask,
        reference.mask,
        matches=config.matches,
        keep=config.candidates,
    )
    i, j = candidates.source_index, candidates.reference_index
    first = compatibility(
        source.points[i],
        reference.points[j],
        source.normals[i],
        reference.normals[j],
        candidates.mask,
        tolerance=config.tolerance,
        normal_tolerance=config.normal_tolerance,
    )
    return pose_hypotheses(
        source.points[i],
        reference.points[j],
        first,
        seeds=min(config.seeds, len(i)),
        partners=min(config.partners, len(i) - 1),
    )


def _screened(
    poses,
    also,
    source: Surface,
    reference: Surface,
    grids: list[NearestGrid],
    largest_angle,
    config: SearchConfig,
):
    """The distinct best hypotheses by their overlap in both directions, `also` the first of them."""
    if also is not None:
        poses = jax.tree.map(lambda one, all: jnp.concatenate([one[None], all]), also, poses)
    a, b = thinned(source, config.coarse_step), thinned(reference, config.coarse_step)
    backward = jax.vmap(rigid.inverse)(poses)
    score = screen(poses, a, reference, grids[0], width=config.screen_width)
    score = score + screen(backward, b, source, grids[1], width=config.screen_width)
    score = _bounded(score, poses, largest_angle)
    if also is not None:
        score = score.at[0].set(5)
    return _distinct_best(
        poses, score, config.screened, config.distinct_angle, config.distinct_distance
    )


def _distinct_best(poses, score: Array, most: int, angle: float, distance: float) -> RigidTransform:
    count = min(most, len(score))
    return best_of(poses, pick_distinct(poses, score, count=count, angle=angle, distance=distance))


def _bounded(score: Array, poses: RigidTransform, largest_angle) -> Float[Array, "s"]:
    """The scores (within a few units of 0), those of poses that turn too far below all others."""
    return jnp.where(_turns_less(poses, largest_angle), score, score - 10)


def _turns_less(poses: RigidTransform, angle: Array | float) -> Bool[Array, "s"]:
    trace = jnp.sum(jnp.diagonal(poses.rotation, axis1=1, axis2=2), axis=1)
    return trace >= 1 + 2 * jnp.cos(jnp.minimum(angle, math.pi)) - 1e-5


def _shortlist(
    poses,
    source: Surface,
    reference: Surface,
    grids: list[NearestGrid],
    widening: Array,
    largest_angle,
    config: SearchConfig,
) -> RigidTransform:
    """The distinct poses that are plausible at a glance: the last alignment is what takes time."""
    found = jax.vmap(
        lambda pose: evidence_by_grid(
            pose,
            source,
            reference,
            grids[1],
            grids[0],
            step=config.coarse_step,
            width=config.match_width * widening,
            plane_width=config.plane_width * widening,
            rim=config.rim,
        )
    )(poses)
    return _distinct_best(
        poses,
        _bounded(_score(found, config), poses, largest_angle),
        config.aligned,
        config.aligned_angle,
        config.aligned_distance,
    )


def _ranked(
    poses,
    source: Surface,
    reference: Surface,
    widening: Array,
    largest_angle,
    config: SearchConfig,
) -> Search:
    """The poses, the most plausible first, and their plausibility, settled in close calls."""
    found = jax.lax.map(
        lambda pose: evidence(
            pose,
            source,
            reference,
            width=config.match_width * widening,
            plane_width=config.plane_width * widening,
            rim=config.rim,
        ),
        poses,
    )
    # Again, since alignment may have turned a pose out of the bounds of the search.
    score = _bounded(_score(found, config), poses, largest_angle)
    score = settle(score, found.flush, doubt=config.doubt, worth=config.flush)
    score, order = jax.lax.top_k(score, len(score))
    return Search(best_of(poses, order), score)


def _score(found: Evidence, config: SearchConfig) -> Float[Array, "s"]:
    return plausibility(found, alike=config.alike, within=config.within, beside=config.beside)


def _widening(x, y, source_mask, reference_mask, config: SearchConfig) -> Float[Array, ""]:
    """How much farther apart than in dense clouds the points of matching surfaces lie."""
    sparse = jnp.maximum(_spacing(x, source_mask), _spacing(y, reference_mask))
    return jnp.maximum(sparse / config.dense_spacing, 1)


def _spacing(points: Array, mask: Array | None) -> Float[Array, ""]:
    """Mean distance from a point to the nearest other one."""
    mask = jnp.ones(len(points), bool) if mask is None else mask
    squared = squared_distances(points, points)
    other = mask[None, :] & ~jnp.eye(len(mask), dtype=bool)
    nearest = safe_sqrt(jnp.min(jnp.where(other, squared, 4), axis=1))
    count = jnp.maximum(jnp.sum(mask), 1).astype(squared.dtype)
    return jnp.sum(jnp.where(mask, nearest, 0)) / count


def _registration(
    where, pose, x, y, source_mask, reference_mask, config: SearchConfig
) -> Registration:
    source_mask, reference_mask = (
        jnp.ones(points.shape[0], bool) if mask is None else mask
        for points, mask in ((x, source_mask), (y, reference_mask))
    )
    valid = jnp.any(source_mask) & jnp.any(reference_mask)
    pose = jax.tree.map(lambda p, i: jnp.where(valid, p, i), pose, rigid.identity(x.dtype))
    moved = rigid.apply(pose, x)
    nearest = nearest_packed(moved, y, reference_mask)
    squared = jnp.sum((moved - y[nearest]) ** 2, axis=-1)
    trust = jnp.exp(-squared / (2 * config.match_width**2))
    trust = jnp.where(source_mask & valid, trust, 0)
    pose = frame.transform_out(where, pose)
    correspondences = y[nearest] * where.length + where.reference_centre[None, :]
    pose = jax.tree.map(lambda p, i: jnp.where(valid, p, i), pose, rigid.identity(x.dtype))
    return Registration(*pose, rigid.to_matrix(pose), trust, correspondences, valid)
