"""Registration without a start, from two clouds to a pose: describe, match, hypothesise, align, rank.

Pure functions of one pair: use them under `jax.jit`, `jax.vmap` and `jax.grad`.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxreg._xla import on_any_mesh
from jaxreg.geometry import arguments, frame, rigid
from jaxreg.geometry.numerics import all_finite
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.methods import refine
from jaxreg.search.config import SearchConfig
from jaxreg.search.description import Described, describe
from jaxreg.search.learned import Network
from jaxreg.search.nearest import nearest_packed
from jaxreg.search.ranking import NEAR_WIDTH, sparsity_factor
from jaxreg.search.stages import Search, search_described
from jaxreg.types import GlobalRegistration, RigidTransform

_DEFAULT = SearchConfig()
_RMS_OF_UNIT_SPHERE = 0.5
"""Root mean square radius of a usual shape that touches the unit sphere (ModelNet40: 0.4 to 0.6)."""


@on_any_mesh
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
    """Register two clouds without a start: the pose of the source in the frame of the reference.

    Points are matched by moments of the surface around them, by learned features (`network`, from
    `jaxreg.load_features`), or by your own `similarity`, the cosines in [-1, 1] of any features.

    `correspondences[i]` is the reference point nearest to source point i under the pose;
    `confidence[i]` is ``exp(-d^2 / 2 w^2)`` of its distance d, with w NEAR_WIDTH units of
    the search. The pose is differentiable in both clouds, through the last refinement only: the
    search is discrete.

    A cloud with a point that is not finite counts as empty: `valid` is False, the pose the identity.
    So it is where the similarity of two points, or a weight of the network, is not finite.

    `max_angle` (radians) bounds the rotation, which decides between the poses of a symmetric shape;
    if the search finds no pose within it, the best of all is returned. `score` is
    that of `ranking`, of the pose before the last refinement.

    Raises:
      ValueError: a cloud is not (n, 3) of float32 or float64 or has fewer than four rows, a mask or
        the similarity has another shape or dtype, `max_angle` is not in (0, pi], or `network` was
        trained for other radii.
    """
    where, clouds, described = _described(
        source, reference, source_mask, reference_mask, similarity, network, config
    )
    found = search_described(
        *described, network=network, similarity=similarity, max_angle=max_angle, config=config
    )
    sparsity = sparsity_factor(described[0].spacing, described[1].spacing)
    start = jax.tree.map(lambda leaf: leaf[0], found.poses)
    masks = described[0].mask, described[1].mask
    pose = _refined(clouds, masks, start, sparsity, config.final)
    return _registration(where, pose, clouds, masks, found.score[0])


@on_any_mesh
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
    """The poses of the search before the last refinement; arguments and errors of `register_global`.

    `also`: one more pose to try. Poses that turn by more than `max_angle` (radians) are not allowed.
    """
    where, _, described = _described(
        source, reference, source_mask, reference_mask, similarity, network, config
    )
    if also is not None:
        also = frame.transform_in(where, arguments.transform("also", also))
    found = search_described(
        *described,
        network=network,
        similarity=similarity,
        also=also,
        max_angle=max_angle,
        config=config,
    )
    return found._replace(poses=jax.vmap(lambda p: frame.transform_out(where, p))(found.poses))


def _described(
    source: Array,
    reference: Array,
    source_mask: Array | None,
    reference_mask: Array | None,
    similarity: Array | None,
    network: Network | None,
    config: SearchConfig,
) -> tuple[frame.Frame, tuple[Array, Array], tuple[Described, Described]]:
    """The frame of two checked clouds, their points in it, and what the search compares.

    Features that are not finite say of no point what it is like, so that the source counts as empty.
    """
    arguments.settings("config", config, SearchConfig)
    source, reference = arguments.clouds(source, reference)
    source_mask = arguments.usable("source_mask", source, source_mask)
    reference_mask = arguments.usable("reference_mask", reference, reference_mask)
    if similarity is not None:
        shape = source.shape[0], reference.shape[0]
        similarity = arguments.rows("similarity", similarity, shape, source)
        both = source_mask[:, None] & reference_mask[None, :]
        source_mask &= all_finite(jnp.where(both, similarity, 0))
    source_mask &= all_finite(network)
    where, x, y = enter(source, reference, source_mask, reference_mask, unit=config.unit)
    one = describe(x, source_mask, unit=1.0, config=config)
    other = describe(y, reference_mask, unit=1.0, config=config)
    return where, (x, y), (one, other)


def enter(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
    *,
    unit: float | None = None,
) -> tuple[frame.Frame, Float[Array, "n 3"], Float[Array, "m 3"]]:
    """Both clouds about their centroids in units of the search, and the frame to undo that.

    `unit` is `SearchConfig.unit`. Raises what `register_global` raises.
    """
    where, x, y = frame.enter(source, reference, source_mask, reference_mask)
    factor = _RMS_OF_UNIT_SPHERE if unit is None else where.length / unit
    return where._replace(length=where.length / factor), x * factor, y * factor


def _refined(
    clouds: tuple[Array, Array],
    masks: tuple[Array | None, Array | None],
    start: RigidTransform,
    sparsity: Array,
    config: RefineConfig,
) -> RigidTransform:
    """The pose after the last refinement, the only part through which it is differentiable."""
    k = min(config.k, *(len(cloud) - 1 for cloud in clouds))
    return refine(
        *clouds,
        initial=jax.lax.stop_gradient(start),
        source_mask=masks[0],
        reference_mask=masks[1],
        config=dataclasses.replace(config, k=k),
        max_correspondence_distance=config.max_correspondence_distance * sparsity,
    ).transform


def _registration(
    where: frame.Frame,
    pose: RigidTransform,
    clouds: tuple[Array, Array],
    masks: tuple[Array, Array],
    score: Array,
) -> GlobalRegistration:
    """The result in the frame and unit of the input; the identity if a cloud has no point."""
    (source, reference), (source_mask, reference_mask) = clouds, masks
    valid = jnp.any(source_mask) & jnp.any(reference_mask)
    pose = rigid.identity_unless(valid, pose)
    moved = rigid.apply(pose, source)
    nearest = nearest_packed(moved, reference, reference_mask)
    squared = jnp.sum((moved - reference[nearest]) ** 2, axis=-1)
    trust = jnp.where(source_mask & valid, jnp.exp(-squared / (2 * NEAR_WIDTH**2)), 0)
    correspondences = reference[nearest] * where.length + where.reference_centre[None, :]
    pose = rigid.identity_unless(valid, frame.transform_out(where, pose))
    matrix = rigid.to_matrix(pose)
    return GlobalRegistration(*pose, matrix, trust, correspondences, score, valid)
