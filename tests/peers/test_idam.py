"""IDAM's stages against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.peers import idam
from jaxreg.types import PointCloud
from tests import oracles
from tests.peers.small import SMALL, draw_variables

pytestmark = pytest.mark.loose


def test_hard_elimination_keeps_the_most_significant_of_the_valid_points(seed):
    score = np.random.default_rng(seed).normal(size=20)
    mask = np.arange(20) < 13
    rows, counts = idam.hard_elimination(jnp.asarray(score), jnp.asarray(mask), one_in=4)
    assert counts.shape == (5,)
    np.testing.assert_array_equal(np.flatnonzero(counts), np.arange(13 // 4))
    np.testing.assert_array_equal(rows[:3], np.argsort(-score[:13])[:3])


def test_hybrid_elimination_drops_what_is_below_the_lower_median(seed):
    validity = np.random.default_rng(seed).uniform(size=9)
    mask = np.arange(9) < 6
    found = idam.hybrid_elimination(jnp.asarray(validity), jnp.asarray(mask))
    middle = np.sort(validity[:6])[2]
    expected = np.where(mask & (validity >= middle), validity, 0)
    np.testing.assert_array_equal(found, expected)
    assert np.count_nonzero(found) == 4


def test_procrustes_turns_about_the_unweighted_centroids(seed):
    rng = np.random.default_rng(seed)
    source, copy, weights = rng.normal(size=(7, 3)), rng.normal(size=(7, 3)), rng.uniform(size=7)
    cloud = PointCloud(jnp.asarray(source), jnp.ones(7, bool))
    found = idam.centred_procrustes(cloud, jnp.asarray(copy), jnp.asarray(weights))
    x, y = source - source.mean(axis=0), copy - copy.mean(axis=0)
    u, _, vt = np.linalg.svd((x * weights[:, None]).T @ y)
    rotation = vt.T @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ u.T
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    shift = copy.mean(axis=0) - rotation @ source.mean(axis=0)
    np.testing.assert_allclose(found.translation, shift, atol=1e-9)


def test_similarity_and_validity_are_those_of_the_layers(seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(idam, SMALL["idam"], rng)
    kept = [
        idam.Kept(
            jnp.arange(n),
            PointCloud(jnp.asarray(rng.normal(size=(n, 3))), jnp.ones(n, bool)),
            jnp.asarray(rng.normal(size=(n, 4))),
        )
        for n in (5, 6)
    ]
    network = idam._networks(SMALL["idam"])["similarity_0"]
    own = {kind: tree["similarity_0"] for kind, tree in variables.items()}
    scores, validity = network.apply(own, *kept, train=False)
    params, statistics = own["params"], own["batch_stats"]

    def layer(i, x):
        x = oracles.batch_norm(
            params, statistics, f"BatchNorm_{i}", oracles.dense(params[f"Dense_{i}"], x)
        )
        return np.maximum(x, 0)

    for i in range(5):
        row = []
        for j in range(6):
            p, q = (np.asarray(k.cloud.points)[r] for k, r in zip(kept, (i, j), strict=True))
            features = [np.asarray(k.features)[r] for k, r in zip(kept, (i, j), strict=True)]
            distance = np.linalg.norm(p - q)
            pair = np.concatenate([*features, [distance], (p - q) / distance])
            x = layer(1, layer(0, pair))
            row.append(x)
            score = np.clip(oracles.dense(params["Dense_3"], layer(2, x))[0], -20, 20)
            np.testing.assert_allclose(scores[i, j], score, atol=1e-9)
        pooled = np.max(row, axis=0)
        # The outer linear map is made before the inner one that it is applied to.
        hidden = np.maximum(oracles.dense(params["Dense_5"], pooled), 0)
        value = 1 / (1 + np.exp(-oracles.dense(params["Dense_4"], hidden)[0]))
        np.testing.assert_allclose(validity[i], value, atol=1e-9)


def test_half_of_the_rows_have_a_partner_where_there_are_enough():
    partner = np.array([0, 1, 0, 1, 1, 0, 0, 1, 0, 0, 0, 0], bool)
    rows = np.asarray(idam._half_of_each(jnp.asarray(partner), jnp.ones(12, bool), 3))
    np.testing.assert_array_equal(rows, [1, 3, 0, 2])


def test_features_are_those_of_the_layers(seed):
    rng = np.random.default_rng(seed)
    variables = draw_variables(idam, SMALL["idam"], rng)
    points = rng.normal(size=(9, 3))
    near = jnp.array([[i, (i + 1) % 9, (i + 4) % 9] for i in range(9)], jnp.int32)
    own = {kind: tree["graph"] for kind, tree in variables.items()}
    network = idam._networks(SMALL["idam"])["graph"]
    run = jax.jit(lambda x: network.apply(own, x, near, jnp.ones(9, bool), train=False))
    x = points
    for i in range(2):
        edges = oracles.dense(own["params"][f"Dense_{3 * i}"], x[near] - x[:, None])
        normal = oracles.batch_norm(own["params"], own["batch_stats"], f"BatchNorm_{i}", edges)
        lifted = oracles.dense(own["params"][f"Dense_{3 * i + 2}"], np.maximum(normal, 0))
        x = oracles.dense(own["params"][f"Dense_{3 * i + 1}"], lifted.max(axis=1))
    np.testing.assert_allclose(run(points), x, atol=1e-8)
