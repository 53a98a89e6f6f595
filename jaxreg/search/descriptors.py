"""Fast point feature histograms (Rusu, Blodow and Beetz, 2009): what a surface looks like locally."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg.numerics import safe_norm

BINS = 11
"""Bins of each of the three angles."""


def fpfh(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    neighbors: Int[Array, "n k"],
    radius: Float[Array, ""] | float,
    mask: Bool[Array, "n"],
) -> Float[Array, "n f"]:
    """Three histograms a point, each summing to 1; zero for padding and for points without neighbours.

    ``F(p) = S(p) + sum_k S(p_k) / d_k / sum_k 1 / d_k`` over the neighbours within `radius`, where S
    is the histogram of the three angles between the normals of a pair and the line that joins them.
    Counts are shared linearly between the two nearest bins, so that noise moves them little.
    """
    edges = points[neighbors] - points[:, None, :]
    distance = safe_norm(edges)
    own = jnp.arange(points.shape[0], dtype=neighbors.dtype)[:, None]
    near = (distance < radius) & (distance > 0) & (neighbors != own)
    near = (near & mask[neighbors] & mask[:, None]).astype(points.dtype)
    simple = _shares(
        jnp.sum(near[..., None, None] * _angles(edges, distance, normals, neighbors), axis=1)
    )
    # Without the floor a coincident neighbour would be the only one that counts.
    weight = near / jnp.maximum(distance, 0.05 * radius)
    around = jnp.sum(weight[..., None, None] * simple[neighbors], axis=1)
    total = jnp.maximum(jnp.sum(weight, axis=1), jnp.finfo(points.dtype).tiny)
    return _shares(simple + around / total[:, None, None]).reshape(points.shape[0], -1)


def _shares(histograms: Float[Array, "n 3 b"]) -> Float[Array, "n 3 b"]:
    total = jnp.sum(histograms, axis=-1, keepdims=True)
    return histograms / jnp.where(total > 0, total, 1)


def _angles(edges: Array, distance: Array, normals: Array, neighbors: Array) -> Array:
    """Soft histograms (n, k, 3, bins) of the angles of Darboux frames between paired points."""
    line = edges / jnp.where(distance > 0, distance, 1)[..., None]
    one, other = normals[:, None, :], normals[neighbors]
    along_one, along_other = jnp.sum(one * line, axis=-1), jnp.sum(other * line, axis=-1)
    # The frame stands where the normal makes the smaller angle with the line.
    swap = jnp.abs(along_one) < jnp.abs(along_other)
    u = jnp.where(swap[..., None], other, one)
    target = jnp.where(swap[..., None], one, other)
    line = jnp.where(swap[..., None], -line, line)
    v = jnp.cross(line, u)
    length = safe_norm(v)
    v = v / jnp.where(length > 0, length, 1)[..., None]
    w = jnp.cross(u, v)
    across, up = jnp.sum(w * target, axis=-1), jnp.sum(u * target, axis=-1)
    theta = jnp.arctan2(across, jnp.where((across == 0) & (up == 0), 1, up)) / jnp.pi
    values = jnp.stack(
        [theta, jnp.sum(v * target, axis=-1), jnp.where(swap, -along_other, along_one)], axis=-1
    )
    position = jnp.clip((values + 1) / 2 * BINS - 0.5, 0, BINS - 1)
    bins = jnp.arange(BINS, dtype=values.dtype)
    return jnp.maximum(0, 1 - jnp.abs(position[..., None] - bins))


def outward(
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], neighbors: Int[Array, "n k"]
) -> Float[Array, "n 3"]:
    """Normals turned away from the centroid of the neighbours: a sign that moves with the surface.

    The side that a scanner looked from is unknown here, and the histograms need some rule that is
    the same in both clouds.
    """
    towards = jnp.mean(points[neighbors], axis=1) - points
    inward = jnp.sum(towards * normals, axis=-1, keepdims=True) > 0
    return jnp.where(inward, -normals, normals)
