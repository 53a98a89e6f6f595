"""The feature network against loops, its statistics, and the laws it must keep."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.network.features import BATCH_AXIS, DEVICE_AXIS, DGCNN, BatchNorm, relative_neighbors
from tests import oracles
from tests.compiled import knn

# Flax promotes float64 with the float32 that it starts from.
pytestmark = pytest.mark.loose

N, K = 14, 3
NETWORK = DGCNN(channels=(4, 8), width=6, bn_momentum=0.9)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def cloud(rng, n=N):
    points = rng.normal(size=(n, 3))
    return points, knn(points, K)


def randomised(rng, tree):
    """Parameters and statistics away from their initial zeros and ones."""
    return jax.tree.map(lambda x: rng.normal(0, 0.7, x.shape), tree)


def draw_variables(rng):
    shapes = jax.eval_shape(
        lambda: NETWORK.init(
            jax.random.key(0), jnp.zeros((N, K, 3)), jnp.ones(N, bool), train=False
        )
    )
    variables = randomised(rng, shapes)
    return variables | {
        "batch_stats": jax.tree.map(lambda x: 0.5 + np.abs(x), variables["batch_stats"])
    }


@jax.jit
def evaluate(variables, points, neighbors):
    edges = relative_neighbors(points, neighbors)
    return NETWORK.apply(variables, edges, jnp.ones(len(points), bool), train=False)


@jax.jit
def train(variables, points, neighbors, masks):
    """Features and updated statistics of a batch (b, n, 3)."""

    def one(points, neighbors, mask):
        edges = relative_neighbors(points, neighbors)
        return NETWORK.apply(variables, edges, mask, train=True, mutable=["batch_stats"])

    return jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, None))(points, neighbors, masks)


def test_features_edge_by_edge(rng):
    variables, (points, neighbors) = draw_variables(rng), cloud(rng)
    expected = oracles.dgcnn(
        variables["params"], variables["batch_stats"], points, np.asarray(neighbors)
    )
    assert (expected > 0).mean() > 0.1, "the test sees features that are not cut off at zero"
    np.testing.assert_allclose(evaluate(variables, points, neighbors), expected, atol=1e-10)


def test_features_ignore_translation_and_the_order_of_neighbours(rng):
    variables, (points, neighbors) = draw_variables(rng), cloud(rng)
    features = evaluate(variables, points, neighbors)
    np.testing.assert_allclose(evaluate(variables, points + 7, neighbors), features, atol=1e-10)
    shuffled = neighbors[:, rng.permutation(K)]
    np.testing.assert_allclose(evaluate(variables, points, shuffled), features, atol=1e-12)
    turned = points @ Rotation.from_euler("x", 1.0).as_matrix().T
    assert np.abs(evaluate(variables, turned, neighbors) - features).max() > 1e-3


def test_relative_coordinates_point_from_the_centre_to_the_neighbour(rng):
    points, neighbors = cloud(rng)
    result = jax.jit(relative_neighbors)(points, neighbors)
    for i in range(N):
        for r, j in enumerate(neighbors[i]):
            np.testing.assert_allclose(result[i, r], points[j] - points[i], atol=1e-15)


@pytest.mark.parametrize("devices", [0, 2])
def test_batch_statistics_run_over_all_valid_points_of_all_clouds(devices, rng):
    module = BatchNorm(momentum=0.9)
    x, mask = rng.normal(3, 2, (4, 10, 5)), rng.uniform(size=(4, 10)) < 0.7
    padded = np.where(mask[..., None], x, rng.choice([1e6, -1e6, 1e3], (4, 10, 1)))
    variables = {
        "params": {"BatchNorm_0": {"scale": np.full(5, 2.0), "bias": np.full(5, 0.5)}},
        "batch_stats": {"BatchNorm_0": {"mean": np.full(5, 1.0), "var": np.full(5, 3.0)}},
    }

    run = jax.vmap(
        lambda x, m: module.apply(variables, x, m, train=True, mutable=["batch_stats"]),
        axis_name=BATCH_AXIS,
        out_axes=(0, None),
    )
    clouds = padded, mask
    if devices:
        clouds = tuple(x.reshape(devices, -1, *x.shape[1:]) for x in clouds)
        run = jax.vmap(run, axis_name=DEVICE_AXIS, out_axes=(0, None))
    y, updated = jax.jit(run)(*clouds)
    y = y.reshape(x.shape)
    valid = x[mask]
    mean, var = valid.mean(axis=0), valid.var(axis=0)
    expected = 2 * (valid - mean) / np.sqrt(var + 1e-5) + 0.5
    np.testing.assert_allclose(np.asarray(y)[mask], expected, atol=1e-10)
    statistics = updated["batch_stats"]["BatchNorm_0"]
    np.testing.assert_allclose(statistics["mean"], 0.9 * 1.0 + 0.1 * mean, atol=1e-12)
    np.testing.assert_allclose(statistics["var"], 0.9 * 3.0 + 0.1 * var, atol=1e-12)


def test_ragged_clouds_in_a_batch_equal_the_same_clouds_without_padding(rng):
    variables, sizes, longest = draw_variables(rng), (N, N - 4), N
    clouds = [cloud(rng, n) for n in sizes]
    points, neighbors = np.full((2, longest, 3), 50.0), np.zeros((2, longest, K), np.int32)
    masks = np.arange(longest) < np.array(sizes)[:, None]
    for row, (x, idx) in enumerate(clouds):
        points[row, : len(x)], neighbors[row, : len(x)] = x, idx
    features, updated = train(variables, points, neighbors, masks)
    # Each size alone with the statistics of both: the running ones after momentum is taken out.
    batch = jax.tree.map(
        lambda new, old: (new - 0.9 * old) / 0.1, updated["batch_stats"], variables["batch_stats"]
    )
    for row, (x, idx) in enumerate(clouds):
        alone = evaluate(variables | {"batch_stats": batch}, x, idx)
        np.testing.assert_allclose(features[row, : len(x)], alone, atol=1e-8)


def test_padding_changes_no_derivative(rng):
    variables, (points, neighbors) = draw_variables(rng), cloud(rng)
    mask, target = np.arange(N + 5) < N, rng.normal(size=(N, 6))

    @jax.jit
    def gradient(params, points, neighbors, mask):
        def loss(params, points):
            batch = [x[None] for x in (points, neighbors, mask)]
            features, _ = train(variables | {"params": params}, *batch)
            return jnp.sum(features[0, :N] * target)

        return jax.grad(loss, (0, 1))(params, points)

    params = variables["params"]
    plain = gradient(params, points, neighbors, np.ones(N, bool))
    padded = gradient(
        params,
        np.concatenate([points, rng.normal(9, 5, (5, 3))]),
        np.concatenate([neighbors, rng.integers(0, N + 5, (5, K)).astype(np.int32)]),
        mask,
    )
    for a, b in zip(*map(jax.tree.leaves, (padded[0], plain[0])), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(padded[1][:N], plain[1], rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(padded[1][N:], 0)
