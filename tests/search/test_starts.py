"""The covering of the rotations, and multi-start ICP."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data import shapes
from jaxreg.search.starts import multi_start, rotation_covering, truncated_residual
from jaxreg.types import RigidTransform

pytestmark = [pytest.mark.slow]


def test_no_rotation_is_far_from_the_covering(seed):
    covering = Rotation.from_matrix(rotation_covering(576)).as_quat()
    drawn = Rotation.random(2000, random_state=seed).as_quat()
    gap = 2 * np.arccos(np.minimum(np.abs(drawn @ covering.T).max(axis=1), 1))
    assert np.degrees(gap.max()) < 30
    assert np.degrees(np.median(gap)) < 17


def test_identity_first_and_limit_kept():
    covering = rotation_covering(576, largest_deg=60)
    np.testing.assert_array_equal(covering[0], np.eye(3))
    assert np.degrees(Rotation.from_matrix(covering).magnitude()).max() <= 60 + 1e-6
    assert 10 < len(covering) < 60


def test_truncated_residual_against_a_loop(seed):
    rng = np.random.default_rng(seed)
    x, y, limit = rng.normal(size=(20, 3)), rng.normal(size=(30, 3)), 0.8
    distance = np.linalg.norm(x[:17, None] - y[None, :25], axis=2)
    parts = [np.minimum(distance.min(axis=a), limit) ** 2 / limit**2 for a in (0, 1)]
    found = truncated_residual(
        RigidTransform(jnp.eye(3), jnp.zeros(3)),
        jnp.asarray(x),
        jnp.asarray(y),
        jnp.arange(20) < 17,
        jnp.arange(30) < 25,
        limit,
    )
    assert found == pytest.approx(np.mean(np.concatenate(parts)))


def test_multi_start_finds_a_large_rotation():
    cloud = shapes.sample_shape(5, 9, points=400).astype(np.float64)
    turn = Rotation.from_euler("xyz", [150, -40, 70], degrees=True).as_matrix()
    poses, residual = multi_start(
        jnp.asarray(cloud[:200]),
        jnp.asarray(cloud[200:] @ turn.T + 3),
        jnp.asarray(rotation_covering(288)),
        jnp.ones(200, bool),
        jnp.ones(200, bool),
        limit=0.25,
        kept=8,
        iterations=8,
        trim=0.8,
    )
    error = Rotation.from_matrix(np.asarray(poses.rotation[0]) @ turn.T).magnitude()
    assert np.degrees(error) < 20
    assert np.all(np.diff(residual) >= 0)
