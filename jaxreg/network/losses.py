"""The four unsupervised losses of one registration step (Eq. 14-17) and their sum (Eq. 18).

None of them sees the true transform; `pose_error` does, for generated pairs whose pose is known,
and is not part of the method. Sums run over points as in the paper; the caller takes means over
pairs, so the mix of the terms does not depend on the batch.
"""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg.config import LossConfig, ModelConfig
from jaxreg.geometry import rigid
from jaxreg.geometry.neighbors import nearest_in, without_padding
from jaxreg.geometry.numerics import safe_norm
from jaxreg.network.invariants import included_angles, rounding_error
from jaxreg.network.model import Graph, Step
from jaxreg.types import PointCloud, RigidTransform


class LossTerms(NamedTuple):
    """L_gc, L_in, L_gs and L_sc, unweighted."""

    global_consistency: Float[Array, ""]
    neighborhood_consistency: Float[Array, ""]
    geometric_consistency: Float[Array, ""]
    spatial_consistency: Float[Array, ""]


def huber(x: Float[Array, "..."], beta: float) -> Float[Array, "..."]:
    """``x^2 / 2`` below beta, ``beta x - beta^2 / 2`` above, for x >= 0 (here a squared distance)."""
    return jnp.where(x < beta, x * x / 2, beta * x - beta * beta / 2)


def global_consistency(
    moved: PointCloud, reference: PointCloud, *, beta: float
) -> Float[Array, ""]:
    """L_gc (Eq. 14): Huber of the squared distance to the nearest point, in both directions, summed."""
    # A NaN in a padded row would reach the derivative, through a product with a zero cotangent.
    moved = PointCloud(without_padding(*moved), moved.mask)
    reference = PointCloud(without_padding(*reference), reference.mask)

    def one_way(cloud: PointCloud, other: PointCloud):
        nearest = other.points[nearest_in(cloud.points, other.points, other.mask)]
        square = jnp.sum((cloud.points - nearest) ** 2, axis=1)
        return jnp.sum(jnp.where(cloud.mask, huber(square, beta), 0))

    return one_way(moved, reference) + one_way(reference, moved)


def neighborhood_consistency(
    source: Float[Array, "n 3"],
    copy: Float[Array, "n 3"],
    transform: RigidTransform,
    neighbors: Int[Array, "n k"],
    inliers: Int[Array, "n_c"],
    valid: Bool[Array, "n_c"],
    *,
    squared: bool = False,
) -> Float[Array, ""]:
    """L_in (Eq. 15): how far the neighbourhoods of the inliers are from their copies.

    ``sum_i sum_{j in N(i)} |R p_j + t - q~_j|``; with `squared` RIENet's
    ``sum_i |R p_i + t - q~_i|^2 + sum_{i,j} |R (p_i - p_j) - (q~_i - q~_j)|^2 / K``.
    """
    error = rigid.apply(transform, source) - copy
    of_neighbors = error[neighbors[inliers]]
    if not squared:
        return jnp.sum(jnp.where(valid[:, None], safe_norm(of_neighbors), 0))
    own = error[inliers]
    edge_term = jnp.sum((own[:, None] - of_neighbors) ** 2, axis=(1, 2)) / neighbors.shape[1]
    return jnp.sum(jnp.where(valid, jnp.sum(own**2, axis=1) + edge_term, 0))


def geometric_consistency(
    source: Float[Array, "n 3"],
    copy: Float[Array, "n 3"],
    neighbors: Int[Array, "n k"],
    inliers: Int[Array, "n_c"],
    valid: Bool[Array, "n_c"],
    *,
    config: ModelConfig,
) -> Float[Array, ""]:
    """L_gs (Eq. 16): difference of edges and of angles between a neighbourhood and its copy."""
    kind = "length" if config.edge == "length" else "vector"
    near = neighbors[inliers]
    total = jnp.zeros((), source.dtype)
    structures = []
    for points in (source, copy):
        vectors = points[inliers][:, None] - points[near]
        edge = safe_norm(vectors)[..., None] if kind == "length" else vectors
        negligible = rounding_error(points)
        angles = included_angles(vectors, pairs=config.angles, negligible=negligible)
        structures.append((edge, angles))
    for of_source, of_copy in zip(*structures, strict=True):
        total += jnp.sum(jnp.where(valid[:, None], safe_norm(of_source - of_copy), 0))
    return total


def spatial_consistency(
    peak: Float[Array, "n"], inliers: Int[Array, "n_c"], valid: Bool[Array, "n_c"]
) -> Float[Array, ""]:
    """L_sc (Eq. 17): mean of ``-log max_j G[i, j]`` over the inliers."""
    surprise = -jnp.log(jnp.maximum(peak[inliers], jnp.finfo(peak.dtype).tiny))
    count = jnp.sum(valid, dtype=peak.dtype)
    return jnp.sum(jnp.where(valid, surprise, 0)) / jnp.maximum(count, 1)


def pose_error(moved: PointCloud, truth: Float[Array, "n 3"]) -> Float[Array, ""]:
    """How far the source is from where the true pose takes it (`truth`), summed over its points."""
    # Padding is taken out before the norm: a NaN there would reach the derivative.
    apart = without_padding(moved.points - truth, moved.mask)
    return jnp.sum(safe_norm(apart))


def step_losses(
    step: Step,
    graph: Graph,
    source_mask: Bool[Array, "n"],
    reference: PointCloud,
    *,
    config: LossConfig,
    model: ModelConfig,
) -> LossTerms:
    """The four terms of one step; a term whose weight is 0 is not computed."""
    valid, zero = source_mask[step.inliers], jnp.zeros((), step.source.dtype)
    structure = (graph.neighbors, step.inliers, valid)
    copy = step.matches.copy
    peak = step.matches.dual_peak if config.l_sc == "G" else step.matches.final_peak
    moved = PointCloud(step.moved, source_mask)
    return LossTerms(
        global_consistency(moved, reference, beta=config.beta)
        if config.global_consistency
        else zero,
        neighborhood_consistency(
            step.source, copy, step.transform, *structure, squared=config.l_in == "squared"
        )
        if config.gamma
        else zero,
        geometric_consistency(step.source, copy, *structure, config=model) if config.rho else zero,
        spatial_consistency(peak, step.inliers, valid) if config.lambda_ else zero,
    )


def total_loss(terms: LossTerms, config: LossConfig) -> Float[Array, ""]:
    """``L = sum over steps of L_gc + gamma L_in + rho L_gs + lambda L_sc`` (Eq. 18)."""
    weights = (config.global_consistency, config.gamma, config.rho, config.lambda_)
    weighted = (w * jnp.sum(term) for w, term in zip(weights, terms, strict=True))
    return functools.reduce(operator.add, weighted)
