"""What features are learned by: a loss that right matches lower, inputs that no rotation changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import learned_features as learned
from jaxreg.data import shapes
from jaxreg.neighbors import squared_distances

pytestmark = pytest.mark.loose


def test_the_loss_is_zero_for_right_matches_alone_and_ignores_what_is_neither(seed):
    rng = np.random.default_rng(seed)
    points = jnp.asarray(rng.permutation(np.linspace(-1, 1, 9))[:, None] * np.ones(3))
    squared = squared_distances(points, points)  # 0.4 and more between any two.
    perfect = 2 * jnp.eye(9) - 1
    loss = jax.jit(learned.contrastive_loss)
    assert loss(perfect, 50.0, squared) < 1e-6
    assert loss(jnp.roll(perfect, 1, axis=0), 50.0, squared) > 50
    # A point 0.1 from its match is neither right nor wrong, however alike it looks.
    near = squared.at[0, 1].set(0.1**2)
    assert loss(perfect.at[0, 1].set(1.0), 50.0, near) < 1e-6
    # A chance match among nine costs log 9, in each direction.
    np.testing.assert_allclose(loss(jnp.zeros((9, 9)), 50.0, squared), 2 * np.log(9), rtol=1e-5)


def test_learned_features_know_nothing_of_the_pose(seed):
    rng = np.random.default_rng(seed)
    # Dense enough that every point has neighbours, or its normal is arbitrary.
    x, y = (jnp.asarray(shapes.sample_shape(seed, i, points=700)) for i in range(2))
    turn = jnp.asarray(Rotation.random(random_state=rng).as_matrix())
    module = learned.Network(8)
    weights = module.init(
        jax.random.key(seed), jnp.zeros((90, 49)), jnp.zeros((90, 3)), jnp.zeros((90, 3))
    )
    found = jax.jit(lambda a, b: learned.similarity(module, weights, a, b)[0])
    here, there = found(x, y), found(x @ turn.T + 0.5, y)
    assert np.ptp(here) > 0.01
    np.testing.assert_allclose(there, here, atol=2e-3)
