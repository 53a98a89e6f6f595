"""What is known of a pair: arguments, turns about an axis, and poses that keep to it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural import shapes
from jaxreg.scans import known
from jaxreg.scans.pair import register
from jaxreg.types import RigidTransform
from tests.scenes import angle_deg, moved

AXIS = np.array([1.0, 2.0, -2.0]) / 3


def test_turns_are_those_of_scipy(seed):
    angles = np.random.default_rng(seed).uniform(-3, 3, 5)
    expected = Rotation.from_rotvec(angles[:, None] * AXIS).as_matrix()
    np.testing.assert_allclose(known.turns_about(AXIS, angles), expected, atol=1e-14)


def test_the_best_turn_is_the_best_of_all(seed):
    rng = np.random.default_rng(seed)
    moment = rng.normal(size=(1, 3, 3))
    angle = known.best_turn(moment, AXIS)
    grid = np.linspace(-np.pi, np.pi, 2001)
    values = np.einsum("bij,ij->b", known.turns_about(AXIS, grid), moment[0])
    best = np.sum(known.turns_about(AXIS, angle)[0] * moment[0])
    assert best >= values.max() - 1e-12


def test_a_pose_is_turned_about_the_axis_alone(seed):
    facts = known.known_of("upright", AXIS, None)
    turn = Rotation.from_rotvec(0.7 * AXIS)
    tilt = Rotation.from_rotvec(np.random.default_rng(seed).normal(size=3) * 0.01)
    pose = facts.allowed(RigidTransform((tilt * turn).as_matrix(), np.zeros(3)))
    np.testing.assert_allclose(pose.rotation @ AXIS, AXIS, atol=1e-12)
    assert angle_deg(pose.rotation, turn.as_matrix()) < 2


def test_conditional_covariance_is_that_of_the_others_fixed(seed):
    """Schur: of a normal distribution whose tilt is known, the rest is normal with this covariance."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(6, 6))
    covariance = factor @ factor.T
    free, fixed = [2, 3, 4, 5], [0, 1]
    block = covariance[np.ix_(free, fixed)] @ np.linalg.inv(covariance[np.ix_(fixed, fixed)])
    expected = covariance[np.ix_(free, free)] - block @ covariance[np.ix_(fixed, free)]
    found = known.known_of("upright", "z", None).conditional(covariance)
    np.testing.assert_allclose(found[np.ix_(free, free)], expected, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found[fixed], 0, atol=1e-12)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"known": "level"}, "'upright', 'inside' or both"),
        ({"known": ("upright", "flat")}, "got 'flat'"),
        ({"known": "upright", "up": "w"}, "'x', 'y', 'z' or a vector"),
        ({"known": "upright", "up": [0.0, 0, 0]}, "a vector of three numbers"),
    ],
)
@pytest.mark.untyped
def test_what_does_not_exist_is_refused(options, told):
    with pytest.raises(ValueError, match=told):
        register(np.eye(3), np.eye(3), **options)


@pytest.mark.parametrize("up", ["z", "y", (1.0, 2.0, -2.0)])
def test_level_scans_are_turned_about_the_axis(up, seed):
    cloud = shapes.sample_shape(5, 10, points=1000).astype(np.float64)
    source, reference = cloud[:500], cloud[500:]
    axis = known.known_of("upright", up, None).up
    rotation = Rotation.from_rotvec(np.radians(140) * axis).as_matrix()
    shift = np.random.default_rng(seed).uniform(-2, 2, 3)
    found = register(source, moved(reference, rotation, shift), known="upright", up=up)
    assert angle_deg(found.rotation, rotation) < 2
    np.testing.assert_allclose(found.rotation @ axis, axis, atol=1e-5)
    across = np.linalg.svd(axis[None])[2][1:]
    np.testing.assert_allclose(across @ found.covariance[:3], 0, atol=1e-9)
    assert found.success


def test_a_start_beyond_the_limit_is_refused():
    cloud = shapes.sample_shape(5, 10, points=300).astype(np.float64)
    start = np.eye(4)
    start[:3, :3] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    with pytest.raises(ValueError, match="initial turns by 90 degrees, more than max_rotation_deg"):
        register(cloud, cloud, initial=start, max_rotation_deg=30)


def test_a_pose_beyond_the_limit_is_no_success():
    """Exact copies: the one pose that fits turns by 40 degrees."""
    cloud = shapes.sample_shape(5, 10, points=600).astype(np.float64)
    turn = Rotation.from_euler("x", 40, degrees=True).as_matrix()
    found = register(cloud, moved(cloud, turn, np.zeros(3)), max_rotation_deg=10)
    assert not found.success
    assert found.probability == 0
    assert found.reason
    assert register(cloud, moved(cloud, turn, np.zeros(3)), max_rotation_deg=45).success


def test_an_axis_that_is_not_known_to_be_upright_is_an_error():
    points = np.eye(3)
    for up in ("y", (0.0, 1.0, 1.0)):
        with pytest.raises(ValueError, match="pass known='upright' as well"):
            register(points, points, up=up)
    assert known.known_of(None, "z", None).up is None
