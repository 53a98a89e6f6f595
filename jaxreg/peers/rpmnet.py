"""RPM-Net (Yew and Lee, CVPR 2020): learned features, Sinkhorn with slack, weighted Procrustes.

Every point of a cloud has at most one partner in the other, and may have none: rows and columns of
the match matrix sum to at most 1, and the rest goes to a slack row and column. So clouds may share
no point, and overlap in part.

It needs normals. They are those of `jaxreg.normals`, which have no sign; here they are turned away
from the centroid of the cloud, which follows every motion. Where a surface runs towards the centroid
the sign may differ between two clouds, and with it three of the ten channels of a feature.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxreg._xla import on_any_mesh
from jaxreg.config import Config, RPMNetConfig
from jaxreg.geometry import rigid
from jaxreg.geometry.neighbors import knn, squared_distances
from jaxreg.geometry.normals import normals
from jaxreg.geometry.numerics import included_angle, leading_max, safe_norm
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.network.matching import squared_feature_distance
from jaxreg.network.model import Variables
from jaxreg.peers import pair, state_dict
from jaxreg.types import PointCloud, Registration, RigidTransform

_FAR = 1e30
_DISCOUNT = 0.5


class Neighborhoods(NamedTuple):
    """What a motion of the cloud does not change: neighbours (n, k), and point-pair features."""

    neighbors: Int[Array, "n k"]
    ppf: Float[Array, "n k 4"]


class Step(NamedTuple):
    """One registration step; row sums of the match matrix are the weights of the source's points."""

    transform: RigidTransform
    rows: Float[Array, "n"]
    columns: Float[Array, "m"]
    copy: Float[Array, "n 3"]


