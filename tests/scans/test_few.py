"""Few points: poses by brute force, layouts that repeat themselves, points without a partner."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.scans import triples
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from tests.scenes import angle_deg, moved

SHIFT = np.array([100.0, 200.0, 3.0])


@pytest.fixture
def rng(seed):
    return np.random.default_rng(seed)


def targets(rng, count, size=(60.0, 60.0, 6.0)):
    return rng.uniform(0, 1, (count, 3)) * size


def turned(rng, points, noise=0.01, rotation=None):
    rotation = Rotation.random(random_state=rng).as_matrix() if rotation is None else rotation
    noisy = points + rng.normal(size=points.shape) * noise
    return rng.permutation(moved(noisy, rotation, SHIFT)), rotation


def off(found, rotation, points):
    """Degrees, and how far the middle of the points lies from where it should."""
    middle = points.mean(axis=0)
    at = found.rotation @ middle + found.translation
    return angle_deg(found.rotation, rotation), np.linalg.norm(at - rotation @ middle - SHIFT)


def by_brute_force(source, reference):
    """The rotation of the assignment of all points with the smallest residual (n! of them)."""

    def fit(order):
        x, y = source - source.mean(axis=0), reference[list(order)]
        rotation, residual = Rotation.align_vectors(y - y.mean(axis=0), x)
        return residual, rotation.as_matrix()

    return min(map(fit, itertools.permutations(range(len(source)))), key=lambda one: one[0])[1]


def test_targets_without_order_are_right_in_every_case():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        points = targets(rng, 4)
        reference, rotation = turned(rng, points)
        found = register(points, reference)
        angle, shift = off(found, rotation, points)
        assert found.success, seed
        assert angle < 0.5, seed
        assert shift < 0.05, seed
        assert angle_deg(found.rotation, by_brute_force(points, reference)) < 1e-3, seed


def test_some_are_missing_on_each_side(rng):
    points = targets(rng, 20, (20.0, 20.0, 20.0))
    others = targets(rng, 8, (20.0, 20.0, 20.0))
    reference, rotation = turned(rng, np.concatenate([points[:12], others]), noise=0.002)
    found = register(points, reference)
    assert off(found, rotation, points)[0] < 0.1
    assert found.success
    assert found.evidence.matched >= 12
    assert found.evidence.of == 20
    assert found.evidence.residual < 0.02


def test_clouds_of_different_counts_and_swapped(rng):
    points = targets(rng, 9)
    reference, rotation = turned(rng, points[:6])
    found, back = register(points, reference), register(reference, points)
    assert angle_deg(found.rotation, rotation) < 0.5
    np.testing.assert_allclose(back.transformation @ found.transformation, np.eye(4), atol=1e-6)


@pytest.mark.parametrize(
    ("layout", "poses"),
    [
        # Rotations that map the layout to itself: half turns of a rectangle about three axes, thirds
        # and half turns of a triangle, and all 24 of a cube.
        (np.array([[0.0, 0, 0], [10, 0, 0], [10, 20, 0], [0, 20, 0]]), 4),
        (np.array([[0.0, 0, 0], [10, 0, 0], [5, 75**0.5, 0]]), 6),
        (np.array(list(itertools.product([0.0, 7.0], repeat=3))), 24),
    ],
)
def test_layouts_that_repeat_themselves_have_alternatives(rng, layout, poses):
    reference, _ = turned(rng, layout, noise=0.001)
    found = register(layout, reference)
    assert not found.success
    assert len(found.alternatives) == poses - 1
    assert found.probability < 0.5
    assert "alternatives" in found.reason
    for pose in (found, *(other.transform for other in found.alternatives)):
        at = layout @ pose.rotation.T + pose.translation
        assert np.linalg.norm(at[:, None] - reference, axis=2).min(axis=1).max() < 0.01


def test_unrelated_points_are_no_success():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        found = triples.solutions(targets(rng, 8), targets(rng, 9))
        assert not found or found[0].log_odds < 0, seed


def test_the_evidence_counts_what_chance_gives():
    """Of unrelated points few reach what one in a thousand does: see `triples`."""
    chances = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        found = triples.solutions(targets(rng, 6), targets(rng, 6))
        chances.append(found[0].log_chance if found else np.inf)
    assert np.min(chances) > np.log(1e-3)


def test_points_on_a_line_leave_a_turn_free(rng):
    line = np.outer(np.sort(rng.uniform(0, 10, 7)), [1.0, 2, 2]) / 3
    reference, _ = turned(rng, line, noise=0.0)
    assert not register(line, reference, config=RegisterConfig(wide=None)).success


def test_level_points_turn_about_the_axis(rng):
    """Two of the poses of a rectangle are upside down."""
    layout = np.array([[0.0, 0, 0], [10, 0, 0], [10, 20, 0], [0, 20, 0], [3, 5, 0]])
    rotation = Rotation.from_euler("y", 140, degrees=True).as_matrix()
    upright = layout[:, [0, 2, 1]]
    reference, _ = turned(rng, upright, noise=0.001, rotation=rotation)
    found = register(upright, reference, known="upright", up="y")
    assert off(found, rotation, upright)[0] < 0.1
    np.testing.assert_allclose(found.rotation[1], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(found.covariance[[0, 2]], 0, atol=1e-15)
    assert found.success


def test_stems_on_a_plan(rng):
    """(n, 2): a mirrored layout is no turn in the plane."""
    stems = rng.uniform(0, 50, (30, 2))
    extra = rng.uniform(0, 50, (10, 2))
    angle = np.radians(75)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    reference = rng.permutation(np.concatenate([stems[:22], extra]) @ turn.T + [3, 4])
    reference = reference + rng.normal(size=reference.shape) * 0.02
    found = register(stems, reference)
    assert found.success
    np.testing.assert_allclose(found.rotation[:2, :2], turn, atol=0.002)
    assert not register(stems * [-1, 1], reference).success


def test_covariance_covers_the_error():
    """Squared errors over the variances: a mean of one for each of the six unknowns."""
    ratios = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        points = targets(rng, 10)
        reference, rotation = turned(rng, points, noise=0.02)
        found = register(points, reference)
        centre = reference.mean(axis=0)
        change = found.rotation @ rotation.T
        vector = Rotation.from_matrix(change).as_rotvec()
        shift = found.translation + change @ (centre - SHIFT) - centre
        error = np.concatenate([vector, shift])
        ratios.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert 0.6 < np.mean(ratios) < 1.8


def test_a_rough_pose_decides_between_alternatives(rng):
    layout = np.array([[0.0, 0, 0], [10, 0, 0], [10, 20, 0], [0, 20, 0]])
    half = Rotation.from_euler("z", 180, degrees=True)
    near = Rotation.from_euler("z", 181, degrees=True).as_matrix()
    reference = rng.permutation(moved(layout, half.as_matrix(), [10.0, 20, 0]))
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = near, [10.1, 20.1, 0]
    found = register(layout, reference, initial=start)
    np.testing.assert_allclose(found.rotation, half.as_matrix(), atol=1e-6)


def test_weights_of_a_few_points_are_refused(rng):
    source = targets(rng, 8)
    reference, _ = turned(rng, source)
    with pytest.raises(ValueError, match="weights need surfaces or lines"):
        register(source, reference, weights=np.arange(1.0, 9))
    left_out = np.r_[np.zeros(2), np.ones(6)]
    assert register(source, reference, weights=left_out).evidence.of == 6


def test_targets_in_the_plane_are_not_turned_over(rng):
    trapezoid = np.array([[0.0, 0], [10, 0], [7, 6], [3, 6]])
    turn = Rotation.from_euler("z", 20, degrees=True).as_matrix()[:2, :2]
    found = register(trapezoid, rng.permutation(trapezoid @ turn.T + 3.0))
    assert found.success
    np.testing.assert_allclose(found.rotation[:2, :2], turn, atol=1e-9)
    with pytest.raises(ValueError, match="a turn is about z"):
        register(trapezoid, trapezoid, known="upright", up="y")
    mirrored = rng.uniform(0, 10, (12, 2))
    assert not register(mirrored * [1, -1], rng.permutation(mirrored @ turn.T)).success


def test_mirrored_targets_of_which_some_fit_are_told(rng):
    points = targets(rng, 12)
    # Easting and northing in the wrong order: four targets near a mirror plane fit all the same.
    points[:4, 1] = points[:4, 0]
    reference, _ = turned(rng, points)
    found = register(points[:, [1, 0, 2]], reference)
    assert not found.success
    assert "mirrored" in found.reason
