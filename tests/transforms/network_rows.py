"""Rows of the networks and of the whole pipeline of one pair."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.config import Config, LossConfig, ModelConfig
from jaxreg.network import features, inliers, losses, model
from jaxreg.types import PointCloud
from tests.transforms.rows import K, N, Row, every, points

# All N points are inliers, since the choice among them jumps.
SMALL = ModelConfig(
    k=K, k_matching=K, channels=(3, 4), width=4, inlier_width=2, n_inliers=8, iterations=2
)
RNG = np.random.default_rng(1)


def apply_network(network):
    def run(variables, *inputs):
        return network.apply(variables, *inputs, train=False)

    return run


def draw_variables(network, *inputs):
    """Random variables of a network for inputs of these shapes, in float64."""
    inputs = [np.float32(x) if x.dtype == np.float64 else x for x in inputs]
    shapes = jax.eval_shape(lambda *x: network.init(jax.random.key(0), *x, train=False), *inputs)
    return positive_statistics(jax.tree.map(lambda x: RNG.normal(0, 0.5, x.shape), shapes))


def positive_statistics(variables):
    return variables | {
        "batch_stats": jax.tree.map(lambda x: 0.5 + np.abs(x), variables["batch_stats"])
    }


def network_rows():
    mask, edges = np.ones(N, bool), RNG.normal(size=(N, K, 3))
    of_edges = RNG.normal(size=(2, N, K, 5))
    still = np.zeros((N, K, 3))
    rows = {}
    norm = features.BatchNorm(0.9)
    values = RNG.normal(size=(N, 4))
    rows["network.features.BatchNorm"] = (norm, (values, mask), ((np.zeros((N, 4)), mask),))
    dgcnn = features.DGCNN((3, 4), 4, 0.9)
    rows["network.features.DGCNN"] = (dgcnn, (edges, mask), ((still, mask),))
    for name in ("InlierNetwork", "PredecessorInlierNetwork"):
        network = getattr(inliers, name)(2, 0.9)
        # Equal structures: the confidence is 1 - tanh|0|, which has no derivative.
        equal = (of_edges[0], of_edges[0], mask)
        rows[f"network.inliers.{name}"] = (network, (*of_edges, mask), (equal,))
    return {
        name: Row(
            apply_network(network),
            (draw_variables(network, *generic), *generic),
            tuple((draw_variables(network, *inputs), *inputs) for inputs in degenerate),
            loose=True,
        )
        for name, (network, generic, degenerate) in rows.items()
    }


def model_variables():
    shapes = jax.eval_shape(lambda: model.init_variables(jax.random.key(0), SMALL))
    return positive_statistics(jax.tree_util.tree_map_with_path(draw_leaf, shapes))


def draw_leaf(path, leaf):
    """A random parameter; biases above zero, so that few features are cut off."""
    return RNG.normal(1.0 if "bias" in jax.tree_util.keystr(path) else 0.0, 0.5, leaf.shape)


def register(variables, source, reference):
    return model.register_pair(variables, source, reference, config=Config(model=SMALL))


def iterated(variables, source, reference):
    transform, seen, _ = model.iterate(
        variables,
        everything_traced(source),
        everything_traced(reference),
        config=SMALL,
        observe=lambda step, graph: (step.matches, step.confidence),
    )
    return transform, seen


def everything_traced(x):
    return PointCloud(x, jnp.ones(x.shape[0], bool))


def cloud_features(variables, x):
    graph = model.neighborhood_graph(everything_traced(x), SMALL)
    mask = jnp.ones(x.shape[0], bool)
    return model.point_features(variables, x, graph, mask, config=SMALL)[0]


def total_of_a_step(variables, source, reference):
    """`step_losses` on what a step of the network hands to it."""

    def observe(step, graph):
        return losses.step_losses(
            step,
            graph,
            jnp.ones(source.shape[0], bool),
            everything_traced(reference),
            config=LossConfig(),
            model=SMALL,
        )

    clouds = everything_traced(source), everything_traced(reference)
    return model.iterate(variables, *clouds, config=SMALL, observe=observe)[1]


def network_and_model_rows() -> dict[str, Row]:
    variables = model_variables()
    source = points()
    near = source @ Rotation.from_euler("z", 0.2).as_matrix().T + 0.1
    pairs = every(lambda x: (variables, x, x))
    return {
        **network_rows(),
        "network.model.neighborhood_graph": Row(
            lambda x: model.neighborhood_graph(everything_traced(x), SMALL),
            (points(),),
            every(lambda x: (x,)),
            smooth=False,
        ),
        "network.model.init_variables": Row(
            lambda: model.init_variables(jax.random.key(3), SMALL), (), smooth=False, loose=True
        ),
        "network.model.point_features": Row(
            cloud_features, (variables, source), every(lambda x: (variables, x)), loose=True
        ),
        "network.model.iterate": Row(
            iterated, (variables, source, near), pairs, loose=True, kinks=True, parts=True
        ),
        "network.model.register_pair": Row(
            register, (variables, source, near), pairs, loose=True, kinks=True
        ),
        "network.losses.step_losses": Row(
            total_of_a_step, (variables, source, near), pairs, loose=True, kinks=True, parts=True
        ),
    }
