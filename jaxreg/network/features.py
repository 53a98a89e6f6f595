"""Local features of one cloud: a DGCNN on the coordinates of neighbours relative to their centre."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int

from jaxreg._xla import gradient_written_out
from jaxreg.geometry.numerics import leading_max

BATCH_AXIS = "batch"
"""Name of the `vmap` axis over which BatchNorm takes its statistics while training."""
DEVICE_AXIS = "devices"
"""Name of the `shard_map` axis over which it takes them as well, if there is one."""

STATISTICS = "statistics"
"""Name of BatchNorm's statistics among the values that a backward pass may keep (`checkpoint_name`)."""


def relative_neighbors(
    points: Float[Array, "n 3"], neighbors: Int[Array, "n k"]
) -> Float[Array, "n k 3"]:
    """``points[neighbors[i, r]] - points[i]``: unchanged when the cloud is translated."""
    return points[neighbors] - points[:, None]


class BatchNorm(nn.Module):
    """Batch normalisation over all valid points of all clouds of a batch.

    While training, statistics run over the leading axes and over the `vmap` axis `BATCH_AXIS`;
    padding does not count (but must be finite), and every point counts the same, however large its
    cloud. At evaluation running means are used and no batch axis is needed.
    """

    momentum: float

    @nn.compact
    def __call__(
        self, x: Float[Array, "*points c"], mask: Bool[Array, "*#points"], *, train: bool
    ) -> Float[Array, "*points c"]:
        return _Normalize(self.momentum, name="BatchNorm_0")(x, mask, train=train)


class _Normalize(nn.Module):
    """``(x - mean) / sqrt(var + epsilon) * scale + bias``, the variables named as Flax names them.

    Flax's own averages the means of the clouds, which weighs a point by the size of its cloud.
    """

    momentum: float
    epsilon: float = 1e-5

    @nn.compact
    def __call__(self, x, mask, *, train: bool):
        scale, bias = (
            self.param(name, getattr(nn.initializers, kind), x.shape[-1:], jnp.float32)
            for name, kind in (("scale", "ones"), ("bias", "zeros"))
        )
        mean, var = (
            self.variable("batch_stats", name, kind, x.shape[-1:], jnp.float32)
            for name, kind in (("mean", jnp.zeros), ("var", jnp.ones))
        )
        statistics = mean.value, var.value
        if train:
            statistics = _statistics(x, mask, jnp.asarray(mean.value, x.dtype))
            for running, batch in zip((mean, var), statistics, strict=True):
                batch = batch.astype(running.value.dtype)
                running.value = self.momentum * running.value + (1 - self.momentum) * batch
        factor = jax.lax.rsqrt(statistics[1] + self.epsilon) * scale
        axes = tuple(range(x.ndim - 1))
        center, factor, bias = (jnp.expand_dims(v, axes) for v in (statistics[0], factor, bias))
        return (x - center) * factor + bias


def _statistics(
    x: Float[Array, "*points c"], mask: Bool[Array, "*#points"], around: Float[Array, "c"]
) -> tuple[Float[Array, "c"], Float[Array, "c"]]:
    """Mean and variance of every channel over the valid points of the whole batch.

    `around` is any guess of the mean, the same on all devices.
    """
    # A sum over points is a product with the mask: XLA:CPU reduces long columns slowly.
    weight = jnp.broadcast_to(mask, x.shape[:-1]).reshape(-1).astype(x.dtype)
    x = x.reshape(-1, x.shape[-1])

    def over_batch(values):
        # Before devices: over both axes at once its derivative would send every cloud's part.
        return jax.lax.psum(jnp.matmul(weight, values, precision=Precision.HIGHEST), BATCH_AXIS)

    count = jax.lax.psum(jnp.sum(weight), BATCH_AXIS)
    mean = over_batch(x) / jnp.maximum(count, 1)
    # Two passes: E[x^2] - E[x]^2 cancels when the inlier network sees differences near zero.
    squares = over_batch((x - mean[None, :]) ** 2)
    return _over_devices(count, mean, squares, around)


def _over_devices(
    count: Float[Array, ""],
    mean: Float[Array, "c"],
    squares: Float[Array, "c"],
    around: Float[Array, "c"],
) -> tuple[Float[Array, "c"], Float[Array, "c"]]:
    """Mean and variance over all devices from counts, means and squared deviations of each.

    One sum, since what costs is how often something is sent: squares about `around`, which all know
    beforehand, in place of those about the mean of all, which would take a sum of its own. Only the
    part that the means of the devices differ by can cancel.
    """
    offset = mean - around
    told = jnp.concatenate([count[None], count * offset, squares, count * offset**2])
    try:
        told = checkpoint_name(jax.lax.psum(told, DEVICE_AXIS), STATISTICS)
    except NameError:  # there is one device
        return checkpoint_name((mean, squares / jnp.maximum(count, 1)), STATISTICS)
    total = jnp.maximum(told[0], 1)
    offset, within, between = jnp.split(told[1:] / total, 3)
    return around + offset, within + jnp.maximum(between - offset**2, 0)


class DGCNN(nn.Module):
    """Features of the points from their neighbourhoods, ``F = f(max_k, ...)``.

    Shared layers with BatchNorm and ReLU lift every edge; after each, the maximum over the K edges is
    kept; the concatenation goes through one more layer. This is the simplified DGCNN (no graph in
    feature space) of RIENet.
    """

    channels: tuple[int, ...]
    width: int
    bn_momentum: float

    @nn.compact
    def __call__(
        self, edges: Float[Array, "n k d"], mask: Bool[Array, "n"], *, train: bool
    ) -> Float[Array, "n c"]:
        edges = jnp.where(mask[:, None, None], edges, 0)
        # K first: the maximum over it is then an elementwise maximum of contiguous blocks.
        x, pooled = jnp.swapaxes(edges, 0, 1), []
        for channels in self.channels:
            x = gradient_written_out(nn.Dense(channels, use_bias=False)(x))
            x = jax.nn.relu(BatchNorm(self.bn_momentum)(x, mask[None, :], train=train))
            pooled.append(leading_max(x))
        x = nn.Dense(self.width, use_bias=False)(jnp.concatenate(pooled, axis=-1))
        x = gradient_written_out(x)
        return jax.nn.relu(BatchNorm(self.bn_momentum)(x, mask, train=train))
