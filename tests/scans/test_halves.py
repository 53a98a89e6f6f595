"""What the two halves of an overlap say of the covariance of a pose."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxreg.data.procedural.surfaces import box, sample, union
from jaxreg.refine.kdtree import index_cloud
from jaxreg.scans import halves
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from jaxreg.scans.result import matrix_of
from jaxreg.types import RigidTransform
from tests.scenes import shape

NONE = RegisterConfig(halves=False, wide=None)
SOME = RegisterConfig(wide=None)


def definite(rng):
    root = rng.normal(size=(6, 6))
    return root @ root.T + np.eye(6)


def test_halves_that_differ_as_they_should_widen_nothing(seed):
    """Differences drawn from the covariance itself, many of them: they say what it says."""
    rng = np.random.default_rng(seed)
    covariance = definite(rng)
    found = rng.multivariate_normal(np.zeros(6), covariance, size=3000)
    np.testing.assert_array_equal(halves.widened(covariance, found, 6), covariance)
    np.testing.assert_array_equal(halves.widened(covariance, found[:0], 6), covariance)


def test_the_covariance_grows_with_what_it_did_not_say(seed):
    """In units in which it is the identity: everywhere by a half, and more in the direction seen."""
    rng = np.random.default_rng(seed)
    covariance, along = definite(rng), np.eye(6)[0]
    root = np.linalg.cholesky(covariance)
    found = (root @ along * 30)[None]
    units = np.linalg.inv(root)
    wider = units @ halves.widened(covariance, found, 6) @ units.T
    ratio = 30**2 / 6
    more = (1 - 4 / ratio) / 2
    expected = (1 + more * ratio) * np.eye(6) + more * 900 * np.outer(along, along)
    np.testing.assert_allclose(wider, expected, rtol=1e-6, atol=1e-9)


def test_differences_are_half_of_the_motion_between_the_poses_of_two_halves(seed, monkeypatch):
    """Matrices: A B^-1, whatever the refinement finds; each point is in one of two halves."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(4, rng=rng).as_matrix()
    poses = RigidTransform(turns, rng.normal(size=(4, 3)))
    points = rng.normal(size=(300, 3)) * [3, 2, 1]
    source, reference = (index_cloud(x, k=8) for x in (points, points[points[:, 0] < 2]))
    given = {}

    def iterate_all(*_, counted, **options):
        given["counted"] = counted
        return poses

    monkeypatch.setattr(halves, "iterate_all", iterate_all)
    start = RigidTransform(np.eye(3), np.zeros(3))
    found = halves.differences(source, reference, start, distance=1e-3, motions=None)
    assert found.shape == (2, 6)
    matrices = matrix_of(poses)
    for k, motion in enumerate(found):
        between = matrices[k] @ np.linalg.inv(matrices[2 + k])
        turn = Rotation.from_matrix(between[:3, :3]).as_rotvec()
        np.testing.assert_allclose(2 * motion, [*turn, *between[:3, 3]], atol=1e-9)
    first, second = given["counted"][:2, :300], given["counted"][2:, :300]
    np.testing.assert_array_equal(first, ~second)
    assert not given["counted"][:, 300:].any()
    shared = points[:, 0] < 2
    for half in first:
        assert abs(int(half[shared].sum()) - int((~half)[shared].sum())) <= 1
    # Across the longest axis of what they share, then across the next one.
    for half, axis in zip(first, (0, 1), strict=True):
        ends = np.abs(points[:, axis]) > np.quantile(np.abs(points[:, axis]), 0.9)
        sides = points[ends & shared, axis] > 0
        assert np.mean(sides == half[ends & shared]) in (0.0, 1.0) or axis == 0


def plate():
    """Keys on a board that is thinner than its points lie apart."""
    keys = [
        box((0.05, 0.05, 0.03), (-0.4 + 0.1 * i, -0.12 + 0.08 * j, 0.02))
        for i in range(9)
        for j in range(4)
        if i * j % 3 != 1
    ]
    return union(box((1.0, 0.4, 0.02)), *keys)


def bent(points):
    """A drift of two degrees over a fragment two metres long, by which its ends turn apart."""
    turns = Rotation.from_rotvec(np.outer(np.deg2rad(points[:, 0]), [0, 0, 1]))
    return turns.apply(points)


def room():
    """A floor and two walls with pillars of unlike sizes."""
    parts = [box((2.0, 1.2, 0.02)), box((2.0, 0.02, 0.8), (0, 0.6, 0.4))]
    parts.append(box((0.02, 1.2, 0.8), (1.0, 0, 0.4)))
    for k in range(6):
        size = (0.08 + 0.02 * k, 0.1, 0.2 + 0.05 * k)
        parts.append(box(size, (-0.9 + 0.33 * k, -0.4 + 0.15 * (k % 4), size[2] / 2)))
    return union(*parts)


@pytest.mark.parametrize(
    ("surface", "count", "warp"),
    [(plate(), 500, None), (room(), 3000, bent)],
    ids=["thin", "warped"],
)
def test_what_is_wrong_with_a_region_widens_the_covariance(surface, count, warp):
    """Monte Carlo over the sampling: the squared error in units of the covariance, of 12 pairs."""
    rng = np.random.default_rng(5)
    told = {NONE: [], SOME: []}
    for _ in range(12):
        source, reference = (sample(rng, surface, count) for _ in range(2))
        source = source if warp is None else warp(source)
        # A half of the scene: what a fragment bends by is then no rotation about its middle.
        source = source[source[:, 0] > -0.2] if warp is not None else source
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
    assert after < 0.85 * before


def test_a_pose_is_the_same_and_its_covariance_no_smaller(seed):
    rng = np.random.default_rng(seed)
    source, reference = shape(rng, 900), shape(rng, 900)
    plain, wider = (
        register(source, reference, initial=np.eye(4), config=config) for config in (NONE, SOME)
    )
    np.testing.assert_array_equal(plain.transformation, wider.transformation)
    assert np.linalg.eigvalsh(wider.covariance - plain.covariance).min() > -1e-12


def test_a_small_overlap_is_not_halved(seed):
    rng = np.random.default_rng(seed)
    points = shape(rng, 400)
    apart = points + [5, 0, 0]
    assert cKDTree(points).query(apart)[0].min() > 1
    source, reference = (index_cloud(x, k=8) for x in (points, apart))
    start = RigidTransform(np.eye(3), np.zeros(3))
    found = halves.differences(source, reference, start, distance=0.1, motions=None)
    assert found.shape == (0, 6)