class _GroupNorm(nn.Module):
    """Zero mean and unit variance over a group of channels and all valid points of one cloud."""

    groups: int
    epsilon: float = 1e-5

    @nn.compact
    def __call__(
        self, x: Float[Array, "*points c"], mask: Bool[Array, "*#points"]
    ) -> Float[Array, "*points c"]:
        channels = x.shape[-1]
        groups = math.gcd(self.groups, channels)
        scale, bias = (
            self.param(name, getattr(nn.initializers, kind), (channels,), jnp.float32)
            for name, kind in (("scale", "ones"), ("bias", "zeros"))
        )
        weight = jnp.broadcast_to(mask, x.shape[:-1]).reshape(-1).astype(x.dtype)
        flat = x.reshape(-1, groups, channels // groups)
        count = jnp.maximum(jnp.sum(weight), 1) * (channels // groups)

        def mean(values):
            summed = jnp.matmul(weight, values.reshape(-1, channels), precision=Precision.HIGHEST)
            return (jnp.sum(summed.reshape(groups, -1), axis=1) / count)[None, :, None]

        centred = flat - mean(flat)
        normal = centred * jax.lax.rsqrt(mean(centred**2) + self.epsilon)
        axes = tuple(range(x.ndim - 1))
        return normal.reshape(x.shape) * jnp.expand_dims(scale, axes) + jnp.expand_dims(bias, axes)


def _layer(x, mask, width: int, groups: int):
    return nn.relu(_GroupNorm(groups)(nn.Dense(width)(x), mask))


class _ParameterNetwork(nn.Module):
    """alpha and beta of the affinity from both clouds, whose points are told apart by a flag."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(
        self, source: PointCloud, reference: PointCloud
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        flagged = [
            jnp.concatenate(
                [x.points, jnp.full((x.mask.shape[0], 1), flag, x.points.dtype)], axis=1
            )
            for flag, x in enumerate((source, reference))
        ]
        x, mask = jnp.concatenate(flagged), jnp.concatenate([source.mask, reference.mask])
        *first, last = self.hidden[:-2]
        for width in first:
            x = _layer(x, mask, width, 8)
        x = jnp.where(mask[:, None], _layer(x, mask, last, 16), 0)
        x, one = leading_max(x)[None, :], jnp.ones(1, bool)
        for width in self.hidden[-2:]:
            x = _layer(x, one, width, 16)
        beta, alpha = nn.softplus(nn.Dense(2)(x)[0])
        return alpha, beta


class _FeatureNetwork(nn.Module):
    """A PointNet over the ten channels of every neighbour; features of unit length."""

    width: int

    @nn.compact
    def __call__(
        self, channels: Float[Array, "n k 10"], mask: Bool[Array, "n"]
    ) -> Float[Array, "n c"]:
        # K first: the maximum over it is then an elementwise maximum of contiguous blocks.
        x = jnp.swapaxes(jnp.where(mask[:, None, None], channels, 0), 0, 1)
        for width in (self.width, self.width, 2 * self.width):
            x = _layer(x, mask[None, :], width, 8)
        x = leading_max(x)
        for width in (2 * self.width, self.width):
            x = _layer(x, mask, width, 8)
        x = nn.Dense(self.width)(x)
        length = safe_norm(x)[:, None]
        return x / jnp.where(length > 0, length, 1)


@on_any_mesh
def register(
    variables: Variables,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    config: Config | RPMNetConfig,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
) -> Registration:
    """Register two clouds with RPM-Net; pure: jit, vmap and differentiate it.

    `confidence` is the sum of a point's row of the match matrix, in [0, 1]; `correspondences` are
    the means of the reference by that row. The pose that a step starts from is a constant of the
    derivative, as in its paper.

    Clouds should be in the unit sphere. Padding and empty clouds are as in `jaxreg.register_pair`.

    Raises:
      ValueError: a cloud is not ``(n, 3)`` of float32 or float64; a mask is not ``(n,)`` of bools; a
        cloud has no more than `config.k_normals` points; `config` is not that of RPM-Net.
    """
    config = pair.settings(config, "rpmnet", RPMNetConfig)
    clouds = pair.clouds(source, reference, source_mask, reference_mask)
    variables = pair.in_dtype(variables, clouds[0].points.dtype)
    steps = _steps(variables, *clouds, config=config, iterations=config.iterations)
    last = jax.tree.map(lambda x: x[-1], steps)
    return pair.registration(last.transform, *clouds, last.rows, last.copy)


def init_variables(key: PRNGKeyArray, config: RPMNetConfig) -> Variables:
    """Random initial `params`; there are no `batch_stats`."""
    cloud = PointCloud(jnp.ones((2, 3), jnp.float32), jnp.ones(2, bool))
    parameters, features = _networks(config)
    channels = jnp.ones((2, config.neighbors, 10), jnp.float32)
    first = parameters.init(jax.random.fold_in(key, 0), cloud, cloud)["params"]
    second = features.init(jax.random.fold_in(key, 1), channels, cloud.mask)["params"]
    return {"params": {"parameters": first, "features": second}, "batch_stats": {}}


def _networks(config: RPMNetConfig) -> tuple[Any, Any]:
    return _ParameterNetwork(config.hidden), _FeatureNetwork(config.width)


def _steps(
    variables: Variables, source: PointCloud, reference: PointCloud, *, config, iterations: int
) -> Step:
    """All steps, stacked. Each is solved from the source where it was, so that errors do not add up."""
    parameters, network = _networks(config)
    around = [neighborhoods(cloud, config=config) for cloud in (source, reference)]

    def features(points, near: Neighborhoods, mask):
        return network.apply(
            {"params": variables["params"]["features"]}, hybrid_features(points, near), mask
        )

    of_reference = features(reference.points, around[1], reference.mask)

    def step(start: RigidTransform, _):
        moved = source._replace(points=rigid.apply(start, source.points))
        own = {"params": variables["params"]["parameters"]}
        alpha, beta = parameters.apply(own, moved, reference)
        of_source = features(moved.points, around[0], source.mask)
        distance = jnp.maximum(squared_feature_distance(of_source, of_reference), 0)
        both = source.mask[:, None] & reference.mask[None, :]
        matches = sinkhorn(-beta * (distance - alpha), both, rounds=config.sinkhorn)
        rows = jnp.sum(matches, axis=1)
        copy = jnp.matmul(matches, reference.points, precision=Precision.HIGHEST)
        copy = copy / jnp.where(rows > 0, rows, 1)[:, None]
        found = weighted_procrustes(source.points, copy, rows)
        return jax.lax.stop_gradient(found), Step(found, rows, jnp.sum(matches, axis=0), copy)

    # A step is computed again in the backward pass: its features are the most memory by far.
    step = jax.checkpoint(step, prevent_cse=False)
    start = pair.identity_of(source, reference)
    return jax.lax.scan(step, start, length=iterations)[1]


def neighborhoods(cloud: PointCloud, *, config: RPMNetConfig) -> Neighborhoods:
    """The first `neighbors` points within `radius`, in the order of the rows, and their features.

    A short list is filled up with the point itself. The point-pair feature of ``d = x_j - x_i`` is
    ``(angle(n_i, d), angle(n_j, d), angle(n_i, n_j), |d|)``.

    Raises:
      ValueError: the cloud has no more than `config.k_normals` points.
    """
    points, mask = cloud
    n = points.shape[0]
    apart = jax.lax.stop_gradient(squared_distances(points, points))
    own = jnp.arange(n, dtype=jnp.int32)
    within = (apart <= config.radius**2) & mask[None, :] & (own[None, :] != own[:, None])
    # As floats, of which a CPU selects the largest without sorting the row.
    order = jnp.where(within, n - own[None, :], 0).astype(jnp.float32)
    size = min(config.neighbors, n)
    first = jax.lax.optimization_barrier(jax.lax.top_k(order, size)[0]).astype(jnp.int32)
    found = jnp.where(first > 0, n - first, own[:, None])
    filled = jnp.broadcast_to(own[:, None], (n, config.neighbors - size))
    neighbors = jnp.concatenate([found, filled], axis=1)

    outward = oriented_normals(cloud, k=config.k_normals)
    offset = points[neighbors] - points[:, None]
    at_point = jnp.broadcast_to(outward[:, None], offset.shape)
    at_neighbor = outward[neighbors]
    angles = (
        included_angle(at_point, offset),
        included_angle(at_neighbor, offset),
        included_angle(at_point, at_neighbor),
    )
    return Neighborhoods(neighbors, jnp.stack([*angles, safe_norm(offset)], axis=-1))


def oriented_normals(cloud: PointCloud, *, k: int) -> Float[Array, "n 3"]:
    """Unit normals that point away from the centroid of the valid points.

    Raises:
      ValueError: the cloud has no more than `k` points.
    """
    points, mask = cloud
    found = normals(points, knn(points, k, mask), mask)
    count = jnp.maximum(jnp.sum(mask, dtype=points.dtype), 1)
    outward = points - (jnp.sum(points, axis=0) / count)[None, :]
    inward = jnp.sum(found * outward, axis=1) < 0
    return jnp.where(inward[:, None], -found, found)


def hybrid_features(points: Float[Array, "n 3"], near: Neighborhoods) -> Float[Array, "n k 10"]:
    """The ten channels of every neighbour: ``x_i``, ``x_j - x_i``, and the point-pair feature."""
    offset = points[near.neighbors] - points[:, None]
    centre = jnp.broadcast_to(points[:, None], offset.shape)
    return jnp.concatenate([centre, offset, near.ppf], axis=-1)


def sinkhorn(
    affinity: Float[Array, "n m"], valid: Bool[Array, "n m"], *, rounds: int
) -> Float[Array, "n m"]:
    """The match matrix of an affinity (a logarithm): rows, then columns are made to sum to 1, often.

    Each row and column also has a slack entry, of affinity 0, that takes part in its sum and in no
    other. With logarithmic factors ``M = exp(A - u - v)``: ``u_i = log(1 + sum_j exp(A_ij - v_j))``,
    then v likewise.
    """
    affinity = jnp.where(valid, affinity, -_FAR)

    def total(x, axis: int):
        largest = jnp.maximum(jax.lax.stop_gradient(jnp.max(x, axis=axis, keepdims=True)), 0)
        summed = jnp.sum(jnp.exp(x - largest), axis=axis, keepdims=True) + jnp.exp(-largest)
        return largest + jnp.log(summed)

    u, v = jnp.zeros_like(affinity[:, :1]), jnp.zeros_like(affinity[:1])
    for _ in range(rounds):
        u = total(affinity - v, axis=1)
        v = total(affinity - u, axis=0)
    return jnp.exp(affinity - u - v)


def loss(
    variables: Variables,
    source: PointCloud,
    reference: PointCloud,
    truth: RigidTransform,
    *,
    config,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]], Variables]:
    """The loss of a pair, its terms, and the variables; supervised: it sees the pose.

    Over the steps, later ones counting twice as much as the one before: the mean absolute error of
    the moved points' coordinates, and `inliers` times the mean mass that rows and columns lack.
    """
    clouds = pair.clouds(source.points, reference.points, source.mask, reference.mask)
    steps = _steps(variables, *clouds, config=config, iterations=config.train_iterations)
    source, reference = clouds
    target = rigid.apply(truth, source.points)

    def mean(values, mask):
        count = jnp.maximum(jnp.sum(mask, dtype=values.dtype), 1)
        return jnp.sum(jnp.where(mask[None, :], values, 0), axis=1) / count

    moved = jax.vmap(rigid.apply, (0, None))(steps.transform, source.points)
    error = mean(jnp.mean(jnp.abs(moved - target[None]), axis=2), source.mask)
    missing = mean(1 - steps.rows, source.mask) + mean(1 - steps.columns, reference.mask)
    later = jnp.arange(config.train_iterations - 1, -1, -1)
    share = _DISCOUNT ** later.astype(error.dtype)
    terms = {"pose_error": jnp.sum(share * error), "missing": jnp.sum(share * missing)}
    return terms["pose_error"] + config.inliers * terms["missing"], terms, variables


def load_weights(path: str | Path) -> tuple[Variables, Config]:
    """Load weights of the authors' program, an ``.npz`` of its state dict; PyTorch is not needed.

    Widths are those of the arrays, the rest of the configuration is the default. Their clouds came
    with normals of the mesh; ours are made of the points.

    Raises:
      ValueError: the file is missing or not an ``.npz``, or an array of the network is missing or has
        another shape.
    """
    variables, config = state_dict.load(path, "RPM-Net", _read_state_dict, init_variables)
    return variables, Config(network="rpmnet", rpmnet=config)


def _read_state_dict(arrays: state_dict.Arrays) -> tuple[Variables, RPMNetConfig]:
    def pointnet(root: str, before: int, after: int) -> Variables:
        """Layers before and after the pooling: each a linear map, its GroupNorm and a ReLU."""
        found: Variables = {}
        names = [f"{root}.prepool.{3 * i}" for i in range(before)]
        names += [f"{root}.postpool.{3 * i}" for i in range(after)]
        for i, name in enumerate(names):
            found[f"Dense_{i}"] = state_dict.dense(arrays, name)
            if i + 1 < len(names):  # The last layer is a linear map alone.
                stem, _, number = name.rpartition(".")
                norm = f"{stem}.{int(number) + 1}"
                scale, bias = (jnp.asarray(arrays[f"{norm}.{x}"]) for x in ("weight", "bias"))
                found[f"_GroupNorm_{i}"] = {"scale": scale, "bias": bias}
        return found

    parameters = pointnet("weights_net", before=5, after=3)
    features = pointnet("feat_extractor", before=3, after=3)
    variables = {
        "params": {"parameters": parameters, "features": features},
        "batch_stats": {},
    }
    return variables, RPMNetConfig(
        width=features["Dense_5"]["kernel"].shape[1],
        hidden=tuple(parameters[f"Dense_{i}"]["kernel"].shape[1] for i in range(7)),
    )
