"""CEMNet (Jiang et al., ICCV 2021): a network says where to look, the cross-entropy method looks.

A sampling network predicts a normal distribution of poses, the prior. In every round of the
cross-entropy method candidates are drawn from the distribution, scored on the clouds, and the best
of them, the elites, make the next distribution. A pose is six numbers: Euler angles about z, y and
x with ``R = Rx Ry Rz``, and t.

Clouds may overlap in part, since a point far from the other cloud counts nothing; but a wrong pose of
a symmetric shape scores as well as the right one.
"""

from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxreg._xla import on_any_mesh, varying_like
from jaxreg.config import CEMNetConfig, Config
from jaxreg.geometry import rigid
from jaxreg.geometry.neighbors import nearest_in, squared_distances
from jaxreg.geometry.numerics import leading_max, safe_norm, safe_sqrt
from jaxreg.geometry.procrustes import weighted_procrustes
from jaxreg.network.features import DGCNN, BatchNorm
from jaxreg.network.matching import feature_distance
from jaxreg.network.model import Variables
from jaxreg.peers import pair, state_dict
from jaxreg.types import PointCloud, Registration, RigidTransform

_BN_MOMENTUM = 0.9
_ICP_STEPS = 3
_WIDE = (1.0, 1.0, 1.0, 0.5, 0.5, 0.5)
"""Standard deviation of the exploration: radians, and units of the unit sphere."""
_LOCKED = 64
"""Cosine of the angle about y, in roundings, at which the other two angles are one."""
_FAR = 1e30
_LANES = 131072
"""Points that are compared with the other cloud at once; with fewer XLA uses one core only."""
_UNROLLED = 32


class Distribution(NamedTuple):
    """A normal distribution of poses, each number on its own: angles about z, y, x; translation."""

    mu: Float[Array, "6"]
    sigma: Float[Array, "6"]


class _SamplingNetwork(nn.Module):
    """sigma of the prior from the pooled embeddings of both clouds: a perceptron, then a sigmoid."""

    hidden: tuple[int, ...]

    @nn.compact
    def __call__(self, pooled: Float[Array, "c"], *, train: bool) -> Float[Array, "6"]:
        x, mask = pooled[None, :], jnp.ones(1, bool)
        for width in self.hidden:
            x = BatchNorm(_BN_MOMENTUM)(nn.Dense(width)(x), mask, train=train)
            x = nn.leaky_relu(x, 0.01)
        return nn.sigmoid(nn.Dense(6)(x))[0]


@on_any_mesh
def register(
    variables: Variables,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    config: Config | CEMNetConfig,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
) -> Registration:
    """Register two clouds with CEMNet; pure: jit and vmap it. The same seed draws the same poses.

    As in its paper, the errors of the candidates are constants of the derivative: it goes through
    the candidates to the network that drew them. `confidence` is how well a point agrees with the
    reference in the end, ``max(0, 1 - d / epsilon)``; `correspondences` are its nearest points.

    Two things differ from the authors' program, for speed; errors of the last rounds agree with it
    for candidates near the mean. While it looks ahead, every `stride`-th point is scored, against
    all of the other cloud. Later all are, against those `reach` points of the other cloud that are
    nearest at the mean pose.

    Clouds should be in the unit sphere. Padding and empty clouds are as in `jaxreg.register_pair`.

    Raises:
      ValueError: a cloud is not ``(n, 3)`` of float32 or float64; a mask is not ``(n,)`` of bools; a
        cloud has fewer than `config.k` points; `config` is not that of CEMNet.
    """
    config = pair.settings(config, "cemnet", CEMNetConfig)
    moving, fixed = pair.clouds(source, reference, source_mask, reference_mask)
    variables = pair.in_dtype(variables, moving.points.dtype)
    prior = sampling_network(variables, moving, fixed, config=config)
    found = _cross_entropy_method(_explored(prior, config.exploration), moving, fixed, config)
    transform = pose_of(found.mu)
    moved = rigid.apply(transform, moving.points)
    nearest = fixed.points[nearest_in(moved, fixed.points, fixed.mask)]
    agreement = jnp.maximum(1 - safe_norm(moved - nearest) / config.epsilon, 0)
    return pair.registration(transform, moving, fixed, agreement)


