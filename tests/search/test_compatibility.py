import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxreg.search.compatibility import compatibility, second_order, spectral_weights


def unit(rng, n):
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_equals_the_definition_pair_by_pair(seed):
    rng = np.random.default_rng(seed)
    p, q, a, b = rng.normal(size=(9, 3)), rng.normal(size=(9, 3)), unit(rng, 9), unit(rng, 9)
    found = compatibility(
        *map(jnp.asarray, (p, q, a, b)), jnp.arange(9) < 8, tolerance=2.0, cosine_tolerance=0.9
    )
    bell = lambda change, tolerance: max(0, 1 - (change / tolerance) ** 2)  # noqa: E731
    for i in range(9):
        for k in range(9):
            lengths = [np.linalg.norm(x[i] - x[k]) for x in (p, q)]
            facing = [abs(n[i] @ n[k]) for n in (a, b)]
            slopes = [
                [abs(n[s] @ (x[k] - x[i])) / (length + 1.0) for s in (i, k)]
                for n, x, length in ((a, p, lengths[0]), (b, q, lengths[1]))
            ]
            expected = bell(lengths[0] - lengths[1], 2.0) * bell(facing[0] - facing[1], 0.9)
            for s in range(2):
                expected *= bell(slopes[0][s] - slopes[1][s], 0.9)
            if i == k or 8 in (i, k):
                expected = 0
            np.testing.assert_allclose(found[i, k], expected, atol=1e-12)


def test_right_candidates_agree_fully_and_outweigh_wrong_ones(seed):
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng).as_matrix()
    p, a = rng.normal(size=(40, 3)), unit(rng, 40)
    q, b = p @ turn.T + 1, a @ turn.T * rng.choice([-1, 1], (40, 1))
    q[20:] = rng.normal(size=(20, 3))
    first = compatibility(
        *map(jnp.asarray, (p, q, a, b)), jnp.ones(40, bool), tolerance=0.1, cosine_tolerance=0.3
    )
    np.testing.assert_allclose(first[:20, :20], 1 - np.eye(20), atol=1e-9)
    weights = np.asarray(spectral_weights(first))
    assert weights[:20].min() > 2 * weights[20:].max()


def test_second_order_counts_the_third_candidates_that_both_agree_with(seed):
    first = np.random.default_rng(seed).uniform(0, 1, (7, 7))
    expected = [
        [first[i, k] * sum(first[i, l] * first[l, k] for l in range(7)) for k in range(7)]
        for i in range(4)
    ]
    np.testing.assert_allclose(second_order(jnp.asarray(first), 4), expected, rtol=1e-12)


def test_spectral_weights_are_the_leading_eigenvector(seed):
    matrix = np.random.default_rng(seed).uniform(0, 1, (3, 7, 7))
    matrix = matrix + np.swapaxes(matrix, 1, 2)
    found = spectral_weights(jnp.asarray(matrix), steps=100)
    expected = np.abs(np.linalg.eigh(matrix)[1][:, :, -1])
    np.testing.assert_allclose(found, expected, atol=1e-5)
    np.testing.assert_allclose(spectral_weights(jnp.zeros((4, 4))), np.full(4, 0.5))
