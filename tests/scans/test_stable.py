"""Parts that moved: the part that stayed decides, and callers who know which it is may say so."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxreg.scans import masks, prepare, stable
from jaxreg.scans.known import Known
from jaxreg.scans.pair import register
from jaxreg.types import RigidTransform
from tests.scenes import angle_deg, moved

TILT = Rotation.from_euler("xyz", [0.1, 0.2, 1.5], degrees=True).as_matrix()
SHIFT = np.array([1.0, -2.0, 0.5])


def slope(rng, count, slid):
    """Rough ground 200 x 150, noise 0.03; in a third of it the surface slid down by `slid`."""

    def height(x, y):
        waves = 4 * np.sin(x / 18) * np.cos(y / 23) + 1.5 * np.sin(x / 5 + y / 7)
        return 0.35 * y + waves + 0.6 * np.sin(x / 2.3) * np.cos(y / 1.9)

    x, y = rng.uniform([0, 0], [200, 150], (count, 2)).T
    gone = in_slide(x, y)
    z = np.where(gone & (slid > 0), height(x, y + slid) - 0.3 * slid, height(x, y))
    return np.column_stack([x, y, z]) + rng.normal(size=(count, 3)) * 0.03


def in_slide(x, y):
    return (x > 80) & (x < 170) & (y > 20) & (y < 130)


def felled(rng, count, gone):
    """A wavy floor with 30 stems; the first `gone` of them are not there."""
    floor = rng.uniform(0, 40, (count, 2))
    ground = np.column_stack([floor, np.sin(floor[:, 0] / 3) + np.cos(floor[:, 1] / 4)])
    places = np.random.default_rng(5).uniform(2, 38, (30, 2))[gone:]
    angle, height = (
        rng.uniform(0, 2 * np.pi, (len(places), 200)),
        rng.uniform(0, 8, (len(places), 200)),
    )
    stems = np.stack(
        [
            places[:, :1] + 0.25 * np.cos(angle),
            places[:, 1:] + 0.25 * np.sin(angle),
            height + np.sin(places[:, :1] / 3) + np.cos(places[:, 1:] / 4),
        ],
        axis=-1,
    )
    points = np.concatenate([ground, stems.reshape(-1, 3)])
    return points + rng.normal(size=points.shape) * 0.01


def start_off(clouds, by):
    source, reference = clouds
    shift = SHIFT + TILT @ source.centre - reference.centre
    return RigidTransform(TILT, shift + by)


@pytest.mark.slow
def test_the_part_that_stayed_decides_to_a_centimetre():
    rng = np.random.default_rng(1)
    source, reference = slope(rng, 80_000, 0), moved(slope(rng, 80_000, 1.0), TILT, SHIFT)
    found = register(source, reference)
    middle = source.mean(axis=0)
    error = np.linalg.norm(found.rotation @ middle + found.translation - TILT @ middle - SHIFT)
    assert error < 0.02
    assert error < 4 * np.sqrt(found.covariance[3:, 3:].trace())
    assert "moved" in " ".join(found.notes)


def test_the_last_stage_leaves_out_what_slid():
    rng = np.random.default_rng(2)
    clouds = tuple(
        prepare.prepare(cloud)
        for cloud in (slope(rng, 20_000, 0), moved(slope(rng, 20_000, 1.0), TILT, SHIFT))
    )
    right = start_off(clouds, 0.0)
    got = stable.settled(*clouds, start_off(clouds, [0.1, 0.25, 0.05]), 3.0, known=Known())
    error = np.linalg.norm(got.pose.translation - right.translation)
    assert error < 0.05
    assert error < 4 * np.sqrt(got.covariance[3:, 3:].trace())
    assert got.better
    share = np.mean(in_slide(*rng.uniform([0, 0], [200, 150], (20_000, 2)).T))
    assert abs(got.stayed - (1 - share)) < 0.15
    assert not got.doubt
    assert "70% of the points moved" in got._replace(stayed=0.3).doubt


def test_the_last_stage_leaves_a_right_pose_alone():
    rng = np.random.default_rng(3)
    clouds = tuple(
        prepare.prepare(cloud)
        for cloud in (felled(rng, 9000, 0), moved(felled(rng, 9000, 9), TILT, SHIFT))
    )
    right = start_off(clouds, 0.0)
    got = stable.settled(*clouds, right, 1.0, known=Known())
    assert np.linalg.norm(got.pose.translation - right.translation) < 0.005


def test_a_mask_and_a_weight_of_zero_say_what_moved():
    """Both leave out half of a surface that was turned away; without them the pose is off."""
    rng = np.random.default_rng(4)
    source = slope(rng, 3000, 0)
    reference = moved(slope(rng, 3000, 6.0), TILT, SHIFT)
    stays = ~in_slide(source[:, 0], source[:, 1])
    there = (reference - SHIFT) @ TILT
    stays_too = ~in_slide(there[:, 0], there[:, 1])
    start = np.eye(4)
    start[:3, :3], start[:3, 3] = TILT, SHIFT + [0.3, 0.3, 0.1]
    middle = source.mean(axis=0)

    def error(**options):
        found = register(source, reference, initial=start, **options)
        assert found.confidence.shape == (len(source),)
        assert np.isfinite(found.correspondences).all()
        return np.linalg.norm(found.rotation @ middle + found.translation - TILT @ middle - SHIFT)

    assert error(mask=(stays, stays_too)) < 0.2
    assert error(weights=stays.astype(float)) < 0.2


def test_only_the_proportions_of_weights_count():
    given = np.random.default_rng(4).uniform(0.5, 1, 50)
    for factor in (1e-300, 1e300):
        np.testing.assert_allclose(masks.weights_of(factor * given, 50), given / given.max())
    np.testing.assert_array_equal(masks.weights_of(np.zeros(3), 3), 0)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"mask": np.ones(5)}, "the mask of the source is float64"),
        ({"mask": (None, np.ones(5, bool))}, "the mask of the reference is bool"),
        ({"mask": np.zeros(80, bool)}, "leave 0 points of the source"),
        ({"weights": np.ones(5)}, "80 numbers of 0 or more"),
        ({"weights": -np.ones(80)}, "weight 0 is -1.0: give finite numbers of 0 or more"),
        ({"weights": np.zeros(80)}, "leave 0 points of the source"),
    ],
)
@pytest.mark.untyped
def test_masks_and_weights_that_do_not_fit(options, told):
    points = np.random.default_rng(0).normal(size=(80, 3))
    with pytest.raises(ValueError, match=told):
        register(points, points, **options)


def test_a_mask_that_leaves_rows_which_are_dropped_says_so():
    points = np.random.default_rng(0).normal(size=(80, 3))
    holed = points.copy()
    holed[2:] = np.nan
    with pytest.raises(ValueError, match="leave 2 points of the reference that are finite"):
        register(
            points,
            np.concatenate([holed, points]),
            mask=(None, np.arange(160) < 80),
            nonfinite="drop",
        )


@pytest.mark.parametrize("count", [1024, 1450])
def test_weights_of_one_change_nothing_of_a_sparse_cloud(count, seed):
    """An exact copy: its pose is known to the last digits without them."""
    direction = np.random.default_rng(seed).normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x, y, z = direction.T
    points = direction * (1 + 0.2 * np.sin(3 * x + 1) * np.cos(4 * y) + 0.15 * z**3)[:, None]
    found = register(points, moved(points, TILT, SHIFT), weights=np.ones(count))
    assert angle_deg(found.rotation, TILT) < 0.05


def test_a_box_names_points():
    points = np.array([[0.5, 0.5, 9.0], [2.0, 0.5, 0.0], [0.5, 0.5, 0.5]])
    assert masks.in_box(points, [0, 0, 1, 1]).tolist() == [True, False, True]
    assert masks.in_box(points, [0, 0, 0, 1, 1, 1]).tolist() == [False, False, True]
    for box in ([0, 0, 1], [1, 0, 0, 1], [0, 0, 0, 0]):
        with pytest.raises(ValueError, match="x0,y0,x1,y1"):
            masks.in_box(points, box)


def test_heaps_hardly_higher_than_the_ground_is_rough():
    """Twelve heaps and pits of 0.3 m, on three tenths of a ground of waves half a metre high."""
    middles = np.random.default_rng(3).uniform([0, 0], [180, 140], (12, 2))
    reach = np.sqrt(0.3 * 180 * 140 / 12 / np.pi)

    def scan(rng, height):
        x, y = rng.uniform([0, 0], [180, 140], (20_000, 2)).T
        z = 0.2 * x + 3 * np.sin(x / 16) * np.cos(y / 21) + 1.2 * np.sin(x / 6 - y / 5)
        z += 0.5 * np.cos(x / 2.1) * np.sin(y / 2.7)
        near = np.hypot(x[:, None] - middles[:, 0], y[:, None] - middles[:, 1]) < reach
        z += np.where(near.any(axis=1), np.where(near.argmax(axis=1) % 2 == 0, height, -height), 0)
        return np.column_stack([x, y, z]) + rng.normal(size=(20_000, 3)) * 0.03

    source, reference = scan(np.random.default_rng(1), 0), scan(np.random.default_rng(2), 0.3)
    found = register(source, moved(reference, TILT, SHIFT))
    off = source @ (found.rotation - TILT).T + found.translation - SHIFT
    assert np.linalg.norm(off, axis=1).max() < 0.03
    assert "moved or changed" in found.notes[-1]