def init_variables(key: PRNGKeyArray, config: CEMNetConfig) -> Variables:
    """Random initial `params` and `batch_stats`."""
    features, sampling = _networks(config)
    edges, mask = jnp.ones((1, config.k, 6), jnp.float32), jnp.ones(1, bool)
    pooled = jnp.ones(2 * config.width, jnp.float32)
    first = features.init(jax.random.fold_in(key, 0), edges, mask, train=False)
    second = sampling.init(jax.random.fold_in(key, 1), pooled, train=False)
    return state_dict.joined({"features": first, "sampling": second})


def sampling_network(
    variables: Variables, source: PointCloud, reference: PointCloud, *, config: CEMNetConfig
) -> Distribution:
    """The prior: mu by soft matching of features and Procrustes, sigma by the sampling network.

    Raises:
      ValueError: a cloud has fewer than `config.k` points.
    """
    networks = _networks(config)
    own = [
        {kind: tree[name] for kind, tree in variables.items()} for name in ("features", "sampling")
    ]
    features = [
        networks[0].apply(own[0], pair.absolute_edges(cloud, config.k), cloud.mask, train=False)
        for cloud in (source, reference)
    ]
    scores = pair.row_softmax(-feature_distance(features[0], features[1]), reference.mask)
    copy = pair.soft_copy(scores, reference)
    weights = jnp.asarray(source.mask & jnp.any(reference.mask), copy.dtype)
    transform = weighted_procrustes(source.points, copy, weights)
    # Features are not negative: zero leaves the maximum of the valid points as it is.
    pooled = [
        leading_max(jnp.where(cloud.mask[:, None], x, 0))
        for x, cloud in zip(features, (source, reference), strict=True)
    ]
    sigma = networks[1].apply(own[1], jnp.concatenate(pooled), train=False)
    return Distribution(numbers_of(transform), sigma)


def _networks(config: CEMNetConfig) -> tuple[Any, Any]:
    return DGCNN(config.channels, config.width, _BN_MOMENTUM), _SamplingNetwork(config.hidden)


def numbers_of(transform: RigidTransform) -> Float[Array, "6"]:
    """Angles about z, y and x with ``R = Rx Ry Rz``, y in [-pi/2, pi/2], and t.

    Where y is a right angle only one angle is left of the other two: then z is 0, and constant.
    """
    r = transform.rotation
    flat = safe_norm(r[0, :2])
    locked = flat <= _LOCKED * jnp.finfo(r.dtype).eps

    def angle(sine, cosine, kept):
        usable = kept & ((sine != 0) | (cosine != 0))
        sine, cosine = jnp.where(usable, sine, 0), jnp.where(usable, cosine, 1)
        return jnp.arctan2(sine, cosine)

    about_z = angle(-r[0, 1], r[0, 0], ~locked)
    about_x = angle(-r[1, 2], r[2, 2], ~locked) + angle(r[1, 0] * r[0, 2], r[1, 1], locked)
    about_y = angle(r[0, 2], flat, True)
    return jnp.concatenate([jnp.stack([about_z, about_y, about_x]), transform.translation])


def pose_of(numbers: Float[Array, "6"]) -> RigidTransform:
    """The transform of six numbers; the reverse of `numbers_of`."""
    (cz, cy, cx), (sz, sy, sx) = jnp.cos(numbers[:3]), jnp.sin(numbers[:3])
    rows = [
        [cy * cz, -cy * sz, sy],
        [sx * sy * cz + cx * sz, cx * cz - sx * sy * sz, -sx * cy],
        [sx * sz - cx * sy * cz, cx * sy * sz + sx * cz, cx * cy],
    ]
    return RigidTransform(jnp.stack([jnp.stack(row) for row in rows]), numbers[3:])


