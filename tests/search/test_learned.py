import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import shapes
from jaxreg.search.config import SearchConfig
from jaxreg.search.description import compare, describe
from jaxreg.search.learned import (
    check_network,
    init_network,
    learned_features,
    load_features,
)

pytestmark = [pytest.mark.float32]
N, ROWS = 400, 448


@jax.jit
def cosines(network, x, y, x_mask, y_mask):
    described = (describe(p, mask, unit=1.0) for p, mask in ((x, x_mask), (y, y_mask)))
    return compare(*described, network=network).similarity


def padded(points, value):
    rows = np.full((ROWS, 3), value, np.float32)
    rows[: len(points)] = points
    return jnp.asarray(rows), jnp.arange(ROWS) < len(points)


@pytest.fixture
def problem(seed):
    clouds = [shapes.sample_shape(seed, i, points=N) for i in range(2)]
    return init_network(jax.random.key(seed)), *clouds


def test_motion_order_and_padding_do_not_matter(problem, seed):
    network, x, y = problem
    rng = np.random.default_rng(seed)
    turn, order = Rotation.random(random_state=rng).as_matrix(), rng.permutation(N)
    (a, a_mask), (b, b_mask) = padded(x, 0), padded(y, 0)
    here = np.asarray(cosines(network, a, b, a_mask, b_mask))
    assert np.ptp(here[:N, :N]) > 0.1
    np.testing.assert_array_equal(here[N:], 0)
    np.testing.assert_array_equal(here[:, N:], 0)
    other, _ = padded((x @ turn.T)[order], np.nan)
    there = np.asarray(cosines(network, other, b, a_mask, b_mask))
    # Of two neighbours that are equally near up to rounding, another may come first in the list.
    assert np.quantile(np.abs(there[:N, :N] - here[:N, :N][order]), 0.99) < 5e-3


@pytest.mark.slow
def test_weights_have_finite_gradients_that_descend(problem, seed):
    """A law of gradients: a short step along minus the gradient lowers what was differentiated."""
    network, x, y = problem
    (a, a_mask), (b, b_mask) = padded(x, np.nan), padded(y, np.nan)
    loss = jax.jit(lambda w: jnp.mean(cosines(w, a, b, a_mask, b_mask)))
    gradient = jax.jit(jax.grad(loss))(network)
    assert all(np.isfinite(g).all() for g in jax.tree.leaves(gradient))
    square = sum(float(jnp.sum(g * g)) for g in jax.tree.leaves(gradient))
    assert square > 0
    moved = jax.tree.map(lambda w, g: w - 1e-3 / square**0.5 * g, network, gradient)
    assert loss(moved) < loss(network)


@pytest.mark.parametrize("kind", ["one place", "line", "plane", "few points"])
def test_degenerate_clouds_have_finite_features(kind, seed):
    rng = np.random.default_rng(seed)
    x = {
        "one place": np.ones((N, 3)),
        "line": np.linspace(-1, 1, N)[:, None] * [1.0, 2, 3] / 4,
        "plane": rng.uniform(-1, 1, (N, 3)) * [1, 1, 0],
        "few points": rng.uniform(-1, 1, (5, 3)),
    }[kind]
    a, mask = padded(x, np.nan)
    found = np.asarray(cosines(init_network(jax.random.key(seed)), a, a, mask, mask))
    assert np.isfinite(found).all()
    assert np.abs(found).max() < 1 + 1e-4


def test_messages_are_the_equation(seed):
    """One point and its edges, written out in numpy."""
    rng = np.random.default_rng(seed)
    network = jax.tree.map(np.asarray, init_network(jax.random.key(seed)))
    network = {name: w + rng.normal(size=w.shape) * 0.1 for name, w in network.items()}
    n = 70
    points, normals = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moments, openness = rng.normal(size=(n, 48)), rng.uniform(size=n)
    found = jax.jit(learned_features)(
        *jax.tree.map(jnp.float32, (network, moments, openness, points, normals))
    )

    def gelu(v):
        return 0.5 * v * (1 + np.tanh(np.sqrt(2 / np.pi) * (v + 0.044715 * v**3)))

    def layer(name, v):
        return v @ network[name] + network[f"{name}_bias"]

    hidden = gelu(layer("lift", np.c_[moments * np.sqrt(48), 4 * openness]))
    nearest = np.argsort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, 1:65]
    for name, ranks, radius in (("near", range(16), 0.15), ("far", range(3, 64, 4), 0.3)):
        new = []
        for i in range(n):
            messages = []
            for j in nearest[i, list(ranks)]:
                offset = points[j] - points[i]
                length = np.linalg.norm(offset)
                cosines = [normals[i] @ offset / length, normals[j] @ offset / length]
                edge = np.array([length / radius, *np.abs([*cosines, normals[i] @ normals[j]])])
                message = layer(f"{name}_edge", edge) + layer(f"{name}_there", hidden[j])
                messages.append(gelu(message + layer(f"{name}_here", hidden[i])))
            pooled = np.concatenate([np.max(messages, axis=0), np.mean(messages, axis=0)])
            new.append(hidden[i] + layer(f"{name}_add", gelu(layer(f"{name}_pool", pooled))))
        hidden = np.array(new)
    expected = layer("last", gelu(hidden))
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_released_weights_fit_the_search_they_are_loaded_for():
    network = load_features()
    check_network(network, 48)
    with pytest.raises(
        ValueError, match=r"trained with radii = \[0.2, 0.4, 0.8\], but this search"
    ):
        load_features(config=SearchConfig(radii=(0.1, 0.4, 0.8)))
    with pytest.raises(ValueError, match="not those of a feature network"):
        load_features("modelnet40")
    with pytest.raises(ValueError, match="no released weights 'nothing'"):
        load_features("nothing")


def test_weights_of_another_size_are_named(seed):
    network = init_network(jax.random.key(seed), inputs=32)
    check_network(network, 32)
    with pytest.raises(ValueError, match=r"'lift' of the network have shape \(33, 64\)"):
        check_network(network, 48)
