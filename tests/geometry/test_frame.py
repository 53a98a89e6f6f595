"""The frame of a refinement: where its clouds lie, and that transforms go in and out of it."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import arguments, frame, rigid
from jaxreg.types import RigidTransform


def test_clouds_beyond_any_number_apart_stay_finite():
    where = frame.Frame(np.full(3, 1e200), np.zeros(3), 1e-200)
    shift = frame.transform_in(where, RigidTransform(np.eye(3), np.zeros(3))).translation
    assert np.isfinite(shift**2).all()
    assert (shift > 1e100).all()


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
        arguments.clouds(jnp.zeros((5, 3)), jnp.zeros(shape))


@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_measures_of_a_cloud_on_the_host(offset, seed):
    points = np.random.default_rng(seed).normal(size=(50, 3)) * 3.0
    centre, radius = frame.measure(points + offset)
    np.testing.assert_allclose(centre, points.mean(axis=0) + offset, rtol=1e-14)
    expected = np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1)))
    assert radius == pytest.approx(expected, rel=1e-8)


def test_rounding_of_an_offset_is_no_spread():
    points = np.full((10, 3), 5e6)
    points[::2] += 1e-9
    assert frame.measure(points)[1] == 0


def test_host_and_device_agree_on_the_frame(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(20, 3)), 3 * rng.normal(size=(30, 3)) + 1.0
    (source_centre, s), (reference_centre, r) = frame.measure(x), frame.measure(y)
    where = frame.Frame(source_centre, reference_centre, np.sqrt((s**2 + r**2) / 2))
    device, _, _ = frame.enter(jnp.asarray(x), jnp.asarray(y), None, None)
    for one, other in zip(where, device, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    turn = Rotation.random(rng=rng).as_matrix()
    pose = RigidTransform(turn, rng.normal(size=3))
    inner = frame.transform_in(where, pose)
    assert inner.translation.dtype == np.float64
    moved = (x - where.source_centre) / where.length @ inner.rotation.T + inner.translation
    expected = (x @ turn.T + pose.translation - where.reference_centre) / where.length
    np.testing.assert_allclose(moved, expected, atol=1e-12)
    np.testing.assert_allclose(
        frame.transform_out(where, inner).translation, pose.translation, atol=1e-12
    )
    on_device = frame.transform_in(device, RigidTransform(*map(jnp.asarray, pose)))
    np.testing.assert_allclose(on_device.translation, inner.translation, atol=1e-12)