def _explored(prior: Distribution, share: float) -> Distribution:
    """The prior, mixed with a wide distribution about no motion: what the network does not know."""
    wide = jnp.asarray(_WIDE, prior.sigma.dtype)
    return Distribution((1 - share) * prior.mu, (1 - share) * prior.sigma + share * wide)


def _cross_entropy_method(
    prior: Distribution, source: PointCloud, reference: PointCloud, config: CEMNetConfig
) -> Distribution:
    """The distribution after all rounds: candidates, errors, elites, and the next distribution."""
    # Drawn by NumPy: compiled in another way, JAX's normal numbers differ in the last digit.
    drawn = np.random.default_rng(config.seed).standard_normal(
        (config.iterations, config.candidates, 6), np.float32
    )
    noise = jnp.asarray(drawn, prior.mu.dtype)
    few = _every(source, config.stride), _every(reference, config.stride)

    def early(now: Distribution, noise: Float[Array, "c 6"]):
        candidates = _drawn(now, noise)
        return elites(candidates, _fused_error(candidates, few, source, reference, config)), None

    def late(now: Distribution, noise: Float[Array, "c 6"]):
        candidates = _drawn(now, noise)
        near = _reachable(pose_of(now.mu), source, reference, config.reach)
        return elites(
            candidates, _error_in_reach(candidates, near, source, reference, config)
        ), None

    ahead = min(config.look_ahead, config.iterations)
    found = jax.lax.scan(early, prior, noise[:ahead])[0]
    return jax.lax.scan(late, found, noise[ahead:])[0]


def _drawn(now: Distribution, noise: Float[Array, "c 6"]) -> Float[Array, "c 6"]:
    return now.mu[None, :] + now.sigma[None, :] * noise


def _every(cloud: PointCloud, stride: int) -> PointCloud:
    """Every `stride`-th valid point: which ones does not depend on the padding."""
    order = jnp.argsort(~cloud.mask, stable=True)[::stride]
    return PointCloud(cloud.points[order], cloud.mask[order])


def elites(candidates: Float[Array, "c 6"], errors: Float[Array, "c"]) -> Distribution:
    """The next distribution: mean and deviation of the candidates, weighted by `sparsemax`.

    The errors, in [0, 2], are constants of the derivative.
    """
    share = sparsemax(-jax.lax.stop_gradient(errors))[:, None]
    mu = jnp.sum(share * candidates, axis=0)
    return Distribution(mu, safe_sqrt(jnp.sum(share * (candidates - mu[None, :]) ** 2, axis=0)))


def sparsemax(scores: Float[Array, "c"]) -> Float[Array, "c"]:
    """``max(score - tau, 0)`` with tau so that they sum to 1 (Martins and Astudillo, 2016).

    The nearest point of the simplex; most entries are exactly zero.
    """
    ordered = -jnp.sort(-scores)
    count = jnp.arange(1, scores.shape[0] + 1, dtype=scores.dtype)
    # About the largest score, or the sums of a thousand lose their last digits.
    above = jnp.cumsum(ordered - ordered[0])
    kept = 1 + count * (ordered - ordered[0]) > above
    size = jnp.sum(kept, dtype=jnp.int32)
    tau = (above[size - 1] - 1) / size.astype(scores.dtype) + ordered[0]
    return jnp.maximum(scores - tau, 0)


def _maximum_consensus(
    squared: Float[Array, "n c"], mask: Bool[Array, "n"], epsilon: float
) -> Float[Array, "c"]:
    """Mean over valid points of ``max(0, 1 - d / epsilon)``: 1 where every point has a partner."""
    agreement = jnp.maximum(1 - safe_sqrt(squared) / epsilon, 0)
    weight = mask.astype(squared.dtype)
    # A product, because XLA:CPU sums long columns slowly.
    total = jnp.matmul(weight, agreement, precision=Precision.HIGHEST)
    return total / jnp.maximum(jnp.sum(weight), 1)


