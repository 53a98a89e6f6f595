"""Scans in the plane: floor plans, contours, a lidar that turns, against poses that are known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.geometry import trees
from jaxreg.scans import correlation, planes
from jaxreg.scans.config import RegisterConfig
from jaxreg.scans.pair import register
from tests.scenes import angle_deg

WALLS = np.array(
    [
        [[0, 0], [8, 0]], [[8, 0], [8, 3]], [[8, 3], [5, 3]], [[5, 3], [5, 6]], [[5, 6], [0, 6]],
        [[0, 6], [0, 0]], [[2, 2], [3, 2]], [[3, 2], [3, 3]],
    ],
    float,
)  # fmt: skip
OTHER_WALLS = np.array(
    [[[0, 0], [5, 1]], [[5, 1], [9, 6]], [[9, 6], [2, 9]], [[2, 9], [0, 0]], [[4, 4], [5, 6]]],
    float,
)


def walls(rng, lines=WALLS, noise=0.01, density=24):
    lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    points = [
        a + (b - a) * rng.random(int(density * length))[:, None]
        for (a, b), length in zip(lines, lengths, strict=True)
    ]
    points = np.concatenate(points)
    return points + rng.normal(size=points.shape) * noise


def contour(rng, count=900, noise=0.0):
    """A closed curve without symmetry: the outline of a stone."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, count))
    radius = 5 + np.cos(2 * angle) + 0.6 * np.sin(3 * angle) + 0.3 * np.cos(7 * angle + 1)
    points = np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None]
    return points + rng.normal(size=points.shape) * noise


def lidar(rng, at, lines=WALLS, beams=720, noise=0.01):
    """The first hits of beams all around a place, by intersecting every beam with every wall."""
    angle = np.arange(beams) * 2 * np.pi / beams + rng.uniform(0, 0.01)
    beam = np.column_stack([np.cos(angle), np.sin(angle)])
    a, side = lines[:, 0] - at, lines[:, 1] - lines[:, 0]
    cross = beam[:, None, 0] * side[None, :, 1] - beam[:, None, 1] * side[None, :, 0]
    with np.errstate(all="ignore"):
        far = (a[:, 0] * side[:, 1] - a[:, 1] * side[:, 0]) / cross
        along = (a[None, :, 0] * beam[:, 1:] - a[None, :, 1] * beam[:, :1]) / cross
    far = np.where((far > 0) & (along >= 0) & (along <= 1), far, np.inf).min(axis=1)
    return beam * (far + rng.normal(size=beams) * noise)[:, None]


def turn(degrees):
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix()


def moved(points, degrees, shift):
    return points @ turn(degrees)[:2, :2].T + shift


def assert_right(found, degrees, shift, points, *, angle=0.3, way=0.03):
    rotation = turn(degrees)
    assert angle_deg(found.rotation, rotation) < angle
    middle = np.append(points.mean(axis=0), 0)
    at = found.rotation @ middle + found.translation
    assert np.linalg.norm(at - rotation @ middle - [*shift, 0]) < way


@pytest.mark.parametrize("degrees", [40.0, -130.0])
def test_floor_plan(degrees, seed):
    rng = np.random.default_rng(seed)
    source, reference = walls(rng), moved(walls(rng), degrees, [1, -2])
    found = register(source, reference)
    assert_right(found, degrees, [1, -2], source)
    assert found.success
    assert found.weak_directions == ()
    np.testing.assert_allclose(found.rotation[2], [0, 0, 1], atol=1e-12)
    known = [0, 1, 5]
    np.testing.assert_array_equal(found.covariance[known], 0)
    assert np.all(np.linalg.eigvalsh(found.covariance[np.ix_([2, 3, 4], [2, 3, 4])]) > 0)


def test_heights_that_are_the_same_everywhere_are_kept(seed):
    rng = np.random.default_rng(seed)
    flat = walls(rng)
    source = np.column_stack([flat, np.full(len(flat), 1.5)])
    reference = np.column_stack([moved(walls(rng), 25, [0, 3]), np.full(len(flat), -2.0)])
    found = register(source, reference)
    assert found.success
    assert found.translation[2] == pytest.approx(-3.5)


def test_contour(seed):
    rng = np.random.default_rng(seed)
    source, reference = contour(rng, 700), moved(contour(rng, 900), 170, [30, 4])
    found = register(source, reference)
    assert_right(found, 170, [30, 4], source)
    assert found.success


def test_weights_decide_which_part_of_a_plan_counts(seed):
    """Where half of the lines moved by a little, the other half is right if the first hardly counts."""
    rng = np.random.default_rng(seed)
    source, reference = walls(rng), moved(walls(rng), 30, [1, 2])
    moved_part = source[:, 0] > 4
    changed = source + np.where(moved_part[:, None], [0.0, 0.04], 0.0)
    told = register(changed, reference, weights=np.where(moved_part, 1e-3, 1.0))
    plain = register(changed, reference)

    def error(found):
        middle = np.append(source[~moved_part].mean(axis=0), 0)
        at = found.rotation @ middle + found.translation
        return np.linalg.norm(at - turn(30) @ middle - [1, 2, 0])

    assert error(told) < 0.5 * error(plain)
    assert error(told) < 0.01


