"""Poses from correspondences that are mostly wrong."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.search.compatibility import hypotheses

pytestmark = [pytest.mark.slow]


def correspondences(rng, count, right, noise=0.005):
    turn, shift = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
    source, reference = rng.normal(size=(2, count, 3))
    reference[:right] = source[:right] @ turn.T + shift + noise * rng.normal(size=(right, 3))
    return source, reference, turn, shift


@pytest.mark.parametrize("right", [30, 60, 150])
def test_right_pose_among_wrong_correspondences(seed, right):
    rng = np.random.default_rng(seed)
    source, reference, turn, shift = correspondences(rng, 300, right)
    poses, support = hypotheses(
        jnp.asarray(source),
        jnp.asarray(reference),
        jnp.ones(300, bool),
        tolerance=0.05,
        seeds=16,
        partners=10,
    )
    best = int(np.argmax(support))
    error = Rotation.from_matrix(np.asarray(poses.rotation[best]) @ turn.T).magnitude()
    assert np.degrees(error) < 1
    np.testing.assert_allclose(poses.translation[best], shift, atol=0.03)
    assert right * 0.6 < support[best] < right * 1.3


def test_masked_rows_change_nothing(seed):
    rng = np.random.default_rng(seed)
    source, reference, _, _ = correspondences(rng, 80, 30)
    options = {"tolerance": 0.05, "seeds": 4, "partners": 8}
    plain, _ = hypotheses(
        jnp.asarray(source), jnp.asarray(reference), jnp.ones(80, bool), **options
    )
    source, reference = (np.concatenate([x, x[:20] + 1]) for x in (source, reference))
    padded, _ = hypotheses(
        jnp.asarray(source), jnp.asarray(reference), jnp.arange(100) < 80, **options
    )
    np.testing.assert_allclose(padded.rotation[0], plain.rotation[0], atol=1e-6)


def test_degenerate_correspondences_are_finite():
    zero = jnp.zeros((40, 3))
    for mask in (jnp.ones(40, bool), jnp.zeros(40, bool)):
        poses, support = hypotheses(zero, zero, mask, tolerance=0.1, seeds=4, partners=8)
        assert np.isfinite(poses.rotation).all()
        assert np.isfinite(support).all()
        np.testing.assert_allclose(np.linalg.det(poses.rotation), 1, atol=1e-6)
