"""Inlier confidence against loops written from Eq. 9-11, and the choice of the top N_c."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.network.features import BATCH_AXIS
from jaxreg.network.inliers import InlierNetwork, PredecessorInlierNetwork, select_inliers
from tests import oracles

# Flax promotes float64 with the float32 that it starts from.
pytestmark = pytest.mark.loose

N, K, D = 8, 4, 7
NETWORKS = {
    "paper": InlierNetwork(width=4, bn_momentum=0.9),
    "rienet": PredecessorInlierNetwork(width=4, bn_momentum=0.9),
}
top = jax.jit(select_inliers, static_argnums=1)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def draw_variables(rng, name):
    zeros = jnp.zeros((N, K, D))
    shapes = jax.eval_shape(
        lambda: NETWORKS[name].init(jax.random.key(0), zeros, zeros, jnp.ones(N, bool), train=False)
    )
    variables = jax.tree.map(lambda x: rng.normal(0, 0.5, x.shape), shapes)
    positive = jax.tree.map(lambda x: 0.5 + np.abs(x), variables["batch_stats"])
    return variables | {"batch_stats": positive}


def evaluate(name, variables, source, copy):
    mask = np.ones(len(source), bool)
    return jax.jit(lambda s, c, m: NETWORKS[name].apply(variables, s, c, m, train=False))(
        source, copy, mask
    )


def train(name, variables, source, copy, mask):
    run = jax.vmap(
        lambda s, c, m: NETWORKS[name].apply(
            variables, s, c, m, train=True, mutable=["batch_stats"]
        ),
        axis_name=BATCH_AXIS,
        out_axes=(0, None),
    )
    confidence, updated = run(source[None], copy[None], mask[None])
    return confidence[0], updated


def test_confidence_point_by_point(rng):
    variables = draw_variables(rng, "paper")
    source, copy = rng.normal(size=(2, N, K, D))
    expected = oracles.inlier_confidence(
        variables["params"], variables["batch_stats"], source, copy
    )
    result = evaluate("paper", variables, source, copy)
    np.testing.assert_allclose(result, expected, atol=1e-10)
    assert ((np.asarray(result) >= 0) & (np.asarray(result) <= 1)).all()


def test_identical_structures_have_confidence_one(rng):
    variables = draw_variables(rng, "paper")
    structure = rng.normal(size=(N, K, D))
    np.testing.assert_array_equal(evaluate("paper", variables, structure, structure), 1)
    confidence, _ = train("paper", variables, structure, structure, jnp.ones(N, bool))
    np.testing.assert_array_equal(confidence, 1)


@pytest.mark.parametrize(("name", "matters"), [("paper", False), ("rienet", True)])
def test_the_order_of_the_neighbours(rng, name, matters):
    variables = draw_variables(rng, name)
    source, copy = rng.normal(size=(2, N, K, D))
    order = np.roll(np.arange(K), 1)
    before = np.asarray(evaluate(name, variables, source, copy))
    after = np.asarray(evaluate(name, variables, source[:, order], copy[:, order]))
    # The predecessor convolves along the neighbours, nearest first; the paper does not.
    assert (np.abs(after - before).max() > 1e-6) == matters


@pytest.mark.parametrize("name", NETWORKS)
def test_points_do_not_see_each_other(rng, name):
    variables = draw_variables(rng, name)
    source, copy = rng.normal(size=(2, N, K, D))
    order = rng.permutation(N)
    before = np.asarray(evaluate(name, variables, source, copy))
    after = np.asarray(evaluate(name, variables, source[order], copy[order]))
    np.testing.assert_allclose(after, before[order], atol=1e-12)


@pytest.mark.parametrize("name", NETWORKS)
def test_padding_changes_neither_confidence_nor_statistics_nor_derivative(rng, name):
    variables = draw_variables(rng, name)
    source, copy = rng.normal(size=(2, N, K, D))
    garbage = rng.normal(30, 20, (2, 3, K, D))

    @jax.jit
    def run(params, source, copy, mask):
        def loss(params, source, copy):
            confidence, updated = train(name, variables | {"params": params}, source, copy, mask)
            return jnp.sum(jnp.where(mask, confidence, 0) ** 2), (confidence, updated)

        return jax.grad(loss, (0, 1, 2), has_aux=True)(params, source, copy)

    params = variables["params"]
    gradient, (confidence, updated) = run(params, source, copy, np.ones(N, bool))
    padded_gradient, (padded_confidence, padded_updated) = run(
        params,
        np.concatenate([source, garbage[0]]),
        np.concatenate([copy, garbage[1]]),
        np.arange(N + 3) < N,
    )
    np.testing.assert_allclose(padded_confidence[:N], confidence, atol=1e-9)
    pairs = [(padded_updated, updated), (padded_gradient[0], gradient[0])]
    pairs += [(a[:N], b) for a, b in zip(padded_gradient[1:], gradient[1:], strict=True)]
    for padded, plain in pairs:
        for a, b in zip(*map(jax.tree.leaves, (padded, plain)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)
    for of_points in padded_gradient[1:]:
        np.testing.assert_array_equal(of_points[N:], 0)


def test_the_most_confident_come_first(rng):
    confidence = rng.permutation(np.linspace(0.01, 0.99, 20))
    expected = sorted(range(20), key=lambda i: -confidence[i])
    np.testing.assert_array_equal(top(confidence, 6), expected[:6])
    np.testing.assert_array_equal(top(confidence, 20), expected)


def test_padded_points_come_last(rng):
    confidence, mask = rng.uniform(size=20), rng.permutation(np.arange(20) < 9)
    confidence[~mask] = rng.choice([5.0, np.nan, 0.0], 11)
    chosen = np.asarray(top(confidence, 12, mask))
    expected = sorted(np.flatnonzero(mask), key=lambda i: -confidence[i])
    np.testing.assert_array_equal(chosen[:9], expected)
    assert not mask[chosen[9:]].any()


@pytest.mark.parametrize("n_inliers", [0, 6, -1])
def test_more_inliers_than_points_is_named(n_inliers):
    with pytest.raises(ValueError, match=f"N_c = {n_inliers} .* n = 5 points"):
        top(np.ones(5), n_inliers)
