"""What the search knows about one cloud, computed once, and about two clouds before it moves one.

A cloud that is registered with many others is described once: everything slow here depends on one
cloud alone.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg.geometry import arguments
from jaxreg.geometry.neighbors import squared_distances, without_padding
from jaxreg.search.config import SearchConfig
from jaxreg.search.descriptors import (
    INVARIANTS,
    gaussian_normals,
    mean_spacing,
    moments,
    openness,
    standardized,
)
from jaxreg.search.hypotheses import SCREEN_WIDTH
from jaxreg.search.learned import Network, check_network, learned_features
from jaxreg.search.nearest import NearestGrid, nearest_grid
from jaxreg.search.surface import Surface

_DEFAULT = SearchConfig()


class Described(NamedTuple):
    """A cloud in units of the search, with everything that depends on it alone.

    `normals` are of length 1 and arbitrary sign, `openness` says where the surface ends,
    `features` are the raw `descriptors.moments`, `spacing` is the mean distance to the nearest
    point. `neighbors`, if known, are rows of the nearest other points; a judged search computes
    them otherwise. Rows with `mask` False are padding.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    openness: Float[Array, "n"]
    features: Float[Array, "n d"]
    mask: Bool[Array, "n"]
    grid: NearestGrid
    spacing: Float[Array, ""]
    neighbors: Int[Array, "n k"] | None


class Compared(NamedTuple):
    """Two surfaces whose local features can be compared, and the cosines of all their features."""

    source: Surface
    reference: Surface
    similarity: Float[Array, "n m"]


def describe(
    points: Float[Array, "n 3"],
    mask: Bool[Array, "n"] | None = None,
    *,
    unit: Float[Array, ""] | float,
    normals: Float[Array, "n 3"] | None = None,
    neighbors: Int[Array, "n k"] | None = None,
    config: SearchConfig = _DEFAULT,
) -> Described:
    """Describe a cloud, as `search_described` takes it.

    The points must lie around the origin: subtract their centroid first. Both clouds of a pair need
    one `unit` (in the unit of the points); twice the root mean square radius is right for most. It
    may be a traced scalar. Given `normals`, of length 1, replace computed ones.

    A constant of every derivative: which points match is a discrete choice.

    Raises:
      ValueError: a shape or a dtype is wrong; the message names the argument.
    """
    points = arguments.cloud("points", points)
    mask = arguments.mask("mask", mask, points.shape[0])
    unit = arguments.scalar("unit", unit, points.dtype)
    if normals is not None:
        normals = arguments.rows("normals", normals, points.shape, points)
    if neighbors is not None:
        neighbors = arguments.indices("neighbors", neighbors, points.shape[0])
    valid = jnp.ones(points.shape[0], bool) if mask is None else mask
    points = without_padding(points, valid) / jnp.asarray(unit, points.dtype)
    points = jax.lax.stop_gradient(points)
    squared = squared_distances(points, points)
    if normals is None:
        normals = gaussian_normals(points, squared, valid)
    normals = jax.lax.stop_gradient(without_padding(normals, valid))
    return Described(
        points,
        normals,
        openness(points, normals, squared, valid),
        moments(points, normals, squared, valid, radii=config.radii),
        valid,
        nearest_grid(points, valid, margin=SCREEN_WIDTH),
        mean_spacing(squared, valid),
        neighbors,
    )


def compare(source: Described, reference: Described, *, network: Network | None = None) -> Compared:
    """Features of both clouds in common units, and their cosines.

    These features are the moments, or what `network` computes from them; the local ones of the
    surfaces are the moments at the first radius.

    Raises:
      ValueError: the clouds were described with different radii, or `network` was trained for others.
    """
    if source.features.shape[1] != reference.features.shape[1]:
        raise ValueError(
            f"the source has {source.features.shape[1]} features and the reference "
            f"{reference.features.shape[1]}: describe both with the same radii."
        )
    masks = source.mask, reference.mask
    local = standardized(
        source.features[:, :INVARIANTS], reference.features[:, :INVARIANTS], *masks
    )
    here, there = surfaces = [
        Surface(cloud.points, cloud.normals, cloud.openness, nearby, cloud.mask)
        for cloud, nearby in zip((source, reference), local, strict=True)
    ]
    one, other = standardized(source.features, reference.features, *masks)
    if network is not None:
        check_network(network, source.features.shape[1])
        one, other = (
            learned_features(network, moments, s.openness, s.points, s.normals, s.mask)
            for moments, s in zip((one, other), surfaces, strict=True)
        )
    return Compared(here, there, jnp.matmul(one, other.T, precision=Precision.HIGHEST))
