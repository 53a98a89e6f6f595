"""The frame of a refinement: where its clouds lie, and that transforms go in and out of it."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import frame, rigid
from jaxreg.types import RigidTransform


def test_clouds_are_centred_and_of_unit_radius(seed):
    rng = np.random.default_rng(seed)
    x, y = 5 + 3 * rng.normal(size=(40, 3)), -7 + 2 * rng.normal(size=(30, 3))
    where, inner_x, inner_y = frame.enter(jnp.asarray(x), jnp.asarray(y), None, None)
    np.testing.assert_allclose(inner_x.mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(inner_y.mean(0), 0, atol=1e-12)
    squares = (np.square(inner_x).sum(1).mean(), np.square(inner_y).sum(1).mean())
    np.testing.assert_allclose(sum(squares) / 2, 1)
    np.testing.assert_allclose(inner_x * where.length + where.source_centre[None], x)


def test_transform_goes_in_and_out(seed):
    rng = np.random.default_rng(seed)
    x, y = (jnp.asarray(rng.normal(size=(20, 3)) + 9) for _ in range(2))
    rotation = jnp.asarray(Rotation.random(random_state=seed).as_matrix())
    pose = RigidTransform(rotation, jnp.asarray(rng.normal(size=3)))
    where, inner_x, _ = frame.enter(x, y, None, None)
    inner = frame.transform_in(where, pose)
    expected = (rigid.apply(pose, x) - where.reference_centre[None]) / where.length
    np.testing.assert_allclose(rigid.apply(inner, inner_x), expected, atol=1e-12)
    back = frame.transform_out(where, inner)
    np.testing.assert_allclose(back.rotation, pose.rotation, atol=1e-12)
    np.testing.assert_allclose(back.translation, pose.translation, atol=1e-12)


def test_single_points_have_unit_length():
    where, x, _ = frame.enter(jnp.ones((1, 3)), jnp.ones((2, 3)), None, None)
    assert where.length == 1
    assert not x.any()


@pytest.mark.parametrize("shape", [(2, 5, 3), (0, 3), (5, 2), (3,)])
def test_wrong_shapes_are_named(shape):
    with pytest.raises(ValueError, match=r"reference must have shape \(n, 3\)"):
        frame.check_clouds(jnp.zeros((5, 3)), jnp.zeros(shape))
