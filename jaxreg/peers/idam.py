"""IDAM (Li, Zhang, Xu, Zhou and Zhang, ECCV 2020): distance-aware matching after two eliminations.

Hard elimination keeps the points that a network calls significant; soft elimination gives weights
to the correspondences of these. In between, a network reads features *and* distances of every pair
of kept points, so that a rough pose helps to find the next one. Clouds may overlap in part; its
features are not invariant to rotation, and it was made for rotations up to 45 degrees.
"""

from pathlib import Path
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxreg._xla import on_any_mesh
from jaxreg.config import Config, IDAMConfig
from jaxreg.geometry import rigid
from jaxreg.geometry.neighbors import knn, nearest_in
from jaxreg.geometry.numerics import leading_max, safe_norm
from jaxreg.geometry.procrustes import special_procrustes
from jaxreg.network.features import BatchNorm
from jaxreg.network.model import Variables
from jaxreg.network.run import run_network
from jaxreg.peers import pair, state_dict
from jaxreg.types import PointCloud, Registration, RigidTransform

_LARGEST_SCORE = 20.0
_SMALLEST_LOG = -30.0
_FAR_BELOW = -1e30


class Kept(NamedTuple):
    """The points of a cloud that hard elimination leaves: rows, coordinates, features."""

    rows: Int[Array, "k"]
    cloud: PointCloud
    features: Float[Array, "k c"]


class Step(NamedTuple):
    """One registration step.

    `scores` are the logarithms of the matching scores before the softmax, `columns` the most similar
    reference point of each row, `hybrid` the outcome of hybrid elimination before the median.
    """

    transform: RigidTransform
    scores: Float[Array, "k l"]
    columns: Int[Array, "k"]
    validity: Float[Array, "k"]
    weights: Float[Array, "k"]


class _Block(nn.Module):
    """Layers of one point or pair alone; all but the last have a BatchNorm and a ReLU."""

    widths: tuple[int, ...]
    bn_momentum: float

    @nn.compact
    def __call__(
        self, x: Float[Array, "*points c"], mask: Bool[Array, "*#points"], *, train: bool
    ) -> Float[Array, "*points d"]:
        for width in self.widths[:-1]:
            x = nn.Dense(width, use_bias=False)(x)
            x = nn.relu(BatchNorm(self.bn_momentum)(x, mask, train=train))
        return nn.Dense(self.widths[-1])(x)


class _GraphNetwork(nn.Module):
    """Features of every point: layers over the differences to its neighbours in the cloud."""

    channels: tuple[int, ...]
    bn_momentum: float

    @nn.compact
    def __call__(
        self,
        points: Float[Array, "n 3"],
        neighbors: Int[Array, "n k"],
        mask: Bool[Array, "n"],
        *,
        train: bool,
    ) -> Float[Array, "n c"]:
        x = points
        for i, width in enumerate(self.channels):
            # K first: the maximum over it is then an elementwise maximum of contiguous blocks.
            edges = x[neighbors.T] - x[None]
            edges = _Block((width, width), self.bn_momentum, name=f"edges_{i}")(
                edges, mask[None, :], train=train
            )
            x = nn.Dense(width, name=f"points_{i}")(leading_max(edges))
            x = jnp.where(mask[:, None], x, 0)
        return x


class _SimilarityNetwork(nn.Module):
    """Similarity of every pair of kept points, and validity of each row, from features and distance."""

    hidden: int
    bn_momentum: float

    @nn.compact
    def __call__(
        self, source: Kept, reference: Kept, *, train: bool
    ) -> tuple[Float[Array, "k l"], Float[Array, "k"]]:
        mask = source.cloud.mask[:, None] & reference.cloud.mask[None, :]
        x = jnp.where(mask[..., None], distance_augmented(source, reference), 0)

        def block(name: str, width: int, x, mask):
            layers = _Block((self.hidden, width), self.bn_momentum, name=name)
            return layers(x, mask, train=train)

        x = block("pairs", self.hidden, x, mask)
        score = block("scores", 1, x, mask)[..., 0]
        pooled = leading_max(jnp.swapaxes(jnp.where(mask[..., None], x, _FAR_BELOW), 0, 1))
        rows = jnp.any(mask, axis=1)
        validity = block("validity", 1, jnp.where(rows[:, None], pooled, 0), rows)[:, 0]
        return jnp.clip(score, -_LARGEST_SCORE, _LARGEST_SCORE), nn.sigmoid(validity)


