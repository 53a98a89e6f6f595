"""Local features of one cloud: a DGCNN on the coordinates of neighbours relative to their centre."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

BATCH_AXIS = "batch"
"""Name of the `vmap` axis over which BatchNorm takes its statistics while training."""


def relative_neighbors(
    points: Float[Array, "n 3"], neighbors: Int[Array, "n k"]
) -> Float[Array, "n k 3"]:
    """``points[neighbors[i, r]] - points[i]``: unchanged when the cloud is translated."""
    return points[neighbors] - points[:, None]


class BatchNorm(nn.Module):
    """Batch normalisation over all valid points of all clouds of a batch.

    While training, statistics run over the leading axes and over the `vmap` axis `BATCH_AXIS`;
    padding does not count. At evaluation running means are used and no batch axis is needed.
    """

    momentum: float

    @nn.compact
    def __call__(
        self, x: Float[Array, "*points c"], mask: Bool[Array, "*#points"], *, train: bool
    ) -> Float[Array, "*points c"]:
        normalize = nn.BatchNorm(
            use_running_average=not train,
            momentum=self.momentum,
            # E[x^2] - E[x]^2 cancels where the inlier network sees differences near zero.
            use_fast_variance=False,
            axis_name=BATCH_AXIS if train else None,
        )
        return normalize(x, mask=mask[..., None] if train else None)


class DGCNN(nn.Module):
    """Features of the points from their neighbourhoods, ``F = f(max_k, ...)``.

    Shared layers with BatchNorm and ReLU lift every edge; after each, the maximum over the K edges is
    kept; the concatenation goes through one more layer. This is the simplified DGCNN (no graph in
    feature space) of the predecessor, RIENet.
    """

    channels: tuple[int, ...]
    width: int
    bn_momentum: float

    @nn.compact
    def __call__(
        self, edges: Float[Array, "n k d"], mask: Bool[Array, "n"], *, train: bool
    ) -> Float[Array, "n c"]:
        # K in front: the maximum over it is then an elementwise maximum of contiguous blocks.
        x, pooled = jnp.swapaxes(edges, 0, 1), []
        for channels in self.channels:
            x = nn.Dense(channels, use_bias=False)(x)
            x = jax.nn.relu(BatchNorm(self.bn_momentum)(x, mask[None, :], train=train))
            pooled.append(jnp.max(x, axis=0))
        x = nn.Dense(self.width, use_bias=False)(jnp.concatenate(pooled, axis=-1))
        return jax.nn.relu(BatchNorm(self.bn_momentum)(x, mask, train=train))
