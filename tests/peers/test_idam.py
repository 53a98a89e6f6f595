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


def block(variables, name, x):
    """A linear map, BatchNorm and ReLU, and a linear map."""
    params, statistics = (variables[kind][name] for kind in ("params", "batch_stats"))
    x = oracles.batch_norm(params, statistics, "BatchNorm_0", oracles.dense(params["Dense_0"], x))
    return oracles.dense(params["Dense_1"], np.maximum(x, 0))


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


def test_procrustes_turns_about_unweighted_centroids_and_shifts_by_weighted_ones(seed):
    rng = np.random.default_rng(seed)
    source, copy, weights = rng.normal(size=(7, 3)), rng.normal(size=(7, 3)), rng.uniform(size=7)
    cloud = PointCloud(jnp.asarray(source), jnp.ones(7, bool))
    found = idam.centred_procrustes(cloud, jnp.asarray(copy), jnp.asarray(weights))
    x, y = source - source.mean(axis=0), copy - copy.mean(axis=0)
    u, _, vt = np.linalg.svd((x * weights[:, None]).T @ y)
    rotation = vt.T @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ u.T
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    shift = np.average(copy - source @ rotation.T, axis=0, weights=weights)
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
    for i in range(5):
        row = []
        for j in range(6):
            p, q = (np.asarray(k.cloud.points)[r] for k, r in zip(kept, (i, j), strict=True))
            features = [np.asarray(k.features)[r] for k, r in zip(kept, (i, j), strict=True)]
            distance = np.linalg.norm(p - q)
            pair = np.concatenate([*features, [distance], (p - q) / distance])
            x = block(own, "pairs", pair)
            row.append(x)
            score = np.clip(block(own, "scores", x)[0], -20, 20)
            np.testing.assert_allclose(scores[i, j], score, atol=1e-9)
        value = block(own, "validity", np.max(row, axis=0))[0]
        np.testing.assert_allclose(validity[i], 1 / (1 + np.exp(-value)), atol=1e-9)


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
        edges = block(own, f"edges_{i}", x[near] - x[:, None])
        x = oracles.dense(own["params"][f"points_{i}"], edges.max(axis=1))
    np.testing.assert_allclose(run(points), x, atol=1e-8)
