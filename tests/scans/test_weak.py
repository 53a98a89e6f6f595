"""Motions that a pair hardly resists: symmetric bodies from a start, and what few points hold."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from tests.scenes import angle_deg, moved, revolved


def vase(rng, count):
    angle, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1, 1, count)
    radius = 0.5 + 0.15 * np.sin(3 * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def plate(rng, count):
    """A plate with two bumps: all that holds the pose in the plate."""
    xy = rng.uniform(-5, 5, (count, 2))
    z = 0.3 * np.exp(-((xy - [1.2, -0.8]) ** 2).sum(1) / 0.5)
    z += 0.2 * np.exp(-((xy - [-2, 2]) ** 2).sum(1) / 0.2)
    return np.column_stack([xy, z])


def two(form, count, seed, noise=0.003):
    """Two samplings of a form, with noise."""
    rng = np.random.default_rng(seed)
    return [(cloud := form(rng, count)) + rng.normal(size=cloud.shape) * noise for _ in range(2)]


@pytest.mark.parametrize(
    ("form", "options"),
    [
        (vase, {"initial": np.eye(4)}),
        (vase, {"max_rotation_deg": 15}),
        (lambda rng, n: revolved(rng, "sphere", n), {"initial": np.eye(4)}),
    ],
)
def test_a_body_that_turns_freely_has_other_poses_from_a_start_too(form, options, seed):
    source, reference = two(form, 2000, seed)
    rotation = Rotation.from_euler("z", 8, degrees=True).as_matrix()
    found = register(source, moved(reference, rotation, [0.02, 0.01, -0.02]), **options)
    assert not found.success
    assert found.alternatives
    for other in found.alternatives:
        # Every turn about the axis is as right: the axis itself stays where it is.
        axis = other.transform.rotation[2, 2]
        assert form is not vase or axis > np.cos(np.radians(4))


def test_a_pose_that_stopped_too_early_goes_on_along_what_holds_little(seed):
    source, reference = two(plate, 15_000, seed)
    rotation = Rotation.from_euler("xyz", [0.5, -0.4, 2], degrees=True).as_matrix()
    shift = np.array([0.2, 0.16, 0.04])
    once = dataclasses.replace(RegisterConfig().refine, iterations=1)
    config = RegisterConfig(refine=once)
    found = register(source, moved(reference, rotation, shift), initial=np.eye(4), config=config)
    assert found.success
    assert angle_deg(found.rotation, rotation) < 0.3
    np.testing.assert_allclose(found.translation, shift, atol=0.02)