def distance_augmented(source: Kept, reference: Kept) -> Float[Array, "k l d"]:
    """The feature tensor of all pairs: both features, the distance, and its unit direction."""
    apart = source.cloud.points[:, None] - reference.cloud.points[None]
    distance = safe_norm(apart)[..., None]
    direction = apart / jnp.where(distance > 0, distance, 1)
    shape = (*apart.shape[:2], source.features.shape[1])
    first = jnp.broadcast_to(source.features[:, None], shape)
    second = jnp.broadcast_to(reference.features[None], shape)
    return jnp.concatenate([first, second, distance, direction], axis=-1)


@on_any_mesh
def register(
    variables: Variables,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    config: Config | IDAMConfig,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
) -> Registration:
    """Register two clouds with IDAM; pure: jit and vmap it.

    `confidence` of a kept point is its validity if that is not below the median of all, and 0
    otherwise; `correspondences` are the reference points that are most similar to the kept points,
    and the nearest ones of the others. Which points are kept, and which are most similar, jumps;
    the derivative is that of the weights, and the pose that a step starts from is a constant.

    Clouds should be in the unit sphere. Padding and empty clouds are as in `jaxreg.register_pair`.

    Raises:
      ValueError: a cloud is not ``(n, 3)`` of float32 or float64; a mask is not ``(n,)`` of bools; a
        cloud has fewer than `config.k` points; `config` is not that of IDAM.
    """
    config = pair.settings(config, "idam", IDAMConfig)
    clouds = pair.clouds(source, reference, source_mask, reference_mask)
    variables = pair.in_dtype(variables, clouds[0].points.dtype)
    kept: list[Kept] = []
    for cloud in clouds:
        features, significance, variables = _described(variables, cloud, config, train=False)
        rows, mask = hard_elimination(significance, cloud.mask, one_in=config.kept_one_in)
        kept.append(Kept(rows, PointCloud(cloud.points[rows], mask), features[rows]))
    *_, last = _steps(variables, *kept, config=config, train=False)[0]
    every = clouds[0].mask.astype(clouds[0].points.dtype)
    plain = pair.registration(last.transform, *clouds, every, scores=(last.scores, last.validity))
    rows = jnp.where(kept[0].cloud.mask, kept[0].rows, clouds[0].mask.shape[0])
    matched = kept[1].cloud.points[last.columns]
    confidence = jnp.zeros_like(plain.confidence).at[rows].set(last.weights, mode="drop")
    return plain._replace(
        confidence=jnp.where(plain.valid, confidence, 0),
        correspondences=plain.correspondences.at[rows].set(matched, mode="drop"),
    )


def init_variables(key: PRNGKeyArray, config: IDAMConfig) -> Variables:
    """Random initial `params` and `batch_stats`."""
    points, mask = jnp.ones((2, 3), jnp.float32), jnp.ones(2, bool)
    features = jnp.ones((2, config.channels[-1]), jnp.float32)
    kept = Kept(jnp.zeros(2, jnp.int32), PointCloud(points, mask), features)
    graph = points, jnp.zeros((2, 1), jnp.int32), mask
    inputs = {"graph": graph, "significance": (features, mask)}
    return state_dict.joined(
        {
            name: network.init(
                jax.random.fold_in(key, i), *inputs.get(name, (kept, kept)), train=False
            )
            for i, (name, network) in enumerate(_networks(config).items())
        }
    )


def _networks(config: IDAMConfig) -> dict[str, Any]:
    networks: dict[str, Any] = {
        "graph": _GraphNetwork(config.channels, config.bn_momentum),
        "significance": _Block((*config.significance, 1), config.bn_momentum),
    }
    for i in range(config.iterations):
        networks[f"similarity_{i}"] = _SimilarityNetwork(config.hidden, config.bn_momentum)
    return networks


def _described(variables: Variables, cloud: PointCloud, config: IDAMConfig, *, train: bool):
    """Features and significance of every point, and the variables with updated statistics.

    How much a point is worth keeping is what its scores' negative entropy is expected to be.
    """
    networks = _networks(config)
    itself = jnp.arange(cloud.mask.shape[0], dtype=jnp.int32)[:, None]
    neighbors = jnp.concatenate([itself, knn(cloud.points, config.k - 1, cloud.mask)], axis=1)
    inputs = cloud.points, neighbors, cloud.mask
    features, variables = run_network(networks["graph"], "graph", variables, *inputs, train=train)
    significance, variables = run_network(
        networks["significance"], "significance", variables, features, cloud.mask, train=train
    )
    return features, significance[:, 0], variables


