"""Matching against loops written from Eq. 3-6, and the laws of the maps."""

import jax
import numpy as np
import pytest

from jaxreg.network import matching
from tests import oracles

N, M, C, K, ALPHA = 9, 13, 5, 3, 0.7

feature_distance = jax.jit(matching.feature_distance)
matching_scores = jax.jit(matching.matching_scores)
neighborhood_sum = jax.jit(matching.neighborhood_sum)


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def graph(rng, n, k=K):
    return np.array([rng.choice(n, k, replace=False) for _ in range(n)], np.int32)


def test_feature_distance_entry_by_entry(rng):
    source, reference = rng.normal(size=(N, C)), rng.normal(size=(M, C))
    expected = oracles.feature_distance(source, reference)
    np.testing.assert_allclose(feature_distance(source, reference), expected, atol=1e-12)


@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_feature_distance_in_float32_does_not_cancel(rng, offset):
    source, reference = (np.float32(rng.normal(size=(n, C)) + offset) for n in (N, M))
    expected = oracles.feature_distance(source.astype(float), reference.astype(float))
    np.testing.assert_allclose(feature_distance(source, reference), expected, rtol=1e-4)


def test_feature_distance_and_derivative_where_features_coincide(rng):
    reference = rng.normal(size=(M, C))
    source = reference[:N]
    distance = np.asarray(feature_distance(source, reference))
    np.testing.assert_allclose(np.diagonal(distance), 0, atol=1e-7)
    constant = np.ones((4, C))
    np.testing.assert_array_equal(feature_distance(constant, constant), 0)
    gradient = jax.jit(jax.grad(lambda a, b: matching.feature_distance(a, b).sum(), (0, 1)))
    for derivative in jax.tree.leaves((gradient(source, reference), gradient(constant, constant))):
        assert np.isfinite(derivative).all()


def test_scores_are_a_softmax_over_the_reference(rng):
    distance = rng.uniform(0, 5, (N, M))
    scores = matching_scores(distance)
    np.testing.assert_allclose(scores, oracles.softmax_rows(-distance), atol=1e-14)
    np.testing.assert_allclose(np.sum(scores, axis=1), 1, atol=1e-14)


def test_padded_columns_score_exactly_zero(rng):
    distance, valid = rng.uniform(0, 5, (N, M)), np.arange(M) < 8
    padded = np.where(valid, distance, rng.choice([0.0, 1e9, np.nan, np.inf], (N, M)))
    scores = np.asarray(matching_scores(padded, valid))
    np.testing.assert_array_equal(scores[:, ~valid], 0)
    np.testing.assert_allclose(
        scores[:, valid], oracles.softmax_rows(-distance[:, valid]), atol=1e-14
    )


def test_scores_with_no_valid_column_are_finite(rng):
    assert np.isfinite(matching_scores(rng.uniform(0, 5, (N, M)), np.zeros(M, bool))).all()


def test_huge_and_equal_distances(rng):
    np.testing.assert_allclose(matching_scores(np.full((N, M), 1e8)), 1 / M, rtol=1e-12)
    one_hot = np.where(np.eye(N, M, dtype=bool), 0.0, 1e8)
    np.testing.assert_allclose(matching_scores(one_hot), np.eye(N, M), atol=1e-15)


def test_neighborhood_sum_entry_by_entry(rng):
    scores = rng.uniform(size=(N, M))
    source_idx, reference_idx = graph(rng, N), graph(rng, M)
    expected = oracles.neighborhood_sum(scores, source_idx, reference_idx)
    result = neighborhood_sum(scores, source_idx, reference_idx)
    np.testing.assert_allclose(result, expected, rtol=1e-13)


def test_neighborhood_sum_counts_repeated_neighbours(rng):
    # A padded point's list repeats the point itself.
    scores = rng.uniform(size=(N, M))
    source_idx, reference_idx = (np.tile(np.arange(n, dtype=np.int32)[:, None], 3) for n in (N, M))
    result = neighborhood_sum(scores, source_idx, reference_idx)
    np.testing.assert_allclose(result, 9 * scores, rtol=1e-14)


def test_incidence_names_those_that_have_a_point_as_a_neighbour(rng):
    idx = graph(rng, N)
    result = jax.jit(matching.incidence)(idx)
    np.testing.assert_array_equal(result.idx, idx)
    for j in range(N):
        members = np.asarray(result.member)[result.start[j] : result.start[j] + result.count[j]]
        assert sorted(members) == [i for i in range(N) if j in idx[i]]


def test_derivative_of_the_neighborhood_sum_is_its_transpose(rng):
    scores, cotangent = rng.uniform(size=(2, N, M))
    source_idx, reference_idx = graph(rng, N), graph(rng, M)

    @jax.jit
    def pull(scores, cotangent, *graphs):
        return jax.vjp(lambda s: matching.neighborhood_sum(s, *graphs), scores)[1](cotangent)[0]

    expected = np.zeros((N, M))
    for i in range(N):
        for j in range(M):
            for a in source_idx[i]:
                for b in reference_idx[j]:
                    expected[a, b] += cotangent[i, j]
    np.testing.assert_allclose(
        pull(scores, cotangent, source_idx, reference_idx), expected, rtol=1e-13
    )


@pytest.mark.parametrize("nearest", [None, "same graph", "own graph"])
def test_maps_entry_by_entry(rng, nearest):
    distance = rng.uniform(0, 3, (N, M))
    graphs = graph(rng, N), graph(rng, M)
    own = (graph(rng, N), graph(rng, M)) if nearest == "own graph" else None
    nearest_distance = None if nearest is None else rng.uniform(0, 3, (N, M))

    @jax.jit
    def run(distance, nearest_distance, graphs, own):
        both_ways = [
            None if g is None else tuple(map(matching.incidence, g)) for g in (graphs, own)
        ]
        return matching.matching_maps(
            distance, nearest_distance, *both_ways[0], alpha=ALPHA, nearest_graphs=both_ways[1]
        )

    result = run(distance, nearest_distance, graphs, own)
    expected = oracles.maps(distance, nearest_distance, *graphs, ALPHA, own)
    for name, got, want in zip(("M", "G", "F"), result, expected, strict=True):
        np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-15, err_msg=name)


def test_reference_copy_is_the_weighted_mean_of_the_reference(rng):
    maps = matching.Maps(*(oracles.softmax_rows(rng.normal(size=(3, N, M)))))
    reference = rng.normal(size=(M, 3))
    matches = jax.jit(matching.match)(maps.dual, maps.final, reference)
    expected = [sum(maps.final[i, j] * reference[j] for j in range(M)) for i in range(N)]
    np.testing.assert_allclose(matches.copy, expected, atol=1e-14)
    np.testing.assert_array_equal(matches.dual_peak, maps.dual.max(axis=1))
    np.testing.assert_array_equal(matches.final_peak, maps.final.max(axis=1))
