"""Where a crop looks from, and the score of every point: the points with the largest scores remain."""

import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float, PRNGKeyArray

_FAR = 500.0  # Each coordinate of the viewpoint, up to U[0, 1] and one sign for all three.


def viewpoint(key: PRNGKeyArray) -> Float[Array, "3"]:
    """``+-(500, 500, 500) + U[0, 1]^3`` (the crop of RIENet's code)."""
    *offset, coin = jax.random.uniform(key, (4,), jnp.float32)
    return jnp.where(coin < 0.5, -_FAR, _FAR) + jnp.stack(offset)


def nearness(points: Float[Array, "n 3"], viewpoint: Float[Array, "3"]) -> Float[Array, "n"]:
    """Ranks points by distance to the viewpoint, the nearest highest: ``(2 p.v - |p|^2) / 2|v|``.

    This is ``|v|^2 - |p - v|^2`` up to a factor and without the constant, beside which float32
    would round `p` away.
    """
    viewpoint = viewpoint.astype(points.dtype)
    far = jnp.linalg.norm(viewpoint)
    projected = jnp.matmul(points, viewpoint / far, precision=Precision.HIGHEST)
    return projected - jnp.sum(points**2, axis=1) / (2 * far)


def direction(key: PRNGKeyArray) -> Float[Array, "3"]:
    """A direction uniform on the sphere, not of unit length."""
    return jax.random.normal(key, (3,), jnp.float32)


def along(points: Float[Array, "n 3"], direction: Float[Array, "3"]) -> Float[Array, "n"]:
    """How far each point lies along the direction: ``p.d``."""
    return jnp.matmul(points, direction.astype(points.dtype), precision=Precision.HIGHEST)
