"""Every public function of the numerical rooms under every transform of JAX.

The table below names each one with generic and degenerate inputs. For every row: jit equals eager,
vmap equals a loop, forward mode equals reverse mode, both are finite, and on generic inputs they equal
central differences in float64. A public function that is not in the table fails the test.
"""

import dataclasses
import functools
import importlib
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg import features as feature_room
from jaxreg import (
    inliers,
    invariants,
    losses,
    matching,
    model,
    neighbors,
    numerics,
    procrustes,
    rigid,
)
from jaxreg.config import Config, LossConfig, ModelConfig
from jaxreg.types import PointCloud, RigidTransform

pytestmark = [pytest.mark.slow]

ROOMS = (
    "numerics",
    "rigid",
    "neighbors",
    "procrustes",
    "features",
    "matching",
    "invariants",
    "inliers",
    "model",
    "losses",
)
N, K = 8, 3
SMALL = ModelConfig(
    k=K, k_matching=K, channels=(3, 4), width=4, inlier_width=2, n_inliers=8, iterations=2
)
# All N points are inliers, since the choice among them jumps.
RNG = np.random.default_rng(0)


@dataclasses.dataclass(frozen=True)
class Row:
    """A function of arrays, inputs that are generic, and inputs where it could break.

    `smooth` is False for results that jump (an index, the nearest point), which are compared with no
    differences. `loose` lets Flax promote dtypes. `kinks` is True for the whole network: on a line or
    a grid its moved points are parallel up to rounding, which may differ between the two modes and
    puts them on different sides of a kink.
    """

    function: Callable
    generic: tuple
    degenerate: tuple[tuple, ...] = ()
    smooth: bool = True
    loose: bool = False
    kinks: bool = False


def points(n=N):
    return RNG.normal(size=(n, 3))


def pose():
    return RigidTransform(Rotation.random(rng=RNG).as_matrix(), RNG.normal(size=3))


def nowhere():
    return RigidTransform(np.zeros((3, 3)), np.zeros(3))


def neighbor_graph(n=N):
    return np.stack([(np.arange(n) + r + 1) % n for r in range(K)], axis=1).astype(np.int32)


def grid():
    return np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])