def alignment_error(
    poses: RigidTransform,
    few: tuple[PointCloud, PointCloud],
    source: PointCloud,
    reference: PointCloud,
    epsilon: float,
) -> Float[Array, "c"]:
    """``2 - (consensus of the source with the reference, and of the reference with the source)``.

    Of every one of many poses (c, 3, 3), (c, 3); `few` are the points that count. A constant of the
    derivative.
    """
    poses, few, source, reference = jax.lax.stop_gradient((poses, few, source, reference))
    moved = _moved(poses, few[0].points)
    back = _moved(rigid.inverse(poses), few[1].points)
    there = _maximum_consensus(_nearest(moved, reference), few[0].mask, epsilon)
    return 2 - there - _maximum_consensus(_nearest(back, source), few[1].mask, epsilon)


def _moved(poses: RigidTransform, points: Float[Array, "n 3"]) -> tuple[Float[Array, "n c"], ...]:
    """The three coordinates of a cloud under many poses.

    Not as a product of matrices: this becomes a part of the kernels that use it.
    """
    rotation, translation = poses
    return tuple(
        sum(points[:, j, None] * rotation[None, :, i, j] for j in range(3))
        + translation[None, :, i]
        for i in range(3)
    )


def _fused_error(candidates, few, source, reference, config: CEMNetConfig) -> Float[Array, "c"]:
    """The error of each candidate, mixed with its future: that after three steps of ICP."""
    candidates, few, source, reference = jax.lax.stop_gradient((candidates, few, source, reference))
    poses = jax.vmap(pose_of)(candidates)

    def step(poses, _):
        return _icp_step(poses, few[0], reference), None

    ahead, _ = jax.lax.scan(step, poses, length=_ICP_STEPS)
    both = jax.tree.map(lambda *x: jnp.concatenate(x), poses, ahead)
    errors = alignment_error(both, few, source, reference, config.epsilon)
    now, future = jnp.split(errors, 2)
    return (1 - config.future) * now + config.future * future


def _icp_step(poses: RigidTransform, source: PointCloud, reference: PointCloud) -> RigidTransform:
    """The next poses: least squares from all points of the source to those nearest to them."""
    row = _nearest_row(_moved(poses, source.points), reference)
    weights = source.mask.astype(source.points.dtype)
    solve = lambda row: weighted_procrustes(source.points, reference.points[row], weights)  # noqa: E731
    return jax.vmap(solve, 1)(row)


def _nearest(moved: tuple[Float[Array, "n c"], ...], others: PointCloud) -> Float[Array, "n c"]:
    """Squared distance of every moved point to the nearest valid other point."""

    def closer(smallest, distance, _):
        return jnp.minimum(smallest, distance)

    return _over_all(moved, others, closer, jnp.asarray(_FAR, others.points.dtype))


def _nearest_row(moved: tuple[Float[Array, "n c"], ...], others: PointCloud) -> Int[Array, "n c"]:
    """Row of the nearest valid other point, where distances that agree to four digits are equal."""
    # A distance that is not negative is ordered as its bits are. So the row may take the place of
    # the last of them, and the smallest of these integers says both.
    bits = max(others.mask.shape[0] - 1, 1).bit_length()
    low = (1 << bits) - 1

    def closer(smallest, distance, row):
        pattern = jax.lax.bitcast_convert_type(distance.astype(jnp.float32), jnp.int32)
        return jnp.minimum(smallest, (pattern & ~low) | row)

    largest = jnp.asarray(jnp.iinfo(jnp.int32).max, jnp.int32)
    found = _over_all(moved, others, closer, largest) & low
    return jnp.minimum(found, others.mask.shape[0] - 1)


