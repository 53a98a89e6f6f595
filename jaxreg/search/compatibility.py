"""Poses from correspondences that are mostly wrong, by second-order spatial compatibility.

Two right correspondences keep the distance between their points. Two wrong ones sometimes do, but
share few third correspondences that agree with both: SC2-PCR (Chen, Sun, Yang and Tao, CVPR 2022).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg import rigid
from jaxreg.neighbors import squared_distances
from jaxreg.numerics import safe_sqrt
from jaxreg.procrustes import weighted_procrustes
from jaxreg.types import RigidTransform

_POWER_STEPS = 15
_REFITS = 2


def hypotheses(
    source: Float[Array, "c 3"],
    reference: Float[Array, "c 3"],
    mask: Bool[Array, "c"],
    *,
    tolerance: Float[Array, ""] | float,
    seeds: int,
    partners: int,
) -> tuple[RigidTransform, Float[Array, "seeds"]]:
    """A pose from every seed (leading axis `seeds`), and how many correspondences it satisfies.

    Row `i` of `source` may belong to row `i` of `reference`. `tolerance` is the error of a right
    correspondence, in the unit of the clouds. Seeds are chosen by their compatibility, apart from
    each other; each takes the `partners` correspondences that share most third ones with it.
    """
    first = _compatibility(source, reference, mask, tolerance)
    agree = (first > 0).astype(first.dtype)
    second = agree * jnp.matmul(agree, agree)
    strength = jnp.where(mask, _principal(first), 0) + 1e-3 * jnp.mean(second, axis=1)
    chosen = _apart(strength, source, reference, 3 * tolerance, seeds)
    _, members = jax.lax.top_k(second[chosen], partners)
    members = jnp.concatenate([chosen[:, None], members], axis=1)
    local = jax.vmap(lambda index: first[index][:, index])(members)
    weights = jnp.where(mask[members], jax.vmap(_principal)(local), 0)
    poses = jax.vmap(weighted_procrustes)(source[members], reference[members], weights)
    for _ in range(_REFITS):
        poses, support = _refitted(poses, source, reference, mask, tolerance)
    return poses, support


def _compatibility(source: Array, reference: Array, mask: Array, tolerance: Array | float) -> Array:
    """``max(0, 1 - (e / tolerance)^2)`` of the change e of every distance; 0 for near pairs.

    Points closer than the tolerance keep their distance under any motion, which proves nothing.
    """
    near = squared_distances(source, source)
    change = safe_sqrt(near) - safe_sqrt(squared_distances(reference, reference))
    usable = mask[:, None] & mask[None, :] & (near > (2 * tolerance) ** 2)
    return jnp.where(usable, jnp.maximum(0, 1 - (change / tolerance) ** 2), 0)


def _principal(matrix: Float[Array, "c c"]) -> Float[Array, "c"]:
    """The leading eigenvector of a matrix without negative entries, largest entry 1."""

    def step(vector, _):
        vector = jnp.matmul(matrix, vector)
        return vector / jnp.maximum(jnp.max(vector), jnp.finfo(vector.dtype).tiny), None

    return jax.lax.scan(step, jnp.ones_like(matrix[0]), length=_POWER_STEPS)[0]


def _apart(
    strength: Array, source: Array, reference: Array, distance: Array | float, count: int
) -> Int[Array, "count"]:
    """The strongest correspondence again and again, without those near one taken before."""

    def take(strength, _):
        best = jnp.argmax(strength).astype(jnp.int32)
        near = jnp.sum((source - source[best]) ** 2, axis=1) < distance**2
        near &= jnp.sum((reference - reference[best]) ** 2, axis=1) < distance**2
        return jnp.where(near, -1, strength), best

    return jax.lax.scan(take, strength, length=count)[1]


def _refitted(
    poses: RigidTransform, source: Array, reference: Array, mask: Array, tolerance: Array | float
) -> tuple[RigidTransform, Float[Array, "seeds"]]:
    """Poses solved again from all correspondences that they satisfy, and the sums of weights."""

    def one(pose):
        squared = jnp.sum((rigid.apply(pose, source) - reference) ** 2, axis=1) / tolerance**2
        weights = jnp.where(mask & (squared < 4), 1 / (1 + squared) ** 2, 0)
        return weighted_procrustes(source, reference, weights), jnp.sum(weights)

    return jax.vmap(one)(poses)