def clouds_that_break():
    return {
        "one place": np.ones((N, 3)),
        "line": np.outer(np.arange(N, dtype=float), [1.0, 2.0, 3.0]),
        "plane": points() * [1.0, 1.0, 0.0],
        "duplicates": np.repeat(points(N // 2), 2, axis=0),
        "cube": grid(),
        "origin": np.zeros((N, 3)),
    }


def every(function):
    """Rows of degenerate inputs from a function of one degenerate cloud."""
    return tuple(function(cloud) for cloud in clouds_that_break().values())


def everything(x):
    return PointCloud(x, np.ones(len(x), bool))


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
    norm = feature_room.BatchNorm(0.9)
    values = RNG.normal(size=(N, 4))
    rows["features.BatchNorm"] = (norm, (values, mask), ((np.zeros((N, 4)), mask),))
    dgcnn = feature_room.DGCNN((3, 4), 4, 0.9)
    rows["features.DGCNN"] = (dgcnn, (edges, mask), ((still, mask),))
    for name in ("InlierNetwork", "PredecessorInlierNetwork"):
        network = getattr(inliers, name)(2, 0.9)
        # Equal structures: the confidence is 1 - tanh|0|, which has no derivative.
        equal = (of_edges[0], of_edges[0], mask)
        rows[f"inliers.{name}"] = (network, (*of_edges, mask), (equal,))
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


def maps_of(distance, nearest, source_idx, reference_idx):
    graphs = matching.incidence(source_idx), matching.incidence(reference_idx)
    return matching.matching_maps(distance, nearest, *graphs, alpha=0.7)


def core_rows() -> dict[str, Row]:
    idx, inlier_idx = neighbor_graph(), np.array([1, 4, 5, 0], np.int32)
    valid, mask = np.ones(4, bool), np.ones(N, bool)
    part = np.arange(N) < 5
    u = np.array([0.5, -1.0, 2.0])
    zero3 = np.zeros(3)
    scores = RNG.uniform(0.1, 1, (N, N))
    huber = functools.partial(losses.huber, beta=0.5)
    structure = functools.partial(invariants.geometric_structure, edge="vector", angles="all")
    lengths = functools.partial(invariants.edges, kind="length")
    gc = functools.partial(losses.global_consistency, beta=0.01)
    gs = functools.partial(losses.geometric_consistency, config=SMALL)
    return {
        "numerics.safe_sqrt": Row(
            numerics.safe_sqrt, (RNG.uniform(1, 2, 4),), ((np.array([0.0, -1]),),)
        ),
        "numerics.safe_norm": Row(numerics.safe_norm, (points(),), ((np.zeros((2, 3)),),)),
        "numerics.included_angle": Row(
            numerics.included_angle,
            (points(), points()),
            ((u, u), (u, -u), (u, zero3), (zero3, u), (zero3, zero3), (u, 1e-9 * u)),
        ),
        "rigid.identity": Row(lambda: rigid.identity(jnp.float64), ()),
        "rigid.apply": Row(rigid.apply, (pose(), points()), ((nowhere(), np.zeros((N, 3))),)),
        "rigid.compose": Row(rigid.compose, (pose(), pose()), ((nowhere(), nowhere()),)),
        "rigid.inverse": Row(rigid.inverse, (pose(),), ((nowhere(),),)),
        "rigid.to_matrix": Row(rigid.to_matrix, (pose(),)),
        "rigid.from_matrix": Row(rigid.from_matrix, (RNG.normal(size=(4, 4)),)),
        "neighbors.squared_distances": Row(
            neighbors.squared_distances, (points(), points(5)), every(lambda x: (x, x))
        ),
        "neighbors.without_padding": Row(
            neighbors.without_padding,
            (points(), part),
            ((np.where(part[:, None], np.ones(3), np.nan), part),),
        ),
        "neighbors.knn": Row(
            lambda x: neighbors.knn(x, K), (points(),), every(lambda x: (x,)), smooth=False
        ),
        "neighbors.nearest_neighbor": Row(
            neighbors.nearest_neighbor, (points(),), every(lambda x: (x,)), smooth=False
        ),
        "neighbors.nearest_in": Row(
            neighbors.nearest_in, (points(), points(5)), every(lambda x: (x, x)), smooth=False
        ),
        "procrustes.weighted_procrustes": Row(
            procrustes.weighted_procrustes,
            (points(), points(), RNG.uniform(0.5, 1, N)),
            (
                *every(lambda x: (x, x, np.ones(N))),
                (points(), points(), np.zeros(N)),
                (points(), points(), np.eye(N)[2]),
                (points(), points(), -np.ones(N)),
                (grid(), grid() * [1.0, 1.0, -1.0], np.ones(N)),
            ),
        ),
        "procrustes.special_procrustes": Row(
            procrustes.special_procrustes,
            (RNG.normal(size=(3, 3)),),
            ((np.eye(3),), (np.zeros((3, 3)),), (-np.eye(3),), (np.diag([1.0, 1, 0]),)),
        ),
        "features.relative_neighbors": Row(
            feature_room.relative_neighbors, (points(), idx), every(lambda x: (x, idx))
        ),
        "matching.feature_distance": Row(
            matching.feature_distance,
            (RNG.normal(size=(N, 4)), RNG.normal(size=(5, 4))),
            (
                (np.ones((N, 4)), np.ones((5, 4))),
                (np.eye(N, 4), np.eye(N, 4)),
                (np.zeros((N, 4)), np.zeros((5, 4))),
            ),
        ),
        "matching.matching_scores": Row(
            matching.matching_scores,
            (scores, part),
            ((np.zeros((N, N)), part), (scores, np.zeros(N, bool)), (1e8 * scores, part)),
        ),
        "matching.incidence": Row(
            matching.incidence, (idx,), ((np.zeros((N, K), np.int32),),), smooth=False
        ),
        "matching.neighborhood_sum": Row(
            matching.neighborhood_sum,
            (scores, idx, idx[::-1]),
            ((scores, np.zeros((N, K), np.int32), idx),),
        ),
        "matching.final_distance": Row(
            functools.partial(matching.final_distance, alpha=0.7),
            (scores, scores.T),
            ((np.zeros((N, N)), np.zeros((N, N))),),
        ),
        "matching.matching_maps": Row(
            maps_of, (scores, scores.T, idx, idx), ((np.zeros((N, N)), np.zeros((N, N)), idx, idx),)
        ),
        "matching.match": Row(
            matching.match,
            (matching.Maps(scores, scores.T, scores**2), points()),
            ((matching.Maps(*(np.full((N, N), 1 / N),) * 3), np.ones((N, 3))),),
        ),
        "invariants.edges": Row(lengths, (points(), idx), every(lambda x: (x, idx))),
        "invariants.included_angles": Row(
            invariants.included_angles,
            (RNG.normal(size=(N, K, 3)),),
            ((np.zeros((N, K, 3)),), (np.ones((N, K, 3)),)),
        ),
        "invariants.rounding_error": Row(
            invariants.rounding_error, (points(),), every(lambda x: (x,)), smooth=False
        ),
        "invariants.geometric_structure": Row(
            structure, (points(), idx), every(lambda x: (x, idx))
        ),
        "inliers.select_inliers": Row(
            lambda w, m: inliers.select_inliers(w, 4, m),
            (RNG.uniform(size=N), part),
            ((np.ones(N), mask), (np.ones(N), np.zeros(N, bool))),
            smooth=False,
        ),
        "losses.huber": Row(huber, (RNG.uniform(0, 1, 9),), ((np.array([0.0, 0.5, 1e9]),),)),
        "losses.global_consistency": Row(
            gc,
            (everything(points()), everything(points(6))),
            every(lambda x: (everything(x), everything(x))),
        ),
        "losses.neighborhood_consistency": Row(
            losses.neighborhood_consistency,
            (points(), points(), pose(), idx, inlier_idx, valid),
            (
                *every(lambda x: (x, x, RigidTransform(np.eye(3), zero3), idx, inlier_idx, valid)),
                (points(), points(), pose(), idx, inlier_idx, ~valid),
            ),
        ),
        "losses.geometric_consistency": Row(
            gs,
            (points(), points(), idx, inlier_idx, valid),
            every(lambda x: (x, x, idx, inlier_idx, valid)),
        ),
        "losses.spatial_consistency": Row(
            losses.spatial_consistency,
            (RNG.uniform(0.1, 1, N), inlier_idx, valid),
            ((np.zeros(N), inlier_idx, valid), (np.ones(N), inlier_idx, ~valid)),
        ),
        "losses.total_loss": Row(
            functools.partial(losses.total_loss, config=LossConfig()),
            (losses.LossTerms(*RNG.uniform(size=(4, 2))),),
        ),
    }


def network_and_model_rows() -> dict[str, Row]:
    variables = model_variables()
    source = points()
    near = source @ Rotation.from_euler("z", 0.2).as_matrix().T + 0.1
    pairs = every(lambda x: (variables, x, x))
    return {
        **network_rows(),
        "model.neighborhood_graph": Row(
            lambda x: model.neighborhood_graph(everything_traced(x), SMALL),
            (points(),),
            every(lambda x: (x,)),
            smooth=False,
        ),
        "model.init_variables": Row(
            lambda: model.init_variables(jax.random.key(3), SMALL), (), smooth=False, loose=True
        ),
        "model.point_features": Row(
            cloud_features, (variables, source), every(lambda x: (variables, x)), loose=True
        ),
        "model.iterate": Row(iterated, (variables, source, near), pairs, loose=True, kinks=True),
        "model.register_pair": Row(
            register, (variables, source, near), pairs, loose=True, kinks=True
        ),
        "losses.step_losses": Row(
            total_of_a_step, (variables, source, near), pairs, loose=True, kinks=True
        ),
    }


TABLE = core_rows() | network_and_model_rows()


def public_functions() -> set[str]:
    """Functions and networks that the numerical rooms define under a public name."""
    names = set()
    for room in ROOMS:
        module = importlib.import_module(f"jaxreg.{room}")
        for name, value in vars(module).items():
            record = inspect.isclass(value) and issubclass(value, tuple)
            if name.startswith("_") or not callable(value) or record:
                continue
            if getattr(value, "__module__", None) == module.__name__:
                names.add(f"{room}.{name}")
    return names


def test_every_public_function_is_in_the_table():
    missing, gone = public_functions() - set(TABLE), set(TABLE) - public_functions()
    assert not missing, f"give {sorted(missing)} a row in the table of tests/test_transforms.py"
    assert not gone, f"take {sorted(gone)} out of the table of tests/test_transforms.py"


@pytest.fixture
def row(request):
    """A row of the table, with JAX's promotion as it asks for."""
    row = TABLE[request.param]
    if row.loose:
        jax.config.update("jax_numpy_dtype_promotion", "standard")
    return row


def rows(names):
    return pytest.mark.parametrize(("name", "row"), [(n, n) for n in names], indirect=["row"])


each_row = rows(sorted(TABLE))


def is_float(x: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(x), jnp.floating)


def floating(row: Row, inputs: tuple):
    """The function of its floating inputs and outputs alone, as lists of arrays, and its inputs."""
    leaves, tree = jax.tree.flatten(inputs)
    where = [i for i, leaf in enumerate(leaves) if is_float(leaf)]

    def function(values, leaves):
        leaves = list(leaves)
        for i, value in zip(where, values, strict=True):
            leaves[i] = value
        outputs = jax.tree.leaves(row.function(*jax.tree.unflatten(tree, leaves)))
        return [x for x in outputs if is_float(x)]

    return function, [leaves[i] for i in where], leaves


@functools.cache
def compiled(name: str) -> tuple[Callable, Callable]:
    """The value, and both derivatives along directions, of a row; one compilation for each shape."""
    row = TABLE[name]

    @functools.partial(jax.jit, static_argnums=0)
    def both_modes(shape, values, leaves, direction, cotangent):
        function, *_ = floating(row, jax.tree.unflatten(shape, leaves))

        def of_values(values):
            return function(values, leaves)

        outputs, tangent = jax.jvp(of_values, (values,), (direction,))
        _, pull = jax.vjp(of_values, values)
        return outputs, tangent, pull(cotangent)[0]

    return both_modes


def assert_close(a, b, tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        scale = max(1.0, np.abs(np.where(np.isfinite(y), y, 0)).max(initial=0))
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance * scale)


def arrays(inputs):
    return jax.tree.map(jnp.asarray, inputs)


@functools.cache
def jitted(name: str) -> Callable:
    return jax.jit(TABLE[name].function)


@each_row
def test_jit_equals_eager(name, row):
    for inputs in (row.generic, *row.degenerate[:1]):
        assert_close(jitted(name)(*inputs), row.function(*arrays(inputs)), 1e-10)


@each_row
def test_vmap_equals_a_loop(name, row):
    if not row.generic:
        pytest.skip("takes no array")
    leaves, tree = jax.tree.flatten(row.generic)
    batch = [
        np.stack([x, 0.9 * x, x[::-1] if np.ndim(x) else x]) if is_float(x) else np.stack([x] * 3)
        for x in leaves
    ]
    together = jax.jit(jax.vmap(row.function))(*jax.tree.unflatten(tree, batch))
    for i in range(3):
        one = jitted(name)(*jax.tree.unflatten(tree, [x[i] for x in batch]))
        assert_close(jax.tree.map(lambda x, i=i: x[i], together), one, 1e-9)


def derivatives(name, row, inputs, rng):
    """A random direction, outputs, both derivatives, and a function of a step along the direction.

    The inner products of the forward and of the reverse derivative with a random cotangent, which
    must be equal, come last.
    """
    _, values, leaves = floating(row, inputs)
    direction = [rng.normal(size=np.shape(x)) for x in values]
    tree = jax.tree.structure(inputs)
    shapes = jax.eval_shape(floating(row, inputs)[0], values, leaves)
    cotangent = [rng.normal(size=x.shape) for x in shapes]

    def at(step):
        moved = [x + step * d for x, d in zip(values, direction, strict=True)]
        return compiled(name)(tree, moved, leaves, direction, cotangent)

    outputs, tangent, gradient = at(0.0)
    forward = sum(np.sum(c * t) for c, t in zip(cotangent, tangent, strict=True))
    reverse = sum(np.sum(d * g) for d, g in zip(direction, gradient, strict=True))
    return outputs, tangent, gradient, at, (forward, reverse)


DIFFERENTIABLE = sorted(name for name, row in TABLE.items() if row.generic)


@rows(DIFFERENTIABLE)
def test_derivatives_at_generic_inputs(name, row, seed):
    rng = np.random.default_rng(seed)
    _, tangent, gradient, at, products = derivatives(name, row, row.generic, rng)
    for x in (*tangent, *gradient):
        assert np.isfinite(x).all()
    np.testing.assert_allclose(*products, rtol=1e-9, atol=1e-10)
    if not row.smooth:
        return
    step = 1e-6
    for t, a, b in zip(tangent, at(step)[0], at(-step)[0], strict=True):
        difference = (np.asarray(a) - np.asarray(b)) / (2 * step)
        scale = max(1.0, np.abs(difference).max(initial=0))
        np.testing.assert_allclose(t, difference, rtol=1e-6, atol=1e-7 * scale)


@rows([name for name in DIFFERENTIABLE if TABLE[name].degenerate])
def test_derivatives_are_finite_and_modes_agree_at_degenerate_inputs(name, row, seed):
    rng = np.random.default_rng(seed)
    for number, inputs in enumerate(row.degenerate):
        outputs, tangent, gradient, _, (forward, reverse) = derivatives(name, row, inputs, rng)
        for x in (*outputs, *tangent, *gradient):
            assert np.isfinite(x).all(), f"degenerate input {number}"
        size = max(1.0, abs(forward))
        if row.kinks:
            assert max(abs(forward), abs(reverse)) < 1e6, f"degenerate input {number}"
        else:
            message = f"degenerate input {number}"
            np.testing.assert_allclose(reverse, forward, atol=1e-7 * size, err_msg=message)


@pytest.mark.untyped
@pytest.mark.parametrize(
    "row", ["neighbors.knn", "numerics.included_angle", "rigid.apply"], indirect=True
)
def test_numpy_arrays_are_welcome(row):
    assert_close(row.function(*row.generic), row.function(*arrays(row.generic)), 1e-12)
