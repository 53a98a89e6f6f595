"""Geometry of a neighbourhood: edges to the neighbours and the angles between them (Eq. 7-8)."""

from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxreg.geometry.numerics import included_angle, safe_norm


def edges(
    points: Float[Array, "n 3"],
    neighbors: Int[Array, "n k"],
    *,
    kind: Literal["vector", "length", "coordinates"] = "vector",
) -> Float[Array, "n k d"]:
    """``e_{i,k}``: the edge ``p_i - p_k``, its length (d = 1), or ``p_k`` itself (an ablation).

    Only the length is invariant to rotation; the vector is invariant to translation.
    """
    if kind == "coordinates":
        return points[neighbors]
    vectors = points[:, None] - points[neighbors]
    return safe_norm(vectors)[..., None] if kind == "length" else vectors


def included_angles(
    vectors: Float[Array, "n k 3"],
    *,
    pairs: Literal["all", "next", "none"] = "all",
    negligible: Float[Array, ""] | float = 0.0,
) -> Float[Array, "n k a"]:
    """Angles in radians between the K edges of each point (Eq. 8), invariant to rigid motion.

    `all`: ``a[i, r, s]`` is the angle of edges r and s (a = K; 0 on the diagonal). `next`:
    ``a[i, r, 0]`` is the angle of edges r and r + 1 modulo K (a = 1). `none`: a = 0. An edge with no
    coordinate above `negligible` (unit of the points) has no direction; its angles are 0.
    """
    short = jnp.max(jnp.abs(vectors), axis=-1, keepdims=True) <= negligible
    vectors = jnp.where(short, 0, vectors)
    if pairs == "none":
        return jnp.zeros((*vectors.shape[:2], 0), vectors.dtype)
    if pairs == "next":
        return included_angle(vectors, jnp.roll(vectors, -1, axis=1))[..., None]
    k = vectors.shape[1]
    rows, columns = jnp.triu_indices(k, 1)
    # Half of the angles, because a[r, s] = a[s, r] and a[r, r] = 0.
    half = included_angle(vectors[:, rows], vectors[:, columns])
    zero = jnp.zeros((*vectors.shape[:1], k, k), vectors.dtype)
    upper = zero.at[:, rows, columns].set(half)
    return upper + jnp.swapaxes(upper, 1, 2)


def rounding_error(points: Float[Array, "n 3"]) -> Float[Array, ""]:
    """Differences of the coordinates of `points` up to this are rounding, not an edge.

    If many copies fall on one place, their edges are noise of 1e-17: an angle between two of them
    would be arbitrary and its derivative 1e17.
    """
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(points), initial=0))
    return 16 * jnp.finfo(points.dtype).eps * largest


def geometric_structure(
    points: Float[Array, "n 3"],
    neighbors: Int[Array, "n k"],
    *,
    edge: Literal["vector", "length", "coordinates"] = "vector",
    angles: Literal["all", "next", "none"] = "all",
) -> Float[Array, "n k d"]:
    """``concat(e_{i,k}, a_{r,s})`` of every neighbour, the input of f_theta (Eq. 9)."""
    vectors = edges(points, neighbors)
    of_edges = edges(points, neighbors, kind=edge)
    of_angles = included_angles(vectors, pairs=angles, negligible=rounding_error(points))
    return jnp.concatenate([of_edges, of_angles], axis=-1)