def hard_elimination(
    significance: Float[Array, "n"], mask: Bool[Array, "n"], *, one_in: int
) -> tuple[Int[Array, "k"], Bool[Array, "k"]]:
    """Rows of the most significant points, one in `one_in` of the valid ones, and which rows count."""
    size = max(mask.shape[0] // one_in, 1)
    score = jnp.where(mask, jax.lax.stop_gradient(significance), -jnp.inf)
    rows = jax.lax.optimization_barrier(jax.lax.top_k(score, size)[1])
    valid = jnp.sum(mask, dtype=jnp.int32)
    count = jnp.where(valid > 0, jnp.maximum(valid // one_in, 1), 0)
    return rows, jnp.arange(size, dtype=jnp.int32) < count


def _steps(variables: Variables, source: Kept, reference: Kept, *, config, train: bool):
    """All steps, each with networks of its own, and the variables with updated statistics."""
    networks, steps = _networks(config), []
    start = rigid.identity(source.cloud.points.dtype)
    for i in range(config.iterations):
        moved = source.cloud._replace(points=rigid.apply(start, source.cloud.points))
        inputs = source._replace(cloud=moved), reference
        name = f"similarity_{i}"
        (scores, validity), variables = run_network(
            networks[name], name, variables, *inputs, train=train
        )
        columns = jnp.argmax(jnp.where(reference.cloud.mask[None, :], scores, -jnp.inf), axis=1)
        weights = hybrid_elimination(validity, source.cloud.mask & jnp.any(reference.cloud.mask))
        motion = centred_procrustes(moved, reference.cloud.points[columns], weights)
        start = rigid.compose(motion, start)
        steps.append(Step(start, scores, columns, validity, weights))
        start = jax.lax.stop_gradient(start)
    return steps, variables


def hybrid_elimination(validity: Float[Array, "k"], mask: Bool[Array, "k"]) -> Float[Array, "k"]:
    """The weights of the correspondences: their validity, and zero below the (lower) median."""
    ordered = jnp.sort(jnp.where(mask, jax.lax.stop_gradient(validity), jnp.inf))
    middle = ordered[jnp.maximum(jnp.sum(mask, dtype=jnp.int32) - 1, 0) // 2]
    return jnp.where(mask & (validity >= middle), validity, 0)


def centred_procrustes(
    source: PointCloud, copy: Float[Array, "k 3"], weights: Float[Array, "k"]
) -> RigidTransform:
    """The pose of weighted correspondences as IDAM solves it.

    The rotation is that of weighted Procrustes about the *unweighted* centroids of valid points; the
    translation is the weighted mean of ``copy - R source``.
    """

    def means(share: Float[Array, "k"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        share = (share / jnp.where(jnp.sum(share) > 0, jnp.sum(share), 1))[None, :]
        of_both = [jnp.matmul(share, x, precision=Precision.HIGHEST) for x in (source.points, copy)]
        return of_both[0][0], of_both[1][0]

    centroids = means(source.mask.astype(copy.dtype))
    moving = (source.points - centroids[0][None, :]) * weights[:, None]
    covariance = jnp.matmul(moving.T, copy - centroids[1][None, :], precision=Precision.HIGHEST)
    rotation = special_procrustes(covariance)
    of_source, of_copy = means(jnp.where(source.mask, weights, 0))
    turned = jnp.matmul(rotation, of_source, precision=Precision.HIGHEST)
    return RigidTransform(rotation, of_copy - turned)


def loss(
    variables: Variables,
    source: PointCloud,
    reference: PointCloud,
    truth: RigidTransform,
    *,
    config,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]], Variables]:
    """The loss of a pair, its terms, and the variables; supervised: it sees the pose.

    In training, hard elimination takes half of its points from those that have a partner within
    `match_distance` at the true pose and half from the others, in the order of the rows (which is
    random), and of the reference the points nearest to these. The terms are sums over the steps:

    * `matching`: cross-entropy of the scores of the rows that have a partner;
    * `validity`: binary cross-entropy with whether the most similar point is within that distance;
    * `significance`, of the first step: mean ``(s - sum_j p_j log p_j)^2`` of points of both clouds,
      as the paper has it. (The authors' program puts s through a sigmoid first, whose values a
      negative entropy never has.)
    """
    clouds = pair.clouds(source.points, reference.points, source.mask, reference.mask)
    source, reference = clouds
    target = rigid.apply(truth, source.points)
    nearest = nearest_in(target, reference.points, reference.mask)
    apart = safe_norm(target - reference.points[nearest])
    partner = (apart < config.match_distance) & source.mask
    rows = _half_of_each(partner, source.mask, config.kept_one_in)
    described = []
    for cloud in clouds:
        *found, variables = _described(variables, cloud, config, train=True)
        described.append(found)
    kept = [
        Kept(chosen, PointCloud(cloud.points[chosen], mask[rows]), features[chosen])
        for chosen, cloud, (features, _), mask in zip(
            (rows, nearest[rows]), clouds, described, (source.mask, source.mask), strict=True
        )
    ]
    steps, variables = _steps(variables, *kept, config=config, train=True)
    valid = kept[0].cloud.mask

    def mean(values, mask):
        total = jnp.sum(jnp.where(mask, values, 0))
        return total / jnp.maximum(jnp.sum(mask, dtype=values.dtype), 1)

    zero = jnp.zeros((), source.points.dtype)
    matching, validity, significance = zero, zero, zero
    for step in steps:
        logs = _log_softmax(step.scores, valid, axis=1)
        matching += mean(-jnp.diagonal(logs), partner[rows])
        found = kept[1].cloud.points[step.columns]
        right = safe_norm(target[rows] - found) < config.match_distance
        chance = jnp.clip(step.validity, 1e-6, 1 - 1e-6)
        validity += mean(-jnp.log(jnp.where(right, chance, 1 - chance)), valid)
    for axis, chosen, (_, given) in zip((1, 0), (rows, nearest[rows]), described, strict=True):
        logs = jax.lax.stop_gradient(_log_softmax(steps[0].scores, valid, axis=axis))
        entropy = jnp.sum(jnp.exp(logs) * logs, axis=axis)
        significance += mean((given[chosen] - entropy) ** 2, valid)
    terms = {"matching": matching, "validity": validity, "significance": significance}
    return matching + validity + significance, terms, variables


def _half_of_each(partner: Bool[Array, "n"], mask: Bool[Array, "n"], one_in: int):
    """Rows of as many points with a partner as without; more of one kind if the other runs out."""
    size = max(partner.shape[0] // one_in, 2)
    first = jnp.argsort(~partner, stable=True)[: size // 2]
    second = jnp.argsort(partner | ~mask, stable=True)[: size - size // 2]
    return jnp.concatenate([first, second])


def _log_softmax(scores: Float[Array, "k l"], valid: Bool[Array, "l"], *, axis: int):
    """Over valid entries; of the others a finite logarithm, whose exponential is next to nothing."""
    mask = valid[None, :] if axis == 1 else valid[:, None]
    logs = jax.nn.log_softmax(jnp.where(mask, scores, -_LARGEST_SCORE * 10), axis=axis)
    return jnp.maximum(logs, _SMALLEST_LOG)


def load_weights(path: str | Path) -> tuple[Variables, Config]:
    """Load weights of the authors' program, an ``.npz`` of its state dict; PyTorch is not needed.

    Those of its graph network; with FPFH features it has none. Widths and the number of steps are
    those of the arrays, the rest of the configuration is the default.

    Raises:
      ValueError: the file is missing or not an ``.npz``, or an array of the network is missing or has
        another shape.
    """
    variables, config = state_dict.load(path, "IDAM", _read_state_dict, init_variables)
    return variables, Config(network="idam", idam=config)


def _read_state_dict(arrays: state_dict.Arrays) -> tuple[Variables, IDAMConfig]:
    def block(root: str) -> Variables:
        last = state_dict.count(arrays, f"{root}.conv.") - 1
        layers = [(f"{root}.conv.{i}.conv", f"{root}.conv.{i}.bn") for i in range(last)]
        return state_dict.dense_and_norm(arrays, layers, last=f"{root}.conv.{last}")

    depth, edges, points = state_dict.count(arrays, "emb_nn.propogate", first=1), {}, {}
    for i in range(depth):
        root = f"emb_nn.propogate{i + 1}"  # They are spelt so.
        edges[f"edges_{i}"] = block(f"{root}.conv2d")
        points[f"points_{i}"] = state_dict.dense(arrays, f"{root}.conv1d.conv.0")
    graph = state_dict.joined(edges)
    graph["params"] |= points
    significance = block("significance_fc")
    networks = {"graph": graph, "significance": significance}
    steps = state_dict.count(arrays, "sim_mat_conv1.")
    parts = {"pairs": "sim_mat_conv1", "scores": "sim_mat_conv2", "validity": "weight_fc"}
    for i in range(steps):
        networks[f"similarity_{i}"] = state_dict.joined(
            {ours: block(f"{theirs}.{i}") for ours, theirs in parts.items()}
        )
    hidden = len(significance["batch_stats"])
    return state_dict.joined(networks), IDAMConfig(
        channels=tuple(points[f"points_{i}"]["kernel"].shape[1] for i in range(depth)),
        significance=tuple(
            significance["params"][f"Dense_{i}"]["kernel"].shape[1] for i in range(hidden)
        ),
        hidden=networks["similarity_0"]["params"]["pairs"]["Dense_0"]["kernel"].shape[1],
        iterations=steps,
    )