def _over_all(moved: tuple[Float[Array, "n c"], ...], others: PointCloud, closer, start):
    """``closer(so far, squared distance, row)`` for every moved point and one other after the other.

    What was found so far stays in the cache: (n, c, m) distances would go through memory many times.
    """
    shape, count, m = moved[0].shape, moved[0].size, others.mask.shape[0]
    lanes = min(_LANES, count)
    flat = jnp.pad(jnp.stack(moved).reshape(3, count), ((0, 0), (0, -count % lanes)))
    points = jnp.where(others.mask[:, None], others.points, _FAR**0.5)
    points = jnp.pad(points, ((0, -m % _UNROLLED), (0, 0)), constant_values=_FAR**0.5)
    groups = points.reshape(-1, _UNROLLED, 3)
    first = jnp.arange(groups.shape[0], dtype=jnp.int32) * _UNROLLED

    def of_block(block: Float[Array, "3 lanes"]):
        def compare(found, group):
            points, first = group
            for i in range(_UNROLLED):
                distance = sum((x - points[i, axis]) ** 2 for axis, x in enumerate(block))
                found = closer(found, distance, first + i)
            return found, None

        so_far = varying_like(jnp.broadcast_to(start, (lanes,)), block[0, 0] + points[0, 0])
        return jax.lax.scan(compare, so_far, (groups, first))[0]

    blocks = jnp.moveaxis(flat.reshape(3, -1, lanes), 1, 0)
    return jax.lax.map(of_block, blocks).reshape(-1)[:count].reshape(shape)


def _reachable(pose: RigidTransform, source: PointCloud, reference: PointCloud, reach: int):
    """For every point of both clouds, the `reach` points of the other nearest at `pose`."""
    moved = rigid.apply(pose, source.points)
    apart = squared_distances(moved, reference.points)
    apart = jnp.where(source.mask[:, None] & reference.mask[None, :], apart, _FAR)

    def rows(distances, count):
        return jax.lax.optimization_barrier(jax.lax.top_k(-distances, min(reach, count))[1])

    return rows(apart, reference.mask.shape[0]), rows(apart.T, source.mask.shape[0])


def _error_in_reach(candidates, near, source, reference, config: CEMNetConfig):
    """`alignment_error` of all points, each compared with the points in its reach alone."""
    candidates, source, reference = jax.lax.stop_gradient((candidates, source, reference))
    poses = jax.vmap(pose_of)(candidates)
    agreements = []
    for transforms, cloud, other, rows in (
        (poses, source, reference, near[0]),
        (rigid.inverse(poses), reference, source, near[1]),
    ):
        moved = _moved(transforms, cloud.points)
        smallest = jnp.full(moved[0].shape, _FAR, cloud.points.dtype)
        for row in rows.T:
            partner = jnp.where(other.mask[row][:, None], other.points[row], _FAR**0.5)
            apart = sum((x - partner[:, axis, None]) ** 2 for axis, x in enumerate(moved))
            smallest = jnp.minimum(smallest, apart)
        agreements.append(_maximum_consensus(smallest, cloud.mask, config.epsilon))
    return 2 - agreements[0] - agreements[1]


def load_weights(path: str | Path) -> tuple[Variables, Config]:
    """Load CEMNet's published weights, an ``.npz`` of its state dict; PyTorch is not needed.

    Raises:
      ValueError: the file is missing or not an ``.npz``, or an array of the network is missing or has
        another shape.
    """

    def read(arrays: state_dict.Arrays) -> tuple[Variables, CEMNetConfig]:
        root = "coarse_policy"
        features = state_dict.dgcnn(arrays, f"{root}.emb_nn.", layers=5)
        layers = [(f"{root}.nn.{i}", f"{root}.nn.{i + 1}") for i in (0, 3)]
        sampling = state_dict.dense_and_norm(arrays, layers, last=f"{root}.nn.6")
        return state_dict.joined({"features": features, "sampling": sampling}), CEMNetConfig()

    variables, config = state_dict.load(path, "CEMNet", read, init_variables)
    return variables, Config(network="cemnet", cemnet=config)
