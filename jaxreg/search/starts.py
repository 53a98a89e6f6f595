"""Where a pose search starts: a fixed covering of the rotations, and the best of many short ICPs."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Bool, Float

from jaxreg import rigid
from jaxreg.neighbors import squared_distances
from jaxreg.refine.icp import icp
from jaxreg.types import RigidTransform


def rotation_covering(count: int, *, largest_deg: float = 180.0) -> Float[np.ndarray, "r 3 3"]:
    """Evenly spread rotations, the identity first; those beyond `largest_deg` are left out.

    `count` is that of the whole group: 576 leave no rotation farther than about 20 degrees from one
    of them. Super-Fibonacci spirals (Alexa, CVPR 2022).
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    a, b = 2 * np.pi * s / math.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    x, y, z, w = inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    rotations = np.moveaxis(np.array(rows), -1, 0)
    near = np.abs(w) >= math.cos(math.radians(largest_deg) / 2)
    return np.concatenate([np.eye(3)[None], rotations[near]])


def truncated_residual(
    transform: RigidTransform,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    source_mask: Bool[Array, "n"],
    reference_mask: Bool[Array, "m"],
    limit: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Mean over both clouds of ``min(d^2, limit^2) / limit^2`` with d to the nearest other point."""
    both = source_mask[:, None] & reference_mask[None, :]
    squared = squared_distances(rigid.apply(transform, source), reference)
    squared = jnp.minimum(jnp.where(both, squared, jnp.inf), limit**2) / limit**2
    total = jnp.sum(jnp.min(squared, axis=1), where=source_mask)
    total += jnp.sum(jnp.min(squared, axis=0), where=reference_mask)
    count = jnp.maximum(jnp.sum(source_mask) + jnp.sum(reference_mask), 1)
    return total / count.astype(total.dtype)


def multi_start(
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    rotations: Float[Array, "r 3 3"],
    source_mask: Bool[Array, "n"],
    reference_mask: Bool[Array, "m"],
    *,
    limit: float,
    kept: int,
    iterations: int,
    trim: float,
) -> tuple[RigidTransform, Float[Array, "kept"]]:
    """The `kept` best starts after a short trimmed ICP each, best first, and their residuals.

    Every rotation starts with the centroids on each other. `limit` (see `truncated_residual`) has
    the unit of the clouds.
    """

    def score(pose):
        return truncated_residual(pose, source, reference, source_mask, reference_mask, limit)

    def polish(pose):
        return icp(
            source,
            reference,
            initial=pose,
            source_mask=source_mask,
            reference_mask=reference_mask,
            iterations=iterations,
            trim=trim,
        )

    centroids = [
        jnp.sum(jnp.where(mask[:, None], points, 0), axis=0)
        / jnp.maximum(jnp.sum(mask, dtype=points.dtype), 1)
        for points, mask in ((source, source_mask), (reference, reference_mask))
    ]
    turned = jnp.matmul(rotations, centroids[0], precision=Precision.HIGHEST)
    starts = RigidTransform(rotations, centroids[1][None] - turned)
    # Sequential over small groups: all at once would hold every distance matrix in memory.
    first = jax.lax.map(score, starts, batch_size=16)
    _, chosen = jax.lax.top_k(-first, kept)
    poses = jax.lax.map(polish, jax.tree.map(lambda x: x[chosen], starts), batch_size=8)
    last = jax.lax.map(score, poses, batch_size=8)
    order = jnp.argsort(last)
    return jax.tree.map(lambda x: x[order], poses), last[order]