def test_free_space_in_the_plane(seed):
    """A place of two numbers is that of three; a pose that puts walls before what was seen says so."""
    rng = np.random.default_rng(seed)
    first, second = lidar(rng, np.array([1.5, 1.2])), lidar(rng, np.array([4.2, 2.0]))
    plain = register(first, second)
    found = register(first, second, viewpoint=(0.0, 0.0))
    assert found.probability > plain.probability
    again = register(first, second, viewpoint=([0.0, 0.0, 0.0], [0.0, 0.0]))
    np.testing.assert_array_equal(found.transformation, again.transformation)
    assert found.probability == again.probability
    wrong = np.eye(4)
    wrong[:3, :3] = turn(100)
    config = RegisterConfig(refine=None)
    told = register(first, second, initial=wrong, viewpoint=(0.0, 0.0), config=config)
    assert not told.success
    assert "in front of what the other scanner measured" in told.reason


def test_a_lidar_in_two_places(seed):
    rng = np.random.default_rng(seed)
    first, second = lidar(rng, np.array([1.5, 1.2])), lidar(rng, np.array([4.2, 2.0]))
    found = register(first, moved(second, 65, [0, 0]))
    # The second frame is about its own place: x + first = y + second.
    shift = turn(65)[:2, :2] @ np.array([1.5 - 4.2, 1.2 - 2.0])
    assert_right(found, 65, shift, first, angle=1, way=0.05)
    assert found.success


def test_another_floor_is_no_success(seed):
    rng = np.random.default_rng(seed)
    assert not register(walls(rng), walls(rng, OTHER_WALLS)).success


def test_a_rectangle_has_two_poses(seed):
    rng = np.random.default_rng(seed)
    corners = np.array([[0.0, 0], [6, 0], [6, 4], [0, 4]])
    box = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    found = register(walls(rng, box), moved(walls(rng, box), 20, [1, 1]))
    assert not found.success
    assert len(found.alternatives) >= 1


def test_a_corridor_may_be_slid_along(seed):
    rng = np.random.default_rng(seed)
    sides = np.array([[[0.0, 0], [20, 0]], [[0, 2], [20, 2]]])
    found = register(walls(rng, sides), walls(rng, sides), initial=np.eye(4))
    assert not found.success
    assert any(weak.kind == "translation" for weak in found.weak_directions)


def test_a_rough_pose_is_refined(seed):
    rng = np.random.default_rng(seed)
    source, reference = walls(rng), moved(walls(rng), 40, [1, -2])
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = turn(38), [1.1, -1.9, 0]
    found = register(source, reference, initial=start)
    assert_right(found, 40, [1, -2], source, way=0.02)
    assert found.converged


def test_covariance_covers_the_error():
    """Squared errors over the variances of the three unknowns: a mean of about one."""
    ratios = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        source, reference = walls(rng), walls(rng)
        found = register(source, reference, initial=np.eye(4))
        centre = np.append(reference.mean(axis=0), 0)
        shift = found.rotation @ centre + found.translation - centre
        angle = np.arctan2(found.rotation[1, 0], found.rotation[0, 0])
        error = np.array([angle, *shift[:2]])
        unknown = np.ix_([2, 3, 4], [2, 3, 4])
        ratios.append(error @ np.linalg.solve(found.covariance[unknown], error) / 3)
    assert 0.2 < np.mean(ratios) < 3


@pytest.mark.untyped
def test_two_columns_beside_three_are_a_mistake():
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="two coordinates a point"):
        register(rng.normal(size=(30, 2)), rng.normal(size=(30, 3)))


def test_correlation_finds_the_turn_and_shift(seed):
    rng = np.random.default_rng(seed)
    points = contour(rng, 400)
    spread = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    across = np.column_stack([-spread[:, 1], spread[:, 0]])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    rotation = turn(77)[:2, :2]
    source = correlation.Outline(points, across)
    reference = correlation.Outline(points @ rotation.T + [0.4, -0.3], across @ rotation.T)
    found = correlation.placed(source, reference, most=3)
    assert abs(np.degrees(found.turn[0]) - 77) < 1.5
    np.testing.assert_allclose(found.shift[0], [0.4, -0.3], atol=1.5 * found.cell)


def test_planes_find_the_pose_of_exact_planes(seed):
    """Three plates that meet: any small motion is found, whatever it is."""
    rng = np.random.default_rng(seed)
    plates = rng.uniform(0, 1, (900, 3))
    plates[:300, 0] = plates[300:600, 1] = plates[600:, 2] = 0
    rotation, shift = Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix(), [0.01, 0.02, -0.01]
    inner = plates[(np.sort(plates, axis=1)[:, 1] > 0.15) & (plates.max(axis=1) < 0.9)]
    source = (inner - shift) @ rotation
    found = planes.fitted(
        source,
        planes.Surface(plates, trees.Tree(plates)),
        planes.RigidTransform(np.eye(3), np.zeros(3)),
        np.geomspace(0.2, 0.02, 12),
        motions=np.eye(6),
    )
    np.testing.assert_allclose(found.pose.rotation, rotation, atol=1e-6)
    np.testing.assert_allclose(found.pose.translation, shift, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "told"), [([1.01, 1.01], "The source fits at 1.010"), ([1, -1], "mirrored")]
)
def test_a_plan_of_another_size_and_a_mirrored_one_are_told(change, told, seed):
    rng = np.random.default_rng(seed)
    reference = moved(walls(rng) * np.array(change), 60, [5, -3])
    found = register(walls(rng), reference)
    assert not found.success
    assert told in found.reason


def test_another_axis_than_that_of_the_plane_is_refused(seed):
    rng = np.random.default_rng(seed)
    source, reference = walls(rng), moved(walls(rng), 20, [1, 2])
    with pytest.raises(ValueError, match="a turn is about z"):
        register(source, reference, known="upright", up="y")
