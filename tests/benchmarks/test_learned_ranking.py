"""What poses are ranked by: facts of points that coincide, scores that learn the better pose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.search.description import compare, describe
from research import learned_ranking as ranking

pytestmark = pytest.mark.loose


def test_facts_of_a_cloud_on_itself(seed):
    points = jnp.asarray(np.random.default_rng(seed).normal(size=(40, 3)))
    described = jax.jit(lambda x: describe(x, unit=1.0))(points)
    surface, other, _ = compare(described, described)
    facts = np.asarray(ranking.facts(surface, other))
    assert facts.shape == (40, 17)
    np.testing.assert_allclose(facts[:, :10], 1, atol=1e-6)  # near, on the plane, facing, alike
    np.testing.assert_allclose(facts[:, -1], 0, atol=1e-6)  # the distance


@pytest.mark.parametrize("score", ["network_score", "means_score", "terms_score"])
def test_every_score_learns_to_choose_the_better_pose(score, seed):
    """The right one of two poses lays more of the points near the other cloud."""
    rng = np.random.default_rng(seed)

    def choice():
        right = rng.permutation(np.array([True, False]))
        facts = rng.uniform(0, 0.5, (2, 2, 30, 17)) + 0.5 * right[None, :, None, None]
        terms = facts.mean(axis=(0, 2))[:, :4]
        return ranking.Choice(*np.float16(facts), np.float32(terms), terms[:, 0], right)

    weights = {
        "network_score": lambda: ranking.init_network(jax.random.key(seed), 17),
        "means_score": lambda: jnp.zeros(21),
        "terms_score": lambda: jnp.zeros(4),
    }[score]()
    function, options = getattr(ranking, score), ranking.Options(steps=60)
    weights = ranking.fit(function, weights, [choice() for _ in range(20)], options, 0.02)
    for x in (choice() for _ in range(10)):
        assert x.right[np.argmax(function(weights, *x[:3]))]
