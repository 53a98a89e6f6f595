"""A pose from each of the clearest candidates, a quick score of each, and the distinct best."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry.neighbors import squared_distances
from jaxreg.geometry.procrustes import upright_procrustes, weighted_procrustes
from jaxreg.search.compatibility import second_order, spectral_weights
from jaxreg.search.nearest import NearestGrid, lookup
from jaxreg.search.surface import Surface
from jaxreg.types import RigidTransform

CONSENSUS_SIZE = 12
"""How many other candidates a pose is computed from."""
SCREEN_WIDTH = 0.06
"""Width of the Gaussian overlap that poses are screened by, in units of the search."""


class Separation(NamedTuple):
    """When two poses count as different.

    They turn by more than `angle` (radians) from each other, or take the origin to places more than
    `distance` apart (units of the search).
    """

    angle: float
    distance: float


def pose_hypotheses(
    source: Float[Array, "c 3"],
    reference: Float[Array, "c 3"],
    first: Float[Array, "c c"],
    *,
    seeds: int,
    consensus_size: int = CONSENSUS_SIZE,
    up: Float[Array, "3"] | None = None,
) -> RigidTransform:
    """One pose (leading axis s) from each of the first `seeds` candidates.

    It is that of the candidate and of the `consensus_size` others that agree with it best, ranked by
    second-order compatibility; the weights of the Procrustes solution are the leading eigenvector of
    the compatibility among them. The seeds are the clearest candidates, not those that agree with
    most others: when nine in ten are wrong, that loses the right ones. With `up` (a unit vector) the
    poses turn about it alone.
    """
    among = second_order(first, seeds)
    _, members = jax.lax.top_k(among, consensus_size)
    # Keeps XLA from making the selection a full sort. Around the pair that `top_k` returns it would
    # abort the process under `jax.pmap` and `jax.shard_map` (jaxlib 0.10.2).
    members = jax.lax.optimization_barrier(members)
    own = jnp.arange(seeds, dtype=members.dtype)[:, None]
    members = jnp.concatenate([own, members], axis=1)
    local = first[members[:, :, None], members[:, None, :]]
    weights = spectral_weights(local)
    pairs = source[members], reference[members], weights
    if up is not None:
        return jax.vmap(upright_procrustes, in_axes=(0, 0, 0, None))(*pairs, up)
    return jax.vmap(weighted_procrustes)(*pairs)


def screen(
    poses: RigidTransform,
    source: Surface,
    reference: Surface,
    grid: NearestGrid,
    *,
    width: float = SCREEN_WIDTH,
) -> Float[Array, "s"]:
    """Share of the source that a pose puts on the reference, in [0, 1]: cheap, in one direction.

    Mean of ``exp(-d^2 / (2 width^2)) (n . m)^2`` over the source points; `grid` is of the reference.
    """
    moved = _turned(poses.rotation, source.points) + poses.translation[:, None]
    normals = _turned(poses.rotation, source.normals)
    nearest = lookup(grid, moved)
    squared = jnp.sum((moved - reference.points[nearest]) ** 2, axis=-1)
    facing = jnp.sum(normals * reference.normals[nearest], axis=-1) ** 2
    overlap = jnp.where(source.mask[None, :], jnp.exp(-squared / (2 * width**2)) * facing, 0)
    count = jnp.maximum(jnp.sum(source.mask), 1).astype(overlap.dtype)
    return jnp.sum(overlap, axis=1) / count


def pick_distinct(
    poses: RigidTransform,
    score: Float[Array, "s"],
    allowed: Bool[Array, "s"] | None = None,
    *,
    count: int,
    apart: Separation,
) -> Int[Array, "count"]:
    """The best pose, the best of those that differ from it, and so on.

    The origin should be the centroid of the source. If no pose is left that differs from all those
    chosen, a second round begins; poses that are not `allowed` take part from the second round on.
    """
    flat = poses.rotation.reshape(-1, 9)
    cosine = (jnp.matmul(flat, flat.T, precision=Precision.HIGHEST) - 1) / 2
    gap = squared_distances(poses.translation, poses.translation)
    same = (cosine > math.cos(apart.angle)) & (gap < apart.distance**2)
    # A pose must drop out of its round, however far its rotation is from an orthogonal one.
    same = same | jnp.eye(len(score), dtype=bool)
    rounds = jnp.zeros(len(score), jnp.int32)
    if allowed is not None:
        rounds = jnp.where(allowed, rounds, 1)

    def step(rounds: Array, _: None) -> tuple[Array, Array]:
        best = jnp.argmax(jnp.where(rounds == jnp.min(rounds), score, -jnp.inf))
        return rounds + same[best].astype(rounds.dtype), best

    return jax.lax.scan(step, rounds, None, length=count)[1].astype(jnp.int32)


def best_of(poses: RigidTransform, index: Int[Array, "..."]) -> RigidTransform:
    """The poses at `index` of the leading axis."""
    return RigidTransform(poses.rotation[index], poses.translation[index])


def _turned(rotations: Array, vectors: Array) -> Array:
    return jnp.einsum("sij,nj->sni", rotations, vectors, precision=Precision.HIGHEST)
