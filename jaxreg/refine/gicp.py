"""Generalised ICP, plane to plane (Segal, Haehnel and Thrun, 2009), by Gauss-Newton."""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg.geometry import eigen3x3, frame, rigid
from jaxreg.geometry.neighbors import knn
from jaxreg.geometry.normals import edge_normals, normals, surface_covariances
from jaxreg.refine.config import RefineConfig
from jaxreg.refine.correspondences import Pairs, closest_pairs, with_neighbors
from jaxreg.refine.gauss_newton import gauss_newton_step
from jaxreg.refine.robust import Kernel, Weighting, check_options, pair_weights, widenings
from jaxreg.types import RigidTransform

_DEFAULT = RefineConfig()


def gicp(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    source_covariances: Float[Array, "n 3 3"] | None = None,
    reference_covariances: Float[Array, "m 3 3"] | None = None,
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
    thickness: float = _DEFAULT.thickness,
    partners: int = 1,
    edges: bool = _DEFAULT.edges,
) -> RigidTransform:
    """The pose after a fixed number of Gauss-Newton steps on ``sum_i w_i r_i^T M_i r_i``.

    ``r_i = R x_i + t - y_i`` with ``y_i`` nearest to the moved ``x_i``, and
    ``M_i = 2 e (C_y + R C_x R^T)^-1``, held fixed during a step, where ``e`` is `thickness`: of
    covariances that are as small across a surface, a residual across two parallel ones then counts
    as its length.
    Covariances that are not given are those of planes: 1 along, `thickness` across, from
    `neighbors` neighbours; with `edges`, of surfaces that end (`normals.edge_normals`).
    `kernel` weighs ``sqrt(r^T M r)``. With more than one of `partners`, a
    point is also paired with the nearest neighbours of its partner, which averages the noise of
    their planes. Everything else is as for `icp`.

    Raises:
      ValueError: a shape or an option is wrong, or a cloud whose neighbours are needed has not more
        than `neighbors` points.
    """
    check_options(iterations=iterations, trim=trim, anneal=anneal)
    if not 1 <= partners <= neighbors + 1:
        raise ValueError(
            f"partners = {partners}: choose 1 to neighbors + 1 = {neighbors + 1}, since the others "
            "are neighbours of the first."
        )
    where, x, y = frame.enter(source, reference, source_mask, reference_mask)
    weighting = Weighting(kernel, scale, max_distance, trim).in_units_of(where.length)

    def described(cloud, mask, covariances):
        if covariances is not None and partners == 1:
            return None, covariances
        graph = knn(cloud, neighbors, mask)
        if covariances is None:
            across = normals(cloud, graph, mask)
            ends = edge_normals(cloud, graph, across, mask) if edges else None
            covariances = surface_covariances(across, thickness, ends)
        return graph[:, : partners - 1], covariances

    near_source, source_covariances = described(x, source_mask, source_covariances)
    near_reference, reference_covariances = described(y, reference_mask, reference_covariances)

    def step(pose: RigidTransform, widening: Array):
        pairs = closest_pairs(
            rigid.apply(pose, x), y, source_mask, reference_mask, both_directions=both_directions
        )
        if partners > 1:
            pairs = with_neighbors(pairs, near_source, near_reference, forward=x.shape[0])
        return gicp_step(
            pose,
            x,
            y,
            source_covariances,
            reference_covariances,
            pairs,
            weighting,
            widening,
            thickness=thickness,
        ), None

    start = frame.transform_in(where, initial)
    pose, _ = jax.lax.scan(step, start, widenings(iterations, anneal, x.dtype))
    return frame.transform_out(where, pose)


def gicp_step(
    pose: RigidTransform,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    source_covariances: Float[Array, "n 3 3"],
    reference_covariances: Float[Array, "m 3 3"],
    pairs: Pairs,
    weighting: Weighting,
    widening: Float[Array, ""] | float = 1.0,
    *,
    thickness: float,
) -> RigidTransform:
    """One Gauss-Newton step on given pairs; no pair leaves the pose as it is."""
    moved, target = rigid.apply(pose, source[pairs.source_index]), reference[pairs.reference_index]
    rotation = pose.rotation[None]
    turned = jnp.matmul(
        jnp.matmul(rotation, source_covariances, precision=Precision.HIGHEST),
        rotation.mT,
        precision=Precision.HIGHEST,
    )
    combined = turned[pairs.source_index] + reference_covariances[pairs.reference_index]
    # Padding may hold NaN covariances; its pairs count for nothing.
    identity = jnp.eye(3, dtype=combined.dtype)[None]
    combined = jnp.where(pairs.mask[:, None, None], combined, identity)
    metric = 2 * thickness * eigen3x3.inverse(combined)
    residual = moved - target
    energy = jnp.sum(residual * jnp.matmul(metric, residual[..., None])[..., 0], axis=-1)
    distance = jnp.sum(residual**2, axis=-1)
    weights = pair_weights(distance, energy, pairs.mask, weighting, widening)
    return gauss_newton_step(pose, moved, target, weights[:, None, None] * metric)
