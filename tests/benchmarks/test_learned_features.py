"""What features are learned by: a loss that right matches lower, and steps that lower it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxreg.data.procedural import shapes
from jaxreg.geometry.neighbors import squared_distances
from research import train_features as learned

pytestmark = pytest.mark.loose
ALL = jnp.ones(9, bool)


def test_the_loss_is_zero_for_right_matches_alone_and_ignores_what_is_neither(seed):
    rng = np.random.default_rng(seed)
    points = jnp.asarray(rng.permutation(np.linspace(-1, 1, 9))[:, None] * np.ones(3))
    squared = squared_distances(points, points)  # 0.4 and more between any two.
    perfect = 2 * jnp.eye(9) - 1
    loss = jax.jit(learned.contrastive_loss)
    assert loss(perfect, 50.0, squared, ALL, ALL) < 1e-6
    assert loss(jnp.roll(perfect, 1, axis=0), 50.0, squared, ALL, ALL) > 50
    # A point 0.1 from its match is neither right nor wrong, however alike it looks.
    near = squared.at[0, 1].set(0.1**2)
    assert loss(perfect.at[0, 1].set(1.0), 50.0, near, ALL, ALL) < 1e-6
    # Neither does padding.
    wrong = perfect.at[:, 3].set(1.0)
    assert loss(wrong, 50.0, squared, ALL, ALL) > 0.5
    assert loss(wrong, 50.0, squared, ALL.at[3].set(False), ALL.at[3].set(False)) < 1e-6
    # A chance match among nine costs log 9, in each direction.
    np.testing.assert_allclose(
        loss(jnp.zeros((9, 9)), 50.0, squared, ALL, ALL), 2 * np.log(9), rtol=1e-5
    )


@pytest.mark.slow
def test_training_finds_more_true_matches_than_the_moments():
    """The reason for all of it, on shapes that were not trained on."""
    options = learned.Options(shapes=60, steps=90, test_pairs=6)
    clouds = np.stack([shapes.sample_shape(0, i, points=2048) for i in range(options.shapes)])
    fresh = [shapes.sample_shape(1, i, points=2048) for i in range(options.test_pairs)]
    shares = [
        np.mean([row[0] for row in learned.test(learned.search(name, w), fresh, options).values()])
        for name, w in (("moments", None), ("linear", learned.fit("linear", clouds, options)))
    ]
    assert shares[1] > shares[0]
