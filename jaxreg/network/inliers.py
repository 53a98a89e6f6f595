"""Geometric neighbourhood inlier estimation: how well a neighbourhood survives matching.

A correspondence is trusted (confidence near 1) when the neighbourhood of the source point and the
same neighbourhood in the reference copy have the same structure (Eq. 9-11).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxreg.network.features import BatchNorm


def _confidence(consistency: Float[Array, "n"]) -> Float[Array, "n"]:
    """``1 - tanh|x|``, written without the difference: accurate even when it is small."""
    return 2 * jax.nn.sigmoid(-2 * jnp.abs(consistency))


def _stacked(source, copy, mask) -> Float[Array, "2 n k d"]:
    """Both structures with their padding at zero: what passes through a network must be finite."""
    return jnp.where(mask[None, :, None, None], jnp.stack([source, copy]), 0)


class InlierNetwork(nn.Module):
    """The paper's inlier module: f_theta on each neighbour, attention f_mu over the neighbours.

    d = f_theta(source) - f_theta(copy) (Eq. 9); delta = softmax over the neighbours of f_mu(d), one
    weight per channel (Eq. 10); w = 1 - tanh|l(sum_k delta * d)| (Eq. 11). `l` has no constant, so
    identical structures give w = 1.
    """

    width: int
    bn_momentum: float

    @nn.compact
    def __call__(
        self,
        source: Float[Array, "n k d"],
        copy: Float[Array, "n k d"],
        mask: Bool[Array, "n"],
        *,
        train: bool,
    ) -> Float[Array, "n"]:
        def layer(x, width):
            x = BatchNorm(self.bn_momentum)(nn.Dense(width)(x), valid, train=train)
            return jax.nn.leaky_relu(x, 0.2)

        # Both structures pass together: one set of statistics, so that equal ones stay equal.
        x, valid = _stacked(source, copy, mask), mask[None, :, None]
        fused = layer(layer(x, self.width), 2 * self.width)
        difference, valid = fused[0] - fused[1], mask[:, None]
        attention = nn.Dense(2 * self.width)(layer(difference, 2 * self.width))
        pooled = jnp.sum(jax.nn.softmax(attention, axis=1) * difference, axis=1)
        return _confidence(nn.Dense(1, use_bias=False)(pooled)[:, 0])


class PredecessorInlierNetwork(nn.Module):
    """RIENet's inlier module: convolutions of width 3 along the neighbours, nearest first.

    Two such layers lift the edges of each cloud; the difference goes through two layers, weighted
    per channel by a softmax over the neighbours of two others, then two layers to a scalar.
    """

    width: int
    bn_momentum: float

    @nn.compact
    def __call__(
        self,
        source: Float[Array, "n k d"],
        copy: Float[Array, "n k d"],
        mask: Bool[Array, "n"],
        *,
        train: bool,
    ) -> Float[Array, "n"]:
        def activate(x):
            x = BatchNorm(self.bn_momentum)(x, valid, train=train)
            return jax.nn.leaky_relu(x, 0.2)

        x, valid = _stacked(source, copy, mask), mask[None, :, None]
        for width in (self.width, 2 * self.width):
            x = activate(nn.Conv(width, kernel_size=(3,), padding=1)(x))
        difference, valid = x[1] - x[0], mask[:, None]
        value, attention = difference, difference
        for _ in range(2):
            value = activate(nn.Dense(16)(value))
        for _ in range(2):
            attention = activate(nn.Dense(16)(attention))
        pooled, valid = jnp.sum(jax.nn.softmax(attention, axis=1) * value, axis=1), mask
        return _confidence(nn.Dense(1)(activate(nn.Dense(8)(pooled)))[:, 0])


def select_inliers(
    confidence: Float[Array, "n"], n_inliers: int, mask: Bool[Array, "n"] | None = None
) -> Int[Array, "n_c"]:
    """Indices of the N_c most confident points, most confident first (Eq. 12).

    Padded points come last. If fewer than N_c points are valid the rest are padded ones, and the
    caller must set their weight to zero.

    Raises:
      ValueError: N_c exceeds the number of points.
    """
    n = confidence.shape[0]
    if not 1 <= n_inliers <= n:
        raise ValueError(
            f"N_c = {n_inliers} inliers of a cloud of n = {n} points: "
            "choose 1 <= model.n_inliers <= n."
        )
    if mask is not None:
        confidence = jnp.where(mask, confidence, -1)
    return jax.lax.top_k(jax.lax.stop_gradient(confidence), n_inliers)[1]
