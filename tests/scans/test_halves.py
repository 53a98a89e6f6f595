"""What halves of two clouds say of the covariance of a pose."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.surfaces import box, sample, union
from jaxreg.refine.config import RefineConfig
from jaxreg.scans import halves
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from jaxreg.scans.prepare import Level
from jaxreg.scans.result import matrix_of
from jaxreg.types import RigidTransform
from tests.scenes import shape

NONE = RegisterConfig(halvings=0, wide=None)
SOME = dataclasses.replace(NONE, halvings=2)


def definite(rng):
    root = rng.normal(size=(6, 6))
    return root @ root.T + np.eye(6)


def test_halves_that_differ_as_they_should_widen_nothing(seed):
    """Differences drawn from the covariance itself, many of them: they say what it says."""
    rng = np.random.default_rng(seed)
    covariance = definite(rng)
    found = rng.multivariate_normal(np.zeros(6), covariance, size=3000)
    np.testing.assert_array_equal(halves.widened(covariance, found, 6), covariance)


def test_the_covariance_grows_with_what_it_did_not_say(seed):
    """In units in which it is the identity: everywhere by a half, and more in the direction seen."""
    rng = np.random.default_rng(seed)
    covariance, along = definite(rng), np.eye(6)[0]
    root = np.linalg.cholesky(covariance)
    found = (root @ along * 30)[None]
    units = np.linalg.inv(root)
    wider = units @ halves.widened(covariance, found, 6) @ units.T
    ratio = 30**2 / 6
    more = 0.3 * (1 - 1.5 / ratio) / 2
    expected = (1 + more * ratio) * np.eye(6) + more * 900 * np.outer(along, along)
    np.testing.assert_allclose(wider, expected, rtol=1e-6, atol=1e-9)


def test_differences_are_half_of_the_motion_between_the_poses_of_two_halves(seed, monkeypatch):
    """Matrices: A B^-1, whatever the refinement finds; each point is in one of two halves."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(4, rng=rng).as_matrix()
    poses = [RigidTransform(turn, rng.normal(size=3)) for turn in turns]
    levels = tuple(Level(rng.normal(size=(count, 3)), None, 8) for count in (90, 71))
    given = []

    def iterate(pose, source, reference, *_, **options):
        given.append((source, reference))
        return (poses[len(given) - 1],)

    monkeypatch.setattr(halves, "iterate", iterate)
    options = {"halvings": 2, "distance": 1.0, "config": RefineConfig(), "motions": None}
    found = halves.differences(levels, (2.0, 3.0), poses[0], **options)
    for k, motion in enumerate(found):
        one, other = (matrix_of(pose) for pose in poses[2 * k : 2 * k + 2])
        between = one @ np.linalg.inv(other)
        turn = Rotation.from_matrix(between[:3, :3]).as_rotvec()
        np.testing.assert_allclose(2 * motion, [*turn, *between[:3, 3]], atol=1e-9)
        for side, level in enumerate(levels):
            parts = [given[2 * k + half][side] for half in (0, 1)]
            assert abs(len(parts[0].points) - len(parts[1].points)) <= 1
            both = np.concatenate([part.points for part in parts])
            np.testing.assert_array_equal(np.sort(both, axis=0), np.sort(level.points, axis=0))
            assert {part.scale for part in parts} == {(2.0, 3.0)[side]}
    assert not np.array_equal(given[0][0].points, given[2][0].points)


def plate():
    """Keys on a board that is thinner than its points lie apart."""
    keys = [
        box((0.05, 0.05, 0.03), (-0.4 + 0.1 * i, -0.12 + 0.08 * j, 0.02))
        for i in range(9)
        for j in range(4)
        if i * j % 3 != 1
    ]
    return union(box((1.0, 0.4, 0.02)), *keys)


def test_a_coarsely_sampled_plate_is_known_less_well_than_its_residuals_say():
    """Monte Carlo over the sampling: the squared error in units of the covariance, of 16 pairs."""
    rng, surface = np.random.default_rng(5), plate()
    told = {NONE: [], SOME: []}
    for _ in range(16):
        source, reference = (sample(rng, surface, 500) for _ in range(2))
        for config, nees in told.items():
            found = register(source, reference, initial=np.eye(4), config=config)
            centre = reference.mean(axis=0)
            moved = found.rotation @ centre + found.translation
            error = np.concatenate(
                [Rotation.from_matrix(found.rotation).as_rotvec(), moved - centre]
            )
            nees.append(error @ np.linalg.solve(found.covariance, error) / 6)
    before, after = (np.mean(values) for values in told.values())
    assert before > 4
    assert after < 0.75 * before


def test_a_pose_is_as_before_and_clouds_of_more_points_are_not_halved(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    source, reference = shape(rng, 900), shape(rng, 900)
    plain, wider = (
        register(source, reference, initial=np.eye(4), config=config) for config in (NONE, SOME)
    )
    np.testing.assert_array_equal(plain.transformation, wider.transformation)
    assert np.linalg.eigvalsh(wider.covariance - plain.covariance).min() > -1e-12
    monkeypatch.setattr(halves, "MOST", 800)
    monkeypatch.setattr(halves, "differences", None)
    found = register(source, reference, initial=np.eye(4), config=SOME)
    np.testing.assert_array_equal(found.covariance, plain.covariance)


def test_a_number_of_halvings_is_not_negative():
    with pytest.raises(ValueError, match=r"config\.halvings must not be negative, got -1"):
        register(np.eye(3), np.eye(3), config=RegisterConfig(halvings=-1))
