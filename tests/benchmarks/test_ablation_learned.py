"""Rows of the ablation on given features: with right matches, each must find the pose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import frame
from jaxreg.types import RigidTransform
from research import ablation_learned

pytestmark = pytest.mark.loose  # The network's weights are of float32.


@pytest.mark.slow
@pytest.mark.parametrize("row", ablation_learned.ROWS.values(), ids=list(ablation_learned.ROWS))
def test_every_row_finds_the_pose_of_exact_matches(row, seed):
    rng = np.random.default_rng(seed)
    turn, shift = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    x = rng.normal(size=(300, 3))
    order = rng.permutation(300)
    y = (x @ turn.T + shift)[order]
    # Cosine 1 for the copy of a point, 0 for all others.
    cosines = (np.arange(300)[:, None] == order[None, :]).astype(float)
    where = frame.Frame(jnp.zeros(3), jnp.zeros(3), jnp.ones(()))
    described = ablation_learned.Described(*map(jnp.asarray, (x, y, cosines)), where)
    weights = ablation_learned.init_weights(jax.random.key(seed))
    weights["log_sharpness"] = jnp.log(200.0)
    pose, _ = ablation_learned.register_step(weights, described, row, train=False)
    assert isinstance(pose, RigidTransform)
    np.testing.assert_allclose(pose.rotation, turn, atol=1e-6)
    np.testing.assert_allclose(pose.translation, shift, atol=1e-6)
