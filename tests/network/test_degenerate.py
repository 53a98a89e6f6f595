"""The network and its training on degenerate, padded and ragged clouds (see test_degenerate.py)."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.config import Config, LossConfig, ModelConfig
from jaxreg.geometry.neighbors import nearest_neighbor
from jaxreg.network import losses, model
from jaxreg.network.features import BATCH_AXIS
from jaxreg.network.model import init_variables, register_pair
from jaxreg.types import PointCloud
from tests.compiled import knn
from tests.scenes import shape

# Flax promotes float64 with the float32 that it starts from.
pytestmark = pytest.mark.loose

SMALL = ModelConfig(
    k=3, k_matching=3, channels=(3, 4), width=4, inlier_width=2, n_inliers=10, iterations=2
)
ROWS = 30
"""Rows of every cloud that a test here gives the network: one size, one compilation."""


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


@functools.cache
def variables():
    shapes = jax.eval_shape(lambda: init_variables(jax.random.key(0), SMALL))
    rng = np.random.default_rng(0)
    tree = jax.tree.map(lambda x: rng.normal(0, 0.4, x.shape), shapes)
    return tree | {"batch_stats": jax.tree.map(lambda x: 0.5 + np.abs(x), tree["batch_stats"])}


@jax.jit
def network(variables, source, reference, source_mask, reference_mask):
    """The registration, and the gradient of the training loss by variables and clouds."""

    def loss(variables, source, reference):
        clouds = PointCloud(source, source_mask), PointCloud(reference, reference_mask)
        _, terms, _ = model.iterate(
            variables,
            *clouds,
            config=SMALL,
            observe=lambda step, graph: losses.step_losses(
                step, graph, source_mask, clouds[1], config=LossConfig(), model=SMALL
            ),
        )
        return losses.total_loss(terms, LossConfig())

    registration = register_pair(
        variables,
        source,
        reference,
        config=Config(model=SMALL),
        source_mask=source_mask,
        reference_mask=reference_mask,
    )
    return registration, jax.value_and_grad(loss, (0, 1, 2))(variables, source, reference)


def run_network(source, reference, fill=0.0):
    """The network on clouds of at most `ROWS` points, padded with `fill`."""
    inputs = []
    for points in (source, reference):
        padded = np.full((ROWS, 3), fill)
        padded[: len(points)] = points
        inputs.append((padded, np.arange(ROWS) < len(points)))
    (a, a_mask), (b, b_mask) = inputs
    return network(variables(), a, b, a_mask, b_mask)


def assert_finite(tree):
    for leaf in jax.tree.leaves(tree):
        assert np.isfinite(leaf).all()


def test_t01_identical_clouds_have_finite_gradients(rng):
    points = shape(rng)[:ROWS]
    assert_finite(run_network(points, points))


def test_t07_no_points():
    with pytest.raises(ValueError, match="n = 0 points"):
        jax.jit(nearest_neighbor)(np.zeros((0, 3)))
    empty, some = np.zeros((0, 3)), np.ones((4, 3))
    for pair in ((empty, some), (some, empty), (empty, empty)):
        result, gradient = run_network(*pair, fill=np.nan)
        assert not result.valid
        np.testing.assert_allclose(result.transformation, np.eye(4), atol=1e-12)
        assert_finite((result, gradient))


def test_t18_what_stands_in_the_padding_changes_no_bit(rng):
    source, reference = shape(rng, 80)[::4], shape(rng, 80)[1::4]
    expected = run_network(source, reference, fill=0.0)
    for fill in (1e6, np.nan, np.inf):
        result = run_network(source, reference, fill=fill)
        jax.tree.map(np.testing.assert_array_equal, result, expected)
    assert_finite(expected)


@jax.jit
def trained(variables, sources, references, source_masks, reference_masks):
    """Loss, statistics and gradients of a batch in training, as `jaxreg.training` computes them."""

    def objective(variables, sources, references):
        def one(source, reference):
            def observe(step, graph):
                return losses.step_losses(
                    step, graph, source.mask, reference, config=LossConfig(), model=SMALL
                )

            _, terms, updated = model.iterate(
                variables, source, reference, config=SMALL, train=True, observe=observe
            )
            return losses.total_loss(terms, LossConfig()), updated["batch_stats"]

        loss, statistics = jax.vmap(one, axis_name=BATCH_AXIS, out_axes=(0, None))(
            PointCloud(sources, source_masks), PointCloud(references, reference_masks)
        )
        return jnp.sum(loss), statistics

    return jax.value_and_grad(objective, (0, 1, 2), has_aux=True)(variables, sources, references)


def batch_of(pairs, rows, fill):
    """Clouds (2, b, rows, 3) and masks of ragged pairs, valid rows first, as `trained` takes them."""
    clouds = np.full((2, len(pairs), rows, 3), fill)
    masks = np.zeros(clouds.shape[:-1], bool)
    for number, pair in enumerate(pairs):
        for side, points in enumerate(pair):
            clouds[side, number, : len(points)] = points
            masks[side, number, : len(points)] = True
    return (*clouds, *masks)


def test_t18_padding_changes_neither_the_training_loss_nor_its_gradient(rng):
    # No two edges parallel: an angle of 0 has a kink, and rounding chooses its side.
    pairs = [tuple(rng.uniform(-1, 1, (2, 20, 3))) for _ in range(2)]
    (loss, statistics), gradients = trained(variables(), *batch_of(pairs, 20, 0.0))
    (padded, other), others = trained(variables(), *batch_of(pairs, 26, np.nan))
    np.testing.assert_allclose(padded, loss, rtol=1e-9)
    for a, b in zip(*map(jax.tree.leaves, (other, statistics)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)
    for a, b in zip(*map(jax.tree.leaves, (others[0], gradients[0])), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-8)
    for a, b in zip(others[1:], gradients[1:], strict=True):
        np.testing.assert_allclose(a[:, :20], b, rtol=1e-6, atol=1e-8)
        np.testing.assert_array_equal(a[:, 20:], 0)
    ragged = [
        tuple(x[:n] for x, n in zip(pair, (20 - i, 15 + i), strict=True))
        for i, pair in enumerate(pairs)
    ]
    expected = trained(variables(), *batch_of(ragged, 26, 0.0))
    result = trained(variables(), *batch_of(ragged, 26, np.inf))
    jax.tree.map(np.testing.assert_array_equal, result, expected)
    assert_finite(expected)


def test_t19_a_batch_of_three_equals_three_singles(rng):
    pairs = [(shape(rng, 4 * n)[::4], shape(rng, 4 * n)[1::4]) for n in (12, 20, 30)]
    sources, references, *masks = batch_of(pairs, ROWS, np.nan)

    @jax.jit
    @jax.vmap
    def batch(a, b, a_mask, b_mask):
        return register_pair(
            variables(), a, b, config=Config(model=SMALL), source_mask=a_mask, reference_mask=b_mask
        )

    together = batch(sources, references, *masks)
    for row, pair in enumerate(pairs):
        single, _ = run_network(*pair)
        for a, b in zip(together, single, strict=True):
            np.testing.assert_allclose(a[row], b, atol=1e-9)


def test_t25_a_regular_grid_has_constant_features():
    axis = np.arange(3.0)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    for reference in (grid, grid + 0.25, 2 * grid):
        assert_finite(run_network(grid, reference))
    index = np.asarray(knn(grid, 6))
    # The six nearest of the middle one are the middles of the six faces.
    np.testing.assert_allclose(np.linalg.norm(grid[index[13]] - grid[13], axis=1), 1)
