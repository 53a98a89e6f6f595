"""The network: one registration step (Eq. 3 to 13 of the paper), and its iteration.

``variables = {"params": ..., "batch_stats": ...}`` is one plain dict, each with the keys `features`
and `inliers`. Everything here is a pure function of one pair; use `vmap` for a batch.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxreg._xla import on_any_mesh, varying_like
from jaxreg.batching import one_at_a_time
from jaxreg.config import Config, ModelConfig, check_options, model_config
from jaxreg.geometry import arguments, rigid
from jaxreg.geometry.neighbors import knn, without_padding
from jaxreg.geometry.numerics import all_finite, safe_sqrt
from jaxreg.geometry.procrustes import robust_procrustes
from jaxreg.network import matching_blocks
from jaxreg.network.features import DGCNN, STATISTICS, relative_neighbors
from jaxreg.network.inliers import InlierNetwork, PredecessorInlierNetwork, select_inliers
from jaxreg.network.invariants import geometric_structure
from jaxreg.network.matching import (
    KEPT,
    Incidence,
    Matches,
    feature_distance,
    incidence,
    match,
    matching_maps,
    neighborhood_sum,
    squared_feature_distance,
)
from jaxreg.network.matching_blocks import Branch, match_in_blocks
from jaxreg.network.run import Variables as Variables
from jaxreg.network.run import run_network
from jaxreg.types import PointCloud, Registration, RigidTransform

_MATCHES = "matches"
"""Name of the result of the matching, which a gradient stores."""


class Graph(NamedTuple):
    """The neighbourhoods of one cloud; a rigid motion does not change them.

    `neighbors` serves features and inliers, `matching` the neighbourhood sum, `nearest` is the graph
    with the 1-NN alone. `own` is the graph of the 1-NN cloud itself, if the configuration asks for it.
    """

    neighbors: Int[Array, "n k"]
    matching: Incidence
    nearest: Incidence
    own: "Graph | None" = None


class Step(NamedTuple):
    """One registration step: all that losses and pictures read.

    `source` is the source before the step, `moved` after it, `transform` the motion between them.
    `inliers` are the indices of the N_c most confident points.
    """

    source: Float[Array, "n 3"]
    moved: Float[Array, "n 3"]
    transform: RigidTransform
    matches: Matches
    confidence: Float[Array, "n"]
    inliers: Int[Array, "n_c"]


def neighborhood_graph(cloud: PointCloud, config: ModelConfig, *, own: bool | None = None) -> Graph:
    """The graph of a cloud, computed once and kept over all iterations.

    Raises:
      ValueError: K is not smaller than the number of points.
    """
    nearest_first = knn(cloud.points, max(config.k, config.k_matching), cloud.mask)
    neighbors = nearest_first[:, : config.k]
    if config.include_self:
        itself = jnp.arange(cloud.points.shape[0], dtype=neighbors.dtype)[:, None]
        neighbors = jnp.concatenate([itself, neighbors], axis=1)
    matching, nearest = (incidence(nearest_first[:, :k]) for k in (config.k_matching, 1))
    nested = None
    if config.one_nn == "own" if own is None else own:
        nearest_points = cloud.points[nearest_first[:, 0]]
        nested = neighborhood_graph(PointCloud(nearest_points, cloud.mask), config, own=False)
    return Graph(neighbors, matching, nearest, nested)


@functools.partial(jax.jit, static_argnames="config")
def init_variables(key: PRNGKeyArray, config: ModelConfig) -> Variables:
    """Random initial `params` and `batch_stats` for the network of `config`."""
    features, inliers = _networks(config)
    k = config.k + config.include_self
    # Float32 whatever the process' default: a run must load in any other process.
    cloud, mask = jnp.ones((k + 1, 3), jnp.float32), jnp.ones(k + 1, bool)
    neighbors = jnp.zeros((k + 1, k), jnp.int32)
    structure = _structure(cloud, neighbors, config)
    first = features.init(
        jax.random.fold_in(key, 0), relative_neighbors(cloud, neighbors), mask, train=False
    )
    second = inliers.init(jax.random.fold_in(key, 1), structure, structure, mask, train=False)
    return {
        kind: {"features": first[kind], "inliers": second[kind]}
        for kind in ("params", "batch_stats")
    }


def _networks(config: ModelConfig):
    inliers = InlierNetwork if config.inlier_network == "paper" else PredecessorInlierNetwork
    return (
        DGCNN(config.channels, config.width, config.bn_momentum),
        inliers(config.inlier_width, config.bn_momentum),
    )


def _structure(points, neighbors, config: ModelConfig):
    return geometric_structure(points, neighbors, edge=config.edge, angles=config.angles)


def point_features(
    variables: Variables,
    points: Float[Array, "n 3"],
    graph: Graph,
    mask: Bool[Array, "n"],
    *,
    config: ModelConfig,
    train: bool = False,
) -> tuple[Float[Array, "n c"], Variables]:
    """F_P of Eq. 3 (DGCNN over `graph`) and the variables with updated statistics."""
    network, _ = _networks(config)
    edges = relative_neighbors(points, graph.neighbors)
    return run_network(network, "features", variables, edges, mask, train=train)


def _both_features(variables, points, graph, mask, config, train):
    """Features of a cloud and, if asked for, of its 1-NN cloud as a separate cloud."""
    features, variables = point_features(variables, points, graph, mask, config=config, train=train)
    if graph.own is None:
        return (features, None), variables
    nearest, variables = point_features(
        variables, points[graph.nearest.idx[:, 0]], graph.own, mask, config=config, train=train
    )
    return (features, nearest), variables


def _match(features, source_graph, reference_graph, reference, config: ModelConfig, train: bool):
    def match_pair(inputs, constants):
        (source_features, reference_features, points), (source, reference, mask) = inputs, constants
        cloud = PointCloud(points, mask)
        return _match_pair(source_features, reference_features, source, reference, cloud, config)

    run = one_at_a_time(match_pair) if train else match_pair
    matches = run((*features, reference.points), (source_graph, reference_graph, reference.mask))
    return jax.tree.map(lambda x: checkpoint_name(x, _MATCHES), matches)


def _match_pair(
    source_features, reference_features, source_graph, reference_graph, reference, config
) -> Matches:
    if source_features[0].shape[0] * reference_features[0].shape[0] > matching_blocks.LARGEST:
        features, graphs = (source_features, reference_features), (source_graph, reference_graph)
        branches = _branches(features, graphs, config)
        return match_in_blocks(branches, reference.points, alpha=config.alpha, valid=reference.mask)
    squared = squared_feature_distance(source_features[0], reference_features[0])
    squared = checkpoint_name(squared, KEPT[0])
    distance = safe_sqrt(squared)
    nearest_distance, nearest_graphs = None, None
    if config.one_nn == "own":
        nearest_distance = feature_distance(source_features[1], reference_features[1])
        nearest_graphs = (source_graph.own.matching, reference_graph.own.matching)
    elif config.one_nn == "gather":
        # The feature of the 1-NN point is that of the same point in the input cloud. The root comes
        # last, because XLA would take it again, number by number, for each entry that is gathered.
        nearest = (source_graph.nearest, reference_graph.nearest)
        nearest_distance = safe_sqrt(neighborhood_sum(squared, *nearest))
    elif config.one_nn == "self":
        nearest_distance = distance
    maps = matching_maps(
        distance,
        nearest_distance,
        source_graph.matching,
        reference_graph.matching,
        alpha=config.alpha,
        nearest_graphs=nearest_graphs,
        valid=reference.mask,
    )
    return match(maps.dual, maps.final, reference.points)


def _branches(features, graphs, config: ModelConfig) -> tuple[Branch, ...]:
    """The neighbourhoods that are matched: that of the points, and that of their nearest points."""
    matching = [graph.matching for graph in graphs]
    first = Branch(*(both[0] for both in features), *matching)
    if config.one_nn == "none":
        return (first,)
    if config.one_nn == "own":
        own = [graph.own.matching for graph in graphs]
        return first, Branch(*(both[1] for both in features), *own)
    if config.one_nn == "self":
        return first, first
    pairs = zip(features, graphs, strict=True)
    return first, Branch(*(both[0][graph.nearest.idx[:, 0]] for both, graph in pairs), *matching)


def _solve(source, copy, confidence, inliers, mask, config: ModelConfig) -> RigidTransform:
    weights = jnp.where(mask, confidence, 0)
    if config.svd == "top":
        source, copy, weights = source[inliers], copy[inliers], weights[inliers]
    return robust_procrustes(source, copy, weights, rounds=config.robust_rounds)


def iterate(
    variables: Variables,
    source: PointCloud,
    reference: PointCloud,
    *,
    config: ModelConfig,
    train: bool = False,
    observe: Callable[[Step, Graph], Any] = lambda step, graph: None,
) -> tuple[RigidTransform, Any, Variables]:
    """N_l registration steps.

    With `train`, BatchNorm takes its statistics over the `vmap` axis `features.BATCH_AXIS`, and the
    matching goes through the batch pair by pair.

    Returns the transform from source to reference (the composition of the steps), what `observe`
    returned for each step and the source's graph, stacked, and the variables with updated statistics.

    Raises:
      ValueError: a shape, a dtype or a setting is wrong, or `train` without the `vmap` axis.
    """
    arguments.settings("config", config, ModelConfig)
    check_options("model", config)
    source, reference = _checked(source, "source"), _checked(reference, "reference")
    arguments.one_dtype(source=source.points, reference=reference.points)
    variables = _in_dtype(variables, source.points.dtype, train)
    usable = source.mask & jnp.any(reference.mask)
    source_graph = neighborhood_graph(source, config)
    reference_graph = neighborhood_graph(reference, config)
    reference_features, variables = _both_features(
        variables, reference.points, reference_graph, reference.mask, config, train
    )
    _, network = _networks(config)

    def step(carry, _):
        total, variables = carry
        # From the original points every time, so rounding does not add up over the steps.
        points = rigid.apply(total, source.points)
        features, variables = _both_features(
            variables, points, source_graph, source.mask, config, train
        )
        both = (features, reference_features)
        matches = _match(both, source_graph, reference_graph, reference, config, train)
        structures = [_structure(x, source_graph.neighbors, config) for x in (points, matches.copy)]
        confidence, variables = run_network(
            network, "inliers", variables, *structures, source.mask, train=train
        )
        inliers = select_inliers(confidence, config.n_inliers, source.mask)
        motion = _solve(points, matches.copy, confidence, inliers, usable, config)
        moved = rigid.apply(motion, points)
        seen = observe(Step(points, moved, motion, matches, confidence, inliers), source_graph)
        return (rigid.compose(motion, total), variables), seen

    start = rigid.identity(source.points.dtype)
    start = (jax.tree.map(lambda x: varying_like(x, source.points[0, 0]), start), variables)
    # A step is recomputed in the backward pass, except its matches and the two maps that cost most:
    # cheaper than writing and reading a dozen (n, m) arrays per step, with less than half of the
    # memory. In training `one_at_a_time` recomputes the maps, too, and the statistics of BatchNorm are
    # kept: many devices would have to sum them up again.
    kept = jax.checkpoint_policies.save_only_these_names(
        _MATCHES, *((STATISTICS,) if train else KEPT)
    )
    step = jax.checkpoint(step, prevent_cse=False, policy=kept)
    (transform, variables), seen = jax.lax.scan(step, start, length=config.iterations)
    return transform, seen, variables


def _checked(cloud: PointCloud, name: str) -> PointCloud:
    """The cloud with its padding at zero."""
    points = arguments.cloud(name, cloud.points)
    mask = arguments.mask(f"{name}_mask", cloud.mask, points.shape[0])
    assert mask is not None  # `arguments.mask` gives back what it is given
    return PointCloud(without_padding(points, mask), mask)


def _whole(name: str, points: Any, mask: Any) -> tuple[PointCloud, Bool[Array, ""]]:
    """A cloud and its mask, and whether there is a valid point and all of them are finite.

    Without padding the mask is a constant, which XLA folds: that saves a third of the time. A cloud
    that is not finite is then one of zeros.
    """
    points = arguments.cloud(name, points)
    usable = arguments.usable(f"{name}_mask", points, mask)
    if mask is not None:
        return PointCloud(points, usable), jnp.any(usable)
    points = jnp.where(usable[:, None], points, 0)
    return PointCloud(points, jnp.ones(points.shape[0], bool)), usable[0]


def _in_dtype(variables: Variables, dtype: Any, train: bool) -> Variables:
    """The weights in the precision of the clouds; those that training updates stay as they are."""
    if not {"params", "batch_stats"} <= set(variables):
        raise ValueError(
            f"variables have the keys {sorted(variables)}: give both params and batch_stats, of "
            "the network that config describes, as jaxreg.load_pretrained returns them."
        )
    cast = {"params": variables["params"]} if train else variables
    return variables | jax.tree.map(lambda x: jnp.asarray(x, dtype), dict(cast))


@on_any_mesh
def register_pair(
    variables: Variables,
    source: Float[Array, "n 3"],
    reference: Float[Array, "m 3"],
    *,
    config: Config | ModelConfig,
    source_mask: Bool[Array, "n"] | None = None,
    reference_mask: Bool[Array, "m"] | None = None,
) -> Registration:
    """Register two clouds with a trained network; pure: jit, vmap and differentiate it.

    `config` describes the network; in a whole configuration only `network` and `model` are read.

    Clouds should have the scale that the weights were trained on (unit sphere for ModelNet40). Rows
    outside a mask are padding and have no effect, even if they are NaN. With no valid point in a
    cloud, with one that is not finite, or with weights that diverged, `valid` is False and the
    transform is the identity. The weights are used in the dtype of the clouds.

    Raises:
      ValueError: a cloud is not ``(n, 3)`` of float32 or float64; a mask is not ``(n,)`` of bools; K
        is not smaller than a cloud; N_c exceeds the source; `variables` or `config` are no network's.
    """
    moving, source_usable = _whole("source", source, source_mask)
    fixed, reference_usable = _whole("reference", reference, reference_mask)
    transform, (confidence, copies), _ = iterate(
        variables,
        moving,
        fixed,
        config=model_config(config),
        observe=lambda step, graph: (step.confidence, step.matches.copy),
    )
    valid = source_usable & reference_usable
    confidence = jnp.where(moving.mask, confidence[-1], 0)
    # With weights that diverged all is NaN, or the identity for want of any weight.
    valid &= all_finite((*transform, confidence, without_padding(copies[-1], moving.mask)))
    transform = rigid.identity_unless(valid, transform)
    confidence = jnp.where(valid, confidence, 0)
    matrix = rigid.to_matrix(transform)
    return Registration(*transform, matrix, confidence, copies[-1], valid)
